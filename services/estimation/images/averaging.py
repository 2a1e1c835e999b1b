"""Which scans of a touch that is held are averaged: those since it last changed, by the detection statistic (whitened
energy) of an image's operator. The limit allows for the noise having been estimated from few scans.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Operator
from services.estimation.values.state import shaped

Array = NDArray[np.float64]

CHANGED = 1e-3  # probability that an unchanged touch is reconstructed again: costs work, not truth
LONGEST_MEAN = 16  # frames of a hold that are averaged at most, and after which it is reconstructed again at the latest
MEANS = (1, 2, 4, 8, LONGEST_MEAN)  # frames in what is reconstructed of a touch


def sigma_of_mean(sigma: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """Of the mean of n frames, of `sigma` (K,) each: to the last bit what the frames of a touch that is held state."""
    return np.asarray(sigma / np.sqrt(n), np.float32)


class FrameAverager:
    """Decides which frames of a touch are reconstructed, and from what.

    While nothing changes against the frame last reconstructed (not the previous frame: creep must be seen), frames are
    averaged, and their mean is reconstructed after 2, 4, 8, 16, 32, 48 ... of them.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._live: NDArray[np.bool_] | None = None  # measurements that count in it
        self._forget()

    def _forget(self) -> None:
        self._reference: Array | None = None  # the difference last reconstructed
        self.averaged = 0  # frames in it
        self._recent: deque[Array] = deque(maxlen=LONGEST_MEAN)
        self._count = 0  # frames since the last change
        self.scan = 0  # of the frame last reconstructed

    def of(self, live: NDArray[np.bool_]) -> None:
        """Which measurements count in the next frame. Frames of others make another image."""
        if self._live is None or (live != self._live).any():
            self._forget()
        self._live = live

    def __call__(self, d: Array, scan: int, operator: Operator, limit: float) -> Array | None:
        """The difference (K,) to reconstruct now, or None to hold. limit: of the operator's score, which a scan's noise
        exceeds with the probability CHANGED.
        """
        if self._reference is not None:
            variance = 1 + 1 / self.averaged  # of the change, in units of one frame's
            if operator.score(d - self._reference) > variance * limit:
                self._recent.clear()
                self._count = 0
        self._recent.append(d)
        self._count += 1
        if self._reference is not None and not _due(self._count):
            return None
        self._reference = np.mean(self._recent, axis=0)
        self.averaged = len(self._recent)
        self.scan = scan
        return self._reference

    def state(self) -> dict[str, Any]:
        return {
            "reference": self._reference,
            "averaged": self.averaged,
            "recent": np.array(self._recent),
            "count": self._count,
            "scan": self.scan,
            "live": None if self._live is None else self._live.astype(np.uint8),
        }

    def load(self, state: dict[str, Any], measurements: int) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        reference = state["reference"]
        self._reference = None if reference is None else shaped(reference, (measurements,))
        self.averaged, self._count, self.scan = int(state["averaged"]), int(state["count"]), int(state["scan"])
        self._recent.extend(shaped(row, (measurements,)) for row in state["recent"])
        if (live := state.get("live")) is not None:  # older recordings have none
            self._live = shaped(live, (measurements,)) > 0
        if self.scan < 0 or (self._reference is not None and self.averaged < 1):
            raise ValueError(f"a hold of {self.averaged} frames since scan {self.scan}: expected 1 or more, from 0 on")


def _due(count: int) -> bool:
    return count in MEANS or count % LONGEST_MEAN == 0
