"""Which scans of a touch are reconstructed, from the mean of how many, and by which operator."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Drift, Operator, PreReconstructor
from services.estimation.values.state import shaped

Array = NDArray[np.float64]

CHANGED = 1e-3  # probability that an unchanged touch is reconstructed again: costs work, not truth
LONGEST_MEAN = 16  # frames that are averaged at most, and after which a touch is reconstructed again at the latest
MEANS = (1, 2, 4, 8, LONGEST_MEAN)  # frames in what is reconstructed of a touch
KEPT = 16  # operators; 0.4 MB each
SUREST = 1e-4  # relative: below it the model is what a mean is wrong by, and that does not average out
DRIFTS_S = 0.25  # of the drift that skin.toml allows: what is left of it beside a touch
FEWEST = 2  # finite measurements without which there is nothing to reconstruct


def sigma_of_mean(sigma: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """Of the mean of n frames, of `sigma` (K,) each: to the last bit what the frames of a touch that is held state."""
    return np.asarray(sigma / np.sqrt(n), np.float32)


class Operators:
    """Of one skin. Each is made once, which takes 10 ms."""

    def __init__(self, pre: PreReconstructor, scale_per_s: float, contact_per_s: float) -> None:
        """How fast an untouched skin may change, relative: its conductivity, and each electrode's contact impedance."""
        self._pre, self._drift = pre, Drift(scale_per_s * DRIFTS_S, contact_per_s * DRIFTS_S)
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


class Reconstructed(NamedTuple):
    """What an image is to be made of."""

    difference: Array  # (K,) mean
    averaged: int  # scans


class Reconstruction:
    """Of one skin, against one baseline: which frames of a touch are reconstructed, and from what: those since it last
    changed, by the whitened energy of an image's operator. The limit allows for the noise having been estimated from
    few scans.

    While nothing changes against the frame last reconstructed (not the previous frame: creep must be seen), frames are
    averaged, and their mean is reconstructed after 2, 4, 8, 16, 32, 48 ... of them.
    """

    def __init__(self, operators: Operators) -> None:
        self._operators = operators
        self.begin(np.zeros(0), 0)

    def begin(self, sigma: Array, frames: int) -> None:
        """Another baseline, the mean of so many frames; sigma (K,): noise of the difference to it."""
        self.sigma, self.frames = sigma, frames
        self._limit: tuple[Operator, float] | None = None  # of a change's score, by this operator
        self.reset()

    def reset(self) -> None:
        """Nothing touches."""
        self._live: NDArray[np.bool_] | None = None  # measurements that count in the mean
        self._reference: Array | None = None  # the difference last reconstructed
        self._averaged = 0  # frames in it
        self._recent: deque[Array] = deque(maxlen=LONGEST_MEAN)
        self._count = 0  # frames since the last change
        self.scan = 0  # number of the one last reconstructed; 0: none yet of this touch

    def __call__(self, d: Array, sigma: NDArray[np.float32], scan: int) -> Reconstructed | None:
        """Of a scan's difference and its standard deviation (K,), infinite where a measurement does not count. None:
        nothing changed, the image last made is held, or too few count for one.
        """
        operator = self._operators(sigma, 1, self.frames)
        if operator is None:
            self.reset()
            return None
        if self._limit is None or self._limit[0] is not operator:
            self._limit = operator, operator.threshold(CHANGED, self.frames)
        live = np.isfinite(sigma)
        if self._live is None or (live != self._live).any():  # frames of other measurements make another image
            self.reset()
        self._live = live
        if self._reference is not None:
            variance = 1 + 1 / self._averaged  # of the change, in units of one frame's
            if operator.score(d - self._reference) > variance * self._limit[1]:
                self._recent.clear()
                self._count = 0
        self._recent.append(d)
        self._count += 1
        if self._reference is not None and self._count not in MEANS and self._count % LONGEST_MEAN:
            return None
        self._reference = np.mean(self._recent, axis=0)
        self._averaged, self.scan = len(self._recent), scan
        return Reconstructed(self._reference, self._averaged)

    def prepare(self) -> bool:
        """Make the operator that the next touch needs first; False: it is there."""
        sigma = self.sigma.astype(np.float32)
        if self._operators.has(sigma, 1, self.frames):
            return False
        return self._operators(sigma, 1, self.frames) is not None

    def state(self) -> dict[str, Any]:
        return {
            "reference": self._reference,
            "averaged": self._averaged,
            "recent": np.array(self._recent),
            "count": self._count,
            "scan": self.scan,
            "live": None if self._live is None else self._live.astype(np.uint8),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        reference, shape = state["reference"], self.sigma.shape
        self._reference = None if reference is None else shaped(reference, shape)
        self._averaged, self._count, self.scan = int(state["averaged"]), int(state["count"]), int(state["scan"])
        self._recent.extend(shaped(row, shape) for row in state["recent"])
        if (live := state.get("live")) is not None:  # older recordings have none
            self._live = shaped(live, shape) > 0
        if self.scan < 0 or (self._reference is not None and self._averaged < 1):
            raise ValueError(f"a hold of {self._averaged} frames since scan {self.scan}: expected 1 or more, from 0 on")
