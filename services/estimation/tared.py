"""What stands on one baseline: the skin's tables, what is learnt of it, and who asks; kept and gone on from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from models.measurement.arrays import Array, Mask, Single
from models.measurement.noise import LineState, NoiseModel, NoiseState
from models.measurement.tables import SkinTables
from models.measurement.whitening import leave_out
from services.estimation.faults.board import BoardFaults, FaultState
from services.estimation.faults.wires import WireFault, any_touches
from services.estimation.filter import MODES, STATES_OF_MEMORY, FilterState, Memory, SkinFilter
from services.estimation.gates import NullGate, SlowOnsetTest, SlowState
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.initialisation.start import EarlierBaseline
from services.estimation.initialisation.tare import AgreedScans
from services.estimation.learning import DelayedUpdate, PendingScan, RefusedState, UnexplainedLoad
from services.estimation.touches import TouchesState, TouchTracks
from services.estimation.values import numbers as n


class KnownBaseline(NamedTuple):
    """Of this skin."""

    log_z0: Annotated[Array, "K"]
    live: Annotated[Mask, "K"]  # what of it counts
    scatter: Annotated[Array, "K"]  # of log |Z| from scan to scan
    frames: int  # that it is the mean of
    doubt: str = ""  # why the skin may have been touched, for a person

    def after_long(self, tables: SkinTables) -> EarlierBaseline:
        """For the first scans, when nobody knows how far the skin has drifted; tables: of its bundle."""
        drift = SkinFilter(tables.relative_to(np.exp(self.log_z0)))
        drift.begin(0.0, np.full(tables.electrodes, n.START_CONTACT**2))
        covariance = drift.predict(float(n.OLDEST_S), np.zeros(tables.electrodes)).covariance
        covariance[np.diag_indices_from(covariance)] += self.scatter**2 / self.frames
        leave_out(covariance, self.live)
        return EarlierBaseline(self.log_z0, covariance)


class GridInformation(NamedTuple):
    """Of the grid's discs, made now and then and under other wires or measurements."""

    each: Single  # (A,)
    wholes: int  # EstimatorState.wholes then
    live: Mask
    wire: WireFault | None


@dataclass
class TaredState:
    """All that changes of what stands on one baseline, and the baseline."""

    baseline: KnownBaseline
    noise: NoiseState
    lines: LineState
    drift: FilterState
    touches: TouchesState
    learning: list[PendingScan]
    faults: FaultState
    refused: RefusedState
    slow: SlowState
    aged: list[FilterState]  # of a baseline that was adopted, by how old it may be; empty after the first scan


class TaredSkin:
    """What stands on one baseline."""

    def __init__(self, tables: SkinTables, baseline: KnownBaseline) -> None:
        self.baseline = baseline
        self.log_z0, self.live, self.scatter, self.frames, _ = baseline
        self.tables = tables.relative_to(np.exp(self.log_z0))
        self.noise, self.drift = NoiseModel(self.tables), SkinFilter(self.tables)
        self.touches = TouchTracks(self.tables.response)
        self.hypotheses = Hypotheses(self.tables, self.noise, self.drift)
        self.learning = DelayedUpdate(self.drift, self.noise)
        self.slow_onset = SlowOnsetTest(self.drift)
        self.refused = UnexplainedLoad(tables.measurements)
        self.null_gate = NullGate(self.hypotheses.grid, self.noise, self.drift)
        self.grid_information: GridInformation | None = None
        self.aged = list[FilterState]()
        self.faults = BoardFaults(self.tables, any_touches(self.hypotheses.grid), self.live, self.noise)

    def begin(self, scans: AgreedScans) -> None:
        """scans: those of the baseline."""
        self.noise.begin(scans.residuals, scans.parts)
        self.noise.now.white = max(self.noise.now.white, scans.least_white)
        self.drift.begin(scans.at_s, (self.noise.now.flicker + n.CONTACT_START**2) / self.frames)
        for residual in scans.residuals[-2:]:  # a contact that jumps in the next scan did not do so in these
            self.faults.remember(residual, whole=True)

    def adopt(self, contact_per_s: float, age_s: float) -> None:
        """The baseline was taken age_s before the next scan, and nobody watched since. How far the skin has drifted is
        a mixture: as far as in each of AGES of that time. The first scan weighs them (`aged`). contact_per_s: relative,
        by which contact impedances change.
        """
        self.noise.now.white = float(np.median(self.scatter[self.live] ** 2))
        self.aged = []
        for share in n.AGES if age_s else n.AGES[-1:]:
            self.drift.begin(0.0, np.zeros(self.tables.electrodes), share * age_s)
            contact_sd = min(contact_per_s * share * age_s, float(n.START_CONTACT))
            contacts = np.r_[self.drift.contacts]
            self.drift.now.p[contacts, contacts] = n.CONTACT_START**2 + contact_sd**2
            bends = n.CONTACT_BENDS * contact_sd * np.linalg.norm(self.tables.contact, axis=1)
            self.drift.now.remainder_variance += self.scatter**2 / self.frames + bends**2
            self.drift.now.at_s = -share * age_s
            self.aged.append(self.drift.now)
        self.touches.now.watched = False

    @property
    def _learners(self) -> dict[str, Any]:
        """What has a state of its own, by its name in TaredState."""
        return {
            "noise": self.noise,
            "lines": self.noise.lines,
            "drift": self.drift,
            "touches": self.touches,
            "learning": self.learning,
            "faults": self.faults,
            "refused": self.refused,
            "slow": self.slow_onset,
        }

    def with_tables(self, tables: SkinTables) -> TaredSkin:
        """The same baseline and all that was learnt, with other tables of the same skin."""
        made = TaredSkin(tables, self.baseline)
        for name in ("noise", "lines", "touches", "learning", "faults"):
            made._learners[name].now = self._learners[name].now
        made.drift.succeed(self.drift)
        made.aged = self.aged
        return made

    def remember(self, memories: Sequence[Memory]) -> None:
        """What touches that went leave in the foam."""
        for memory in memories:
            self.drift.remember(memory)
        if memories:
            self.null_gate.forget()

    def state(self) -> TaredState:
        """What a whitening of a moment ago told is forgotten: who goes on from this state does not have it."""
        self.null_gate.forget()
        self.grid_information = None
        learnt = {name: each.now for name, each in self._learners.items()}
        return TaredState(self.baseline, **learnt, aged=self.aged)

    def load(self, state: TaredState) -> None:
        """Raises ValueError where the drift's covariance is none."""
        spread = np.linalg.eigvalsh(state.drift.p)
        size = 2 * MODES + self.tables.electrodes + STATES_OF_MEMORY * len(state.drift.memories)
        if len(spread) != size or spread[0] < -1e-9 * spread[-1]:
            raise ValueError(
                f"the drift's covariance: found {len(spread)} states, {spread[0]:.1g}, expected {size}, >= 0"
            )
        for name, each in self._learners.items():
            each.now = getattr(state, name)
        self.aged = state.aged
