"""Operators of the pre-reconstruction, one for each noise that the frames of a skin state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Drift, Operator, PreReconstructor

KEPT = 16  # operators; 0.4 MB each
SUREST = 1e-4  # relative: below it the model is what a mean is wrong by, and that does not average out
REST_S = 0.25  # of the drift that skin.toml allows: what is left of it beside a touch
FEWEST = 2  # finite measurements without which there is nothing to reconstruct


class Operators:
    """Of one skin. Each is made once, which takes 10 ms."""

    def __init__(self, pre: PreReconstructor, scale_per_s: float, contact_per_s: float) -> None:
        """How fast an untouched skin may change, relative: its conductivity, and each electrode's contact impedance."""
        self._pre, self._drift = pre, Drift(scale_per_s * REST_S, contact_per_s * REST_S)
        self._made: dict[tuple[bytes, int, int], Operator] = {}

    def __call__(self, sigma: NDArray[np.float32], averaged: int, tare_frames: int) -> Operator | None:
        """For the mean of so many scans, whose standard deviation is sigma (K,), infinite where a measurement does not
        count, against the mean of `tare_frames`. None where too few count.
        """
        key = sigma.tobytes(), averaged, tare_frames
        if key not in self._made:
            if np.isfinite(sigma).sum() < FEWEST:
                return None
            if len(self._made) >= KEPT:
                self._made.pop(next(iter(self._made)))
            self._made[key] = self._make(sigma.astype(float), averaged, tare_frames)
        return self._made[key]

    def has(self, sigma: NDArray[np.float32], averaged: int, tare_frames: int) -> bool:
        """Whether it is there already."""
        return (sigma.tobytes(), averaged, tare_frames) in self._made

    def _make(self, sigma: NDArray[np.float64], averaged: int, tare_frames: int) -> Operator:
        live = np.isfinite(sigma)
        single = sigma * np.sqrt(averaged)
        most = int((float(np.median(single[live])) / SUREST) ** 2)  # as far as noise is what a mean is wrong by
        counted = min(averaged, max(1, most))
        return self._pre.condition(
            np.where(live, single / np.sqrt(counted), np.inf),
            drift=self._drift,
            weights=live.astype(float),
            tare_frames=max(1, tare_frames // counted),
        )
