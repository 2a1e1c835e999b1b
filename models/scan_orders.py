"""What consecutive measurements of a scan have in common, and orders that give them more in common (numpy only)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class Neighbours:
    """What consecutive measurements of a scan have in common. change: mean step of |Z|, relative. switched: mean number
    of the lines drive + and drive - that change their electrode.
    """

    change: float
    switched: float

    @classmethod
    def of(cls, z0: Array, pattern: Rows, rows: Rows) -> Neighbours:
        """z0 (K,) |Z| and pattern (K, 4) of the measurements, rows (K,) their order."""
        z, drive = z0[rows], pattern[rows, :2]
        change = np.abs(np.roll(z, -1) - z) / z
        switched = (np.roll(drive, -1, axis=0) != drive).sum(axis=1)
        return cls(float(change.mean()), float(switched.mean()))


def by_change(z0: Array, order: Rows, parts: int) -> Rows:
    """The order in which |Z| changes least within each part: it rises in one part and falls in the next."""
    made = []
    for n, part in enumerate(np.split(order, parts)):
        rising = part[np.argsort(z0[part])]
        made.append(rising if n % 2 == 0 else rising[::-1])
    return np.concatenate(made)


def by_switching(pattern: Rows, order: Rows, parts: int) -> Rows:
    """An order in which few lines change their electrode: within each part, exchanged for as long as that helps (2-opt:
    G. A. Croes, Operations Research 6, 1958).
    """
    made = []
    for part in np.split(order, parts):
        drive = pattern[part, :2]
        cost = (drive[:, None] != drive[None]).sum(axis=2)
        made.append(part[_two_opt(cost)])
    return np.concatenate(made)


def _two_opt(cost: Rows) -> Rows:
    """An order of a cost's rows: no part of it costs less turned round."""
    path = np.arange(len(cost))
    best = cost[path[:-1], path[1:]].sum()
    improved = True
    while improved:
        improved = False
        for i in range(len(path) - 1):
            for j in range(i + 2, len(path) + 1):
                tried = np.concatenate([path[:i], path[i:j][::-1], path[j:]])
                found = cost[tried[:-1], tried[1:]].sum()
                if found < best:
                    path, best, improved = tried, found, True
    return path
