"""Which scans of a touch are reconstructed, and from the mean of how many."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Operator
from services.estimation.images.averaging import CHANGED, FrameAverager
from services.estimation.images.operators import Operators

Array = NDArray[np.float64]


class Reconstructed(NamedTuple):
    """What an image is to be made of."""

    difference: Array  # (K,) mean
    averaged: int  # scans


class Reconstruction:
    """Of one skin, against one baseline."""

    def __init__(self, operators: Operators) -> None:
        self._operators = operators
        self._averager = FrameAverager()
        self.begin(np.zeros(0), 0)

    def begin(self, sigma: Array, frames: int) -> None:
        """Another baseline, the mean of so many frames; sigma (K,): noise of the difference to it."""
        self.sigma, self.frames = sigma, frames
        self._limit: tuple[Operator, float] | None = None  # of a change's score, by this operator
        self._averager.reset()

    @property
    def scan(self) -> int:
        """Number of the scan last reconstructed; 0: none yet of this touch."""
        return self._averager.scan

    def rest(self) -> None:
        """Nothing touches."""
        self._averager.reset()

    def __call__(self, d: Array, sigma: NDArray[np.float32], scan: int) -> Reconstructed | None:
        """Of a scan's difference and its standard deviation (K,), infinite where a measurement does not count. None:
        nothing changed, the image last made is held, or too few count for one.
        """
        operator = self._operators(sigma, 1, self.frames)
        if operator is None:
            self._averager.reset()
            return None
        if self._limit is None or self._limit[0] is not operator:
            self._limit = operator, operator.threshold(CHANGED, self.frames)
        self._averager.of(np.isfinite(sigma))
        mean = self._averager(d, scan, *self._limit)
        return None if mean is None else Reconstructed(mean, self._averager.averaged)

    def prepare(self) -> bool:
        """Make the operator that the next touch needs first; False: it is there."""
        sigma = self.sigma.astype(np.float32)
        if self._operators.has(sigma, 1, self.frames):
            return False
        return self._operators(sigma, 1, self.frames) is not None

    def state(self) -> dict[str, Any]:
        return self._averager.state()

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self._averager.load(state, len(self.sigma))
