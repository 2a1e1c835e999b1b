"""Drift that goes on under a touch, seen by what it changes while the touch is held.

Between two moments of a held touch

    change of d = B x + alpha u      B: the drift directions, u: the touch's own d, alpha: its force's change

and where that leaves noise only, x is drift and is taken out of the baseline. Anything else (the touch moves, another
one comes) is no drift: the comparison begins anew and nothing is taken out. So a held touch does not fade, and a force
that changes slowly is not taken for drift, since a third of a touch's signal is nothing that drift could make.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import PreReconstructor
from services.estimation.saved import shaped

Array = NDArray[np.float64]

BLOCK_S = 1.0  # frames are compared by their means over so long
MISFIT = 2e-2  # of the change of d that the linear picture of it does not give
GAIN = 0.35  # with which the newest block's drift is believed: its noise halved, two seconds late
SIGMAS = 5.0  # of the chi-square of what is left, beyond which it is more than noise


class Holding:
    """columns (K, 1 + E): d per relative change of the sheet and of each contact; rates (1 + E,): of those, 1/s."""

    def __init__(self, pre: PreReconstructor, columns: Array, rates: Array) -> None:
        self.pre, self.columns, self.rates = pre, columns, rates
        self.reset()

    def reset(self) -> None:
        """No touch, or a new one."""
        k, n = self.columns.shape
        self._reference: Array | None = None  # (K,) |Z|, mean of the first block
        self._touch = np.zeros(k)  # u
        self._taken = np.zeros(n)  # of x, since the reference
        self._reference_ns, self._frames = 0, 0
        self._clear(0)

    def _clear(self, now_ns: int) -> None:
        k = self.columns.shape[0]
        self._sum, self._count, self._since_ns = np.zeros(k), np.zeros(k), now_ns

    def rescale(self, factor: float) -> None:
        """All |Z| so far, times this factor."""
        self._sum = self._sum * factor
        if self._reference is not None:
            self._reference = self._reference * factor

    def __call__(
        self,
        z0: Array,
        amplitude: Array,
        live: NDArray[np.bool_],
        sigma: Array,
        normaliser: NDArray[np.floating],
        now_ns: int,
    ) -> bool:
        """A touched frame's |Z| (K,). z0 (K,) is changed in place; True where it was. sigma (K,): noise of d."""
        if not self._since_ns:
            self._since_ns = now_ns
        self._sum += np.where(live, amplitude, 0.0)
        self._count += live
        if (now_ns - self._since_ns) * 1e-9 < BLOCK_S:
            return False
        whole = self._count == self._count.max()
        mean = np.where(whole & (self._count > 0), self._sum / np.maximum(self._count, 1), np.nan)
        frames = int(self._count.max())
        self._clear(now_ns)
        step = None if self._reference is None else self._compare(mean, frames, sigma, normaliser, now_ns)
        if step is None:
            self._reference, self._reference_ns, self._frames = mean, now_ns, frames
            self._touch = np.nan_to_num((mean - z0) / normaliser)
            self._taken = np.zeros_like(self._taken)
            return False
        step = GAIN * (step - self._taken)
        z0 += np.where(z0 > 0, normaliser * (self.columns @ step), 0.0)
        self._taken = self._taken + step
        return True

    def _compare(
        self, mean: Array, frames: int, sigma: Array, normaliser: NDArray[np.floating], now_ns: int
    ) -> Array | None:
        """x (1 + E,) since the reference; None where the change is more than drift and force."""
        assert self._reference is not None
        change = (mean - self._reference) / normaliser
        live = np.isfinite(change) & np.isfinite(sigma)
        if live.sum() < len(live) / 2:
            return None
        change = change[live]
        variance = sigma[live] ** 2 * (1 / frames + 1 / self._frames) + self.pre.m.model_error**2
        variance += (MISFIT * change) ** 2
        scale = np.sqrt(variance)
        spread = np.append(self.rates * (now_ns - self._reference_ns) * 1e-9, 1.0)  # prior of x and alpha
        design = np.column_stack([self.columns, self._touch])[live] * spread / scale[:, None]
        white = change / scale
        found = np.linalg.solve(design.T @ design + np.eye(len(spread)), design.T @ white)
        left = float(((white - design @ found) ** 2).sum() + (found**2).sum())
        dof = float(live.sum())
        if left > dof + SIGMAS * np.sqrt(2 * dof):
            return None
        return np.asarray((found * spread)[:-1])

    def state(self) -> dict[str, Any]:
        return {
            "reference": None if self._reference is None else self._reference.copy(),
            "touch": self._touch.copy(),
            "taken": self._taken.copy(),
            "reference_ns": self._reference_ns,
            "frames": self._frames,
            "sum": self._sum.copy(),
            "count": self._count.copy(),
            "since_ns": self._since_ns,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        k, n = self.columns.shape
        reference = state["reference"]
        self._reference = None if reference is None else shaped(reference, (k,), finite=False)
        self._touch, self._taken = shaped(state["touch"], (k,)), shaped(state["taken"], (n,))
        self._reference_ns, self._frames = int(state["reference_ns"]), max(1, int(state["frames"]))
        self._sum, self._count = shaped(state["sum"], (k,)), shaped(state["count"], (k,))
        self._since_ns = int(state["since_ns"])
