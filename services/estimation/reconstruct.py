"""Which scans of a touch are reconstructed, from the mean of how many, and by which operator."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Drift, Operator, PreReconstructor
from services.estimation.averaging import CHANGED, FrameAverager

Array = NDArray[np.float64]

OPERATORS = 16  # kept; 0.4 MB each
SUREST = 1e-4  # relative: below it the model is what a mean is wrong by, and that does not average out


class Reconstructed(NamedTuple):
    """What an image is to be made of."""

    difference: Array  # (K,) mean
    averaged: int  # scans
    operator: Operator


class Reconstruction:
    """Of one skin, against one baseline."""

    def __init__(self, pre: PreReconstructor, drift: Drift) -> None:
        """drift: what the estimator leaves of it."""
        self._pre, self._drift = pre, drift
        self._averager = FrameAverager()
        self.begin(np.full(pre.measurements, SUREST), 1)

    def begin(self, sigma: Array, frames: int) -> None:
        """Another baseline, the mean of so many frames; sigma (K,): noise of the difference to it."""
        self.sigma, self._frames = sigma, frames
        self._operators: dict[tuple[bytes, int], tuple[Operator, float]] = {}
        self._live = np.isfinite(sigma)
        self._averager.reset()

    @property
    def scan(self) -> int:
        """Number of the scan last reconstructed; 0: none yet of this touch."""
        return self._averager.scan

    def rest(self) -> None:
        """Nothing touches."""
        self._averager.reset()

    def alone(self, d: Array, live: NDArray[np.bool_]) -> Reconstructed:
        """Of a scan by itself."""
        return Reconstructed(d, 1, self._operator(self._counts(live), 1)[0])

    def __call__(self, d: Array, live: NDArray[np.bool_], scan: int) -> Reconstructed | None:
        """None: nothing changed, the image last made is held."""
        live = self._counts(live)
        self._averager.under(live, 0)
        mean = self._averager(d, scan, *self._operator(live, 1))
        if mean is None:
            return None
        averaged = self._averager.averaged
        return Reconstructed(mean, averaged, self._operator(live, averaged)[0])

    def prepare(self) -> bool:
        """Make the operator that the next touch needs first; False: it is there."""
        if (self._live.tobytes(), 1) in self._operators:
            return False
        self._operator(self._live, 1)
        return True

    def _counts(self, live: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where half of the skin or more tells nothing, an image is made as if all did: it is not valid."""
        live = live & np.isfinite(self.sigma)
        self._live = live if live.sum() >= len(live) / 2 else np.isfinite(self.sigma)
        return self._live

    def _operator(self, live: NDArray[np.bool_], averaged: int) -> tuple[Operator, float]:
        """For the mean of so many scans, as far as noise is what it is wrong by; and the limit of a change."""
        finite = self.sigma[np.isfinite(self.sigma)]
        most = int((float(np.median(finite)) / SUREST) ** 2) if finite.size else 1
        averaged = min(averaged, max(1, most))
        key = live.tobytes(), averaged
        if key not in self._operators:
            if len(self._operators) >= OPERATORS:
                self._operators.pop(next(iter(self._operators)))
            operator = self._pre.condition(
                self.sigma / np.sqrt(averaged),
                drift=self._drift,
                weights=live.astype(float),
                tare_frames=max(1, self._frames // averaged),
            )
            self._operators[key] = operator, operator.threshold(CHANGED, self._frames)
        return self._operators[key]

    def state(self) -> dict[str, Any]:
        return self._averager.state()

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self._averager.load(state, self._pre.measurements)
