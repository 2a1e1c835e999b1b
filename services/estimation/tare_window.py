"""The newest frames that may become a baseline."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import PreReconstructor
from services.estimation.tare import Baseline, NoBaseline, take

Array = NDArray[np.float64]

RETRY_EVERY = 8  # frames between attempts at the first baseline: an attempt compares all frames of the window


class TareWindow:
    """|Z| (K,) of frames that follow each other; `frames` of them make a baseline."""

    def __init__(self, pre: PreReconstructor, frames: int) -> None:
        self.pre, self.frames = pre, frames
        self.reset()

    def reset(self) -> None:
        self._rows: deque[Array] = deque(maxlen=self.frames)
        self._seen = 0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, amplitude: Array) -> None:
        self._rows.append(amplitude)
        self._seen += 1

    def clear(self) -> None:
        """A frame was lost: what comes does not follow on what came."""
        self._rows.clear()

    def rescale(self, factor: float) -> None:
        """All |Z| so far, times this factor."""
        self._rows = deque((row * factor for row in self._rows), maxlen=self.frames)

    @property
    def due(self) -> bool:
        """Whether a first baseline is to be tried with this frame."""
        return len(self._rows) == self.frames and self._seen % RETRY_EVERY == 0

    def baseline(self, board: str, sample_ns: int) -> Baseline:
        """Raises NoBaseline."""
        if len(self._rows) < self.frames:
            raise NoBaseline(f"only {len(self._rows)} of {self.frames} frames came so far: wait, or look at `skin top`")
        return take(np.array(self._rows), self.pre, board, sample_ns)

    def state(self) -> dict[str, Any]:
        return {"window": np.array(self._rows), "seen": self._seen}

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, or NoBaseline where the frames are of another skin."""
        self.reset()
        rows, k = np.array(state["window"], dtype=float), self.pre.measurements
        if rows.size and (rows.ndim != 2 or rows.shape[1] != k):
            raise NoBaseline(f"the saved frames are of shape {rows.shape}, expected (n, {k}): tare again")
        self._rows.extend(rows if rows.size else [])
        self._seen = int(state["seen"])
