"""What a touch leaves behind: foam recovers slowly, and until then looks like a very light touch at the same place.

After a touch was held, a difference that is at most SHARE of the touch's own, and of its shape, is no touch, and the
baseline follows it: up to SHARE of the touch in all, and back. The price: a touch eased to less than SHARE of its force
counts as released. What is left only fades: a difference that grows again is a light touch at the same place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import Operator
from services.estimation.saved import shaped
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

SHARE = TUNING.creep_sd  # of the touch
LASTS_S = 120.0  # after the release; by then the baseline has followed
FADES_S = 5.0  # time constant with which what may be left is forgotten, where less was seen
GROWS = 0.004  # of the touch, by which what is left may grow from frame to frame, and GROWS_SIGMA of its noise
GROWS_SIGMA = 5.0
RENEWED = 4 * SHARE  # of the touch: another one that was held there leaves as much behind


class Creep:
    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.reset()

    def reset(self) -> None:
        self._touch = np.zeros(self._k)  # the strongest difference since the last touch began
        self._ends_ns = 0
        self._followed = 0.0  # of the touch, that is in the baseline
        self._left = SHARE  # of the touch, what may be left of it in all
        self._seen_ns = 0

    def begin(self, held: Array, now_ns: int) -> None:
        """A held touch's mean difference (K,)."""
        if now_ns >= self._ends_ns or float(held @ held) > float(self._touch @ self._touch):
            self._touch = held.copy()
            self._followed = 0.0
        if float(held @ self._touch) > RENEWED * float(self._touch @ self._touch):
            self._left = SHARE
        self._ends_ns = now_ns + round(LASTS_S * 1e9)

    def taken_out(self, d: Array, operator: Operator, now_ns: int) -> Array | None:
        """d (K,) without the creep in it; None where there can be none, or where d is too large for it."""
        if self.direction(now_ns) is None or float(d @ d) > 4 * SHARE**2 * float(self._touch @ self._touch):
            return None
        share, energy = self._share(d, operator)
        if share + self._followed > self._left + GROWS + GROWS_SIGMA / np.sqrt(energy):
            return None
        return d - self._possible(share) * self._touch

    def untouched(self, d: Array, operator: Operator, now_ns: int) -> None:
        """A frame without a touch: what it shows of the creep is all that is left."""
        if self.direction(now_ns) is None:
            return
        share, _ = self._share(d, operator)
        elapsed_s = max(0.0, (now_ns - self._seen_ns) * 1e-9)
        self._left = float(np.clip(share + self._followed, self._left * np.exp(-elapsed_s / FADES_S), SHARE))
        self._seen_ns = now_ns

    def _share(self, d: Array, operator: Operator) -> tuple[float, float]:
        """How much of the touch d (K,) shows, and the energy of the touch in standard deviations squared."""
        white = operator.whiten @ self._touch
        energy = max(float(white @ white), 1e-30)
        return float(white @ (operator.whiten @ d)) / energy, energy

    def _possible(self, share: float) -> float:
        return float(np.clip(share, -self._followed, SHARE - self._followed))

    def direction(self, now_ns: int) -> Array | None:
        """(K,) d of the touch whose creep goes on; None where none does."""
        return self._touch if now_ns < self._ends_ns and self._touch.any() else None

    def follow(self, share: float) -> float:
        """What of a found share of the touch can be creep, from now on in the baseline."""
        possible = self._possible(share)
        self._followed += possible
        return possible

    def state(self) -> dict[str, Any]:
        return {
            "touch": self._touch.copy(),
            "ends_ns": self._ends_ns,
            "followed": self._followed,
            "left": self._left,
            "seen_ns": self._seen_ns,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self._touch = shaped(state["touch"], (self._k,))
        self._ends_ns, self._followed = int(state["ends_ns"]), float(state["followed"])
        self._left, self._seen_ns = float(state.get("left", SHARE)), int(state.get("seen_ns", 0))
