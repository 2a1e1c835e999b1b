"""A contact that drifts is told from a touch by its pace: it moves on steadily, and a touch comes at once.

A light touch right on an electrode looks as a change of its contact does, and no single frame tells them apart: of 700
touches within 6 mm of an electrode (radius 2.5 to 20 mm, 0.3 to 8.5 N), 10 have the contact's form within noise, all of
them weaker than 1 N on 5 mm. But they begin within a few frames and then stay. A contact that has changed along a
straight line for a second, all the way in the form of a contact's change, drifts.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.estimation.contact_drift import Reference
from services.estimation.saved import shaped

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

WINDOW_S = 1.0  # a press takes less to come
STEPS = 12  # of the window, at least
LEAST = 30.0  # |d| over the noise of one measurement: change over the window
MODEL_ERROR = 3e-3  # of |d|: what a difference may be off the contact's form
OFF_LINE = 0.15  # of the change: how far from a straight line it may be on the way


class PastFrames:
    """|Z| (K,) of the last second, in steps of WINDOW_S / STEPS at least."""

    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.clear()

    def clear(self) -> None:
        self._rows: deque[tuple[float, Array]] = deque(maxlen=STEPS)  # (seconds, |Z|), the newest last

    def follow(self, amplitude: Array, now_s: float) -> None:
        """Takes a frame, after it was judged. now_s: when it was measured."""
        since = now_s - self._rows[-1][0] if self._rows else np.inf
        if not 0 <= since < 2 * WINDOW_S:
            self._rows.clear()
        if not self._rows or since >= WINDOW_S / STEPS:
            self._rows.append((now_s, amplitude.copy()))

    def rescale(self, factor: float) -> None:
        self._rows = deque(((at, row * factor) for at, row in self._rows), maxlen=STEPS)

    def drifts(self, form: Array, amplitude: Array, now_s: float, untouched: Reference, live: Mask) -> bool:
        """Whether all that changed in the last second is of this form, and came steadily. form (K, n): what a change of
        one contact does to d; live (K,): measurements that count.
        """
        if len(self._rows) < STEPS or not 0 < now_s - self._rows[-1][0] < WINDOW_S:
            return False
        times = np.array([at for at, _ in self._rows])
        past = np.array([row for _, row in self._rows])
        live = live & np.isfinite(past).all(axis=0)
        if live.sum() < len(live) / 2:
            return False
        changes = ((amplitude - past) / untouched.normaliser)[:, live].T  # (k, STEPS)
        whole = changes[:, 0]
        size, noise = float(np.linalg.norm(whole)), np.sqrt(2.0) * untouched.sigma[live]
        one = float(np.sqrt(np.mean(noise**2)))
        if size < LEAST * one:
            return False
        found, *_ = np.linalg.lstsq(form[live], changes, rcond=None)
        left = ((changes - form[live] @ found) ** 2).sum(axis=0)
        expected = float(noise @ noise) * (1 + 4 * float(np.sqrt(2 / len(noise))))
        if (left > expected + MODEL_ERROR**2 * (changes**2).sum(axis=0)).any():
            return False
        share = whole @ changes / size**2
        straight = (now_s - times) / (now_s - times[0])
        return bool((np.abs(share - straight) <= OFF_LINE + 4 * one / size).all())

    def state(self) -> dict[str, Any]:
        return {"times": np.array([at for at, _ in self._rows]), "rows": np.array([row for _, row in self._rows])}

    def load(self, state: dict[str, Any]) -> None:
        """Raises ValueError where it does not fit."""
        self.clear()
        for at, row in zip(state["times"], state["rows"], strict=True):
            self._rows.append((float(at), shaped(row, (self._k,), finite=False)))
