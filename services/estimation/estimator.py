"""The estimator of one skin: its baseline, its state, and scan after scan, or the newest values after a part of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.measurement.tables import SkinTables
from models.measurement.touch import SHAPES, STATES
from services.estimation.faults import advice
from services.estimation.faults.wires import WireFault
from services.estimation.hypotheses.innovation import Observation, StepBudget
from services.estimation.initialisation.baseline import NoBaseline
from services.estimation.initialisation.tare import AgreedScans, LatestScansState, Taring, TaringState
from services.estimation.scan_step import EstimatorState, ScanStep
from services.estimation.tared import KnownBaseline, TaredSkin, TaredState
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Estimate, Judgement, judge
from services.estimation.values.scan import NANOSECOND, PER_S, Scan
from services.estimation.values.state import loaded, saved

LAYOUT = 32  # of a kept state


@dataclass
class WholeState:
    """All that changes of an estimator."""

    scans: EstimatorState
    taring: TaringState
    latest: LatestScansState
    tared: TaredState | None


class Estimator:
    """Of one skin; tables: of its bundle."""

    def __init__(self, tables: SkinTables, tare_scans: int = int(n.TARE_SCANS)) -> None:
        self._tables = tables
        self.now = EstimatorState()
        self.taring = Taring(tables, tare_scans)
        self.skin: TaredSkin | None = None

    def tare(self, force: bool = False) -> AgreedScans:
        """Take the latest scans for the untouched skin: these. Raises NoBaseline; force: not because of touches."""
        if not force and self.wire is not None:
            raise NoBaseline("wires of the board are wrong, expected all as they belong: mend them and try again")
        scans = self.taring.by_command(force, None if self.skin is None else self.now.unexplained_s)
        self._begin(scans)
        return scans

    @property
    def wire(self) -> WireFault | None:
        """What is wrong with the board's wires."""
        return self.taring.now.wire if self.skin is None else self.skin.faults.now.wire

    def use(self, tables: SkinTables) -> None:
        """Of the same skin from the next scan on, as a calibration of its mounting knows it; while nothing touches."""
        self._tables = tables
        self.taring.use(tables)
        if self.skin is not None:
            self.skin = self.skin.with_tables(tables)

    def note_untouched(self) -> None:
        """The scan before the next one was untouched, as its source says: what touches then has begun."""
        if self.skin is not None:
            self.skin.touches.now.watched = True

    def adopt(self, baseline: KnownBaseline, age_s: float, contact_per_s: float = n.CONTACT_RATE) -> None:
        """Go on from a baseline age_s older than the next scan. contact_per_s: by which contact impedances change."""
        age_s = min(max(age_s, 0.0), float(n.OLDEST_S))
        self._new_skin(baseline).adopt(contact_per_s, age_s)
        self.now = EstimatorState(adopted_age_s=age_s)
        self.taring.adopted(baseline.doubt)

    def trust(self, baseline: KnownBaseline | None) -> None:
        """What the first scans are held against, too old to go on from; None: their bundle alone."""
        self.now.trusted, self.taring.now.pressed = baseline, None

    def _new_skin(self, baseline: KnownBaseline) -> TaredSkin:
        """On another baseline: its touches count on."""
        before, self.skin = self.skin, TaredSkin(self._tables, baseline)
        if before is not None:
            self.skin.touches.now.next_id = before.touches.now.next_id
        return self.skin

    def _begin(self, scans: AgreedScans, wire: WireFault | None = None) -> None:
        skin = self._new_skin(KnownBaseline(scans.log_z0, scans.live, scans.scatter, len(scans.residuals)))
        skin.begin(scans)
        skin.faults.now.wire = wire
        self.now.wholes, self.now.unexplained_s, self.now.trusted = 0, 0.0, None

    def _first(self) -> None:
        """Begin as soon as the first scans tell an untouched skin, or what touches one that is known."""
        due, trusted = self.taring.latest.due, self.now.trusted
        scans = self.taring.first(None if trusted is None else trusted.after_long(self._tables))
        if scans is not None:
            self._begin(scans, self.taring.now.wire)
        elif due and trusted is not None and self.taring.now.surely:
            latest = self.taring.latest.agreed(self._tables)
            trusted = trusted._replace(live=trusted.live & latest.live, scatter=latest.scatter)
            self.adopt(trusted, float(n.OLDEST_S))

    def state(self) -> dict[str, Any]:
        """All that changes, to be kept; who loads it goes on bit by bit as this one does."""
        tared = None if self.skin is None else self.skin.state()
        return {"layout": LAYOUT, **saved(WholeState(self.now, self.taring.now, self.taring.latest.now, tared))}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a state. Raises ValueError where it is of another layout or skin, or damaged: nothing changes."""
        if state.get("layout") != LAYOUT:
            raise ValueError(f"a state of layout {state.get('layout')!r}, expected {LAYOUT}")
        sizes = {"K": self._tables.measurements, "E": self._tables.electrodes}
        sizes |= {"states": STATES, "shapes": SHAPES, "published": 4}
        known = loaded(WholeState, {name: value for name, value in state.items() if name != "layout"}, sizes)
        skin = None
        if known.tared is not None:
            skin = TaredSkin(self._tables, known.tared.baseline)
            skin.load(known.tared)
        self.skin, self.now, self.taring.now, self.taring.latest.now = skin, known.scans, known.taring, known.latest

    # --- one scan ---

    def learn(self) -> None:
        """What scans so far teach, before `step` would: who calls it in a pause is answered sooner, and the same."""
        if self.skin is not None:
            self.skin.learning.catch_up()

    def step(self, scan: Scan) -> Estimate:
        """What touches, by this scan and those before it."""
        self.learn()
        before, self.now.before = self.now.before, scan
        gap_s = 0.0 if before is None else (scan.at_ns - before.at_ns) * NANOSECOND
        measured = self._prepared(scan)
        judgements = [judge("believed", float(not scan.believed), 1.0)]
        judgements += self.taring.judgements(self.skin is not None)
        if self.skin is None:
            self._first()
            return self._unknown(measured, judgements)
        return ScanStep(self.now, self.taring, self.skin, measured, judgements).estimate(gap_s)

    def _prepared(self, scan: Scan) -> Observation:
        """A scan as it is observed; a whole one may be one of a baseline."""
        now, oldest_us = self.now, scan.end_us - PER_S * scan.duration_s
        whole = not scan.part or oldest_us >= now.whole_us - 1.0 or scan.end_us < now.whole_us
        measurable = np.isfinite(scan.values) & (scan.values > 0) & (scan.status == 0)
        live = measurable if self.skin is None else measurable & self.skin.live
        budget = StepBudget.of(float(scan.new.mean()), scan.separate)
        measured = Observation(scan, np.log(np.where(live, scan.values, 1.0)), live, whole, budget)
        if whole:
            now.whole_us = scan.end_us
            self.taring.offer(scan, measurable, measured.middle_s)
        return measured

    def _unknown(self, measured: Observation, judgements: list[Judgement]) -> Estimate:
        """There is no baseline."""
        nothing, electrodes = np.zeros(self._tables.measurements), np.zeros(self._tables.electrodes, np.uint8)
        if (wire := self.wire) is not None:
            electrodes = advice.states_of(len(electrodes), wire, (), -1, silent=False)
            judgements = judgements + advice.judgements_of(electrodes, measured.scan.status, 0.0, undecided=False)
        return Estimate(
            measured.scan, measured.whole, (), electrodes, measured.live, nothing, nothing, tuple(judgements)
        )
