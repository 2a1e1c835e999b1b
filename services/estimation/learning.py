"""What untouched scans teach filter and noise, two scans later: until then a touch may show that began slowly; and what
whatever pressed while nothing explained the scans may have left in the foam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from models.measurement.arrays import Array, Mask
from models.measurement.noise import NoiseModel
from models.measurement.whitening import Whitening, leave_out
from services.estimation.filter import Memory, SkinFilter
from services.estimation.values import numbers as n


@dataclass(frozen=True)
class PendingScan:
    """An untouched scan that waits to be believed."""

    at_s: float
    over: Annotated[Array, "K"]  # log |Z| over the baseline
    live: Annotated[Mask, "K"]
    part: int
    drifts: float  # times faster drift; 0: as slowly as before


class DelayedUpdate:
    """The filter's update by untouched scans, with a fixed lag of two: none by what turns out to be a touch's begin."""

    def __init__(self, drift: SkinFilter, noise: NoiseModel) -> None:
        self._drift, self._noise = drift, noise
        self.now = list[PendingScan]()  # those that wait, oldest first

    def doubt(self) -> None:
        """Something touches, or may: what waits is not believed."""
        self.now = []

    def stepped(self) -> None:
        """The gain has, of late: what was taken for drift may have been that."""
        self.now = [scan for scan in self.now if not scan.drifts]

    def untouched(self, scan: PendingScan) -> None:
        """A scan on which nothing touches, by all that is known: `catch_up` learns from those that waited enough."""
        self.now.append(scan)

    def catch_up(self) -> None:
        """Takes longer than a look at a quiet scan: what is said of a scan does not wait for it."""
        if len(self.now) <= n.LAG_SCANS:
            return
        scan = self.now.pop(0)
        if scan.drifts:
            self._drift.widen(scan.drifts)
        predicted = self._drift.predict(scan.at_s, self._noise.now.flicker)
        covariance = self._noise.covariance(scan.part) + predicted.covariance
        leave_out(covariance, scan.live)
        white = Whitening.of(covariance)
        y = np.where(scan.live, scan.over - predicted.shift, 0.0)
        weighted_residual = self._drift.update(predicted, y, white)
        if not scan.drifts and scan.live.all():
            self._noise.learn(weighted_residual, white)


@dataclass
class RefusedState:
    """All that changes."""

    column: Annotated[Array, "K"]  # change of |Z|, relative
    seconds: float = 0.0


class UnexplainedLoad:
    """Of one skin, what scans held that nothing explained. Something may have pressed then, and foam remembers it as it
    remembers a touch that was followed: by linear viscoelasticity, as the mean of all that pressed, weighted by how
    lately it did.
    """

    def __init__(self, measurements: int) -> None:
        self.now = RefusedState(np.zeros(measurements))

    def refuse(self, y: Array, seconds: float) -> None:
        """A whole scan that nothing explains; y (K,): log |Z| over what is predicted of the untouched skin."""
        change = np.clip(np.expm1(y), -n.REFUSED_MOST, n.REFUSED_MOST)
        self.now.column += (1 - np.exp(-seconds / n.MEMORY_FADES_S[0])) * (change - self.now.column)
        self.now.seconds += seconds

    def explained(self, at_s: float) -> list[Memory]:
        """Scans are explained from at_s on: what whatever pressed before may have left. What was short was followed."""
        column, seconds = self.now.column, self.now.seconds
        self.now = RefusedState(np.zeros(len(column)))
        return [Memory(column, 1.0, at_s, 0.0, 0.0, 0.0, mixed=True)] if seconds > n.CHANGING_S else []
