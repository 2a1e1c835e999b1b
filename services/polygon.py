"""A skin's outline as a polygon, for the commands that are given it by `info`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def inside(outline: Sequence[Sequence[float]] | Array, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Which points lie in a polygon (m, 2), by the even-odd rule; x and y are broadcast, in the outline's unit."""
    odd = np.zeros(np.broadcast(x, y).shape, dtype=bool)
    for (x1, y1), (x2, y2) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y1 != y2:
            odd ^= ((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) / (y2 - y1) * (x2 - x1))
    return odd


def distance(outline: Array, points: Array) -> Array:
    """(N,) distance of points (N, 2) to the sides of a polygon (m, 2)."""
    steps = np.roll(outline, -1, axis=0) - outline
    offset = points[:, None] - outline
    along = np.clip((offset * steps).sum(axis=2) / np.maximum((steps**2).sum(axis=1), 1e-30), 0, 1)
    return np.asarray(np.linalg.norm(offset - along[..., None] * steps, axis=2).min(axis=1))
