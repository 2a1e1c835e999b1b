"""What untouched scans teach filter and noise, two scans later: until then a touch may show that began slowly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.noise import NoiseModel
from models.measurement.whitening import Whitening, leave_out
from services.estimation.filter import SkinFilter
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Waiting:
    """An untouched scan that waits to be believed."""

    at_s: float
    over: Annotated[Array, "K"]  # log |Z| over the baseline
    live: Annotated[NDArray[np.bool_], "K"]
    part: int
    drifts: float  # times faster drift; 0: as slowly as before


@dataclass
class LearningState:
    """All that changes."""

    waiting: list[Waiting] = field(default_factory=list)


class Learning:
    def __init__(self, drift: SkinFilter, noise: NoiseModel) -> None:
        self._drift, self._noise = drift, noise
        self.now = LearningState()

    def doubt(self) -> None:
        """Something touches, or may: what waits is not believed."""
        self.now.waiting = []

    def untouched(self, scan: Waiting) -> None:
        """A scan on which nothing touches, by all that is known."""
        self.now.waiting.append(scan)
        if scan.drifts > 1:  # it was lost: what explains it now is the skin
            self._take_in(self.now.waiting.pop())
        if len(self.now.waiting) > n.LAG_SCANS:
            self._take_in(self.now.waiting.pop(0))

    def _take_in(self, scan: Waiting) -> None:
        if scan.drifts:
            self._drift.widen(scan.drifts)
        predicted = self._drift.ahead(scan.at_s, self._noise.now.flicker)
        covariance = self._noise.covariance(scan.part) + predicted.covariance
        leave_out(covariance, scan.live)
        white = Whitening.of(covariance)
        y = np.where(scan.live, scan.over - predicted.shift, 0.0)
        pulled = self._drift.take_in(predicted, y, white)
        if not scan.drifts and scan.live.all():
            self._noise.learn(pulled, white)
