"""Gates of a scan that cost little, by whitenings of a moment ago, and whether a touch came as slowly as drift."""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import dataclass, field

import numpy as np

from models.measurement.arrays import Array, Single
from models.measurement.fit import FoundTouches
from models.measurement.noise import NoiseModel
from models.measurement.response import DiscGrid
from models.measurement.whitening import Whitening
from services.estimation.filter import FilterState, SkinFilter
from services.estimation.hypotheses.detector import newest_z2
from services.estimation.hypotheses.innovation import AS_IT_IS, Innovation, Observation, ScoredAnswer
from services.estimation.values import numbers as n


@dataclass(frozen=True)
class Glance:
    """Of scans that are disturbed alike, while nothing touches."""

    at_s: float
    white: Whitening
    common_mode_variance: float  # of what all values share, by the filter


@dataclass(frozen=True)
class SteadyGlance:
    """Of scans that are disturbed alike, under the same touches."""

    at_s: float
    ids: tuple[int, ...]
    covariance: Array  # (K, K) without touches
    fit: FoundTouches  # of them


@dataclass(frozen=True)
class Seen:
    """What a look found."""

    quiet: bool
    z2: float
    weighted_residual: Array  # (K,)
    y: Array  # (K,) what was looked at


class NullGate:
    """Whether a scan is what noise alone makes of the prediction, by chi^2, the strongest disc and the newest values.
    Whitenings are of scans that are disturbed alike (NoiseModel.alike); it keeps nothing that a replay would miss.
    """

    def __init__(self, grid: DiscGrid, noise: NoiseModel, drift: SkinFilter) -> None:
        self._grid, self._noise, self._drift = grid, noise, drift
        self._glances: dict[int, Glance] = {}
        self._steady: dict[int, SteadyGlance] = {}

    def forget(self) -> None:
        """The untouched skin is another."""
        self._glances.clear()
        self._steady.clear()

    def keep(self, measured: Observation, ids: tuple[int, ...], innovation: Innovation, answer: ScoredAnswer) -> None:
        """Of a scan with which nothing is wrong; ids: of what touches."""
        alike, at_s = self._noise.alike(measured.scan.part), measured.middle_s
        self._steady.pop(alike, None)
        if (fit := answer.fit) is None:
            self._glances[alike] = Glance(at_s, innovation.white, self._drift.common_mode_variance(at_s))
        elif answer.cause == AS_IT_IS and answer.explained:
            self._steady[alike] = SteadyGlance(at_s, ids, innovation.covariance, fit)

    def steady(self, measured: Observation, ids: tuple[int, ...]) -> SteadyGlance | None:
        """None: nothing is known of such scans under these touches."""
        found = self._steady.get(self._noise.alike(measured.scan.part))
        return found if found is not None and found.ids == ids and _lately(found.at_s, measured) else None

    def look(self, measured: Observation, y: Array, information: Single) -> Seen | None:
        """y (K,): over the prediction, or 0. None: no whitening, or one that would overlook a step of the gain."""
        known = self._glances.get(self._noise.alike(measured.scan.part))
        if known is None or not _lately(known.at_s, measured):
            return None
        if self._drift.common_mode_variance(measured.middle_s) < n.SURER * known.common_mode_variance:
            return None
        residual = known.white(y)
        weighted_residual = known.white.w.T @ residual
        chi2 = float(residual @ residual) / max(int(np.count_nonzero(y)), 1)
        newest = newest_z2(measured, known.white, weighted_residual)
        z2 = max(self._grid.likeliest(weighted_residual, information)[0], newest)
        even = float(weighted_residual.sum()) ** 2 < n.GAIN_Z2 * float(np.sum(known.white.w.sum(axis=1) ** 2))
        return Seen(chi2 < n.QUIET and z2 < n.GLANCE_Z2 and even, z2, weighted_residual, y)


def _lately(at_s: float, measured: Observation) -> bool:
    return 0 <= measured.middle_s - at_s < n.GLANCE_S


@dataclass
class SlowState:
    """All that changes."""

    history: list[FilterState] = field(default_factory=list)  # oldest first
    tested_s: float = 0.0  # when it was asked last


class SlowOnsetTest:
    """Of one skin, while nothing touches: holds scans against the filter as it was some seconds ago, a fixed lag."""

    def __init__(self, drift: SkinFilter) -> None:
        self._drift = drift
        self.now = SlowState()

    def forget(self) -> None:
        """Something touches: what was before tells nothing of what drifts."""
        self.now = SlowState()

    def keep(self) -> None:
        """The filter has learnt from an untouched scan."""
        history, filtered = self.now.history, self._drift.now
        if history and 0 <= filtered.at_s - history[-1].at_s < n.SLOW_S / 2:
            return
        history.append(deepcopy(filtered))
        while len(history) > 1 and filtered.at_s - history[1].at_s >= n.SLOW_S:
            del history[0]

    def due(self, at_s: float) -> SkinFilter | None:
        """The filter as it was, when it is time to look."""
        now = self.now
        if not now.history or at_s - now.history[0].at_s < n.SLOW_S or 0 <= at_s - now.tested_s < n.SLOW_EVERY_S:
            return None
        now.tested_s = at_s
        then = copy(self._drift)
        then.now = now.history[0]
        return then
