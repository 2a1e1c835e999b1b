"""Outline of a touch: the polygon round the pixels of a mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def outline(mask: NDArray[np.bool_], metres_per_pixel: float, origin: list[float]) -> list[list[float]]:
    """Outer boundary of a connected mask (H, W) as a closed polygon of (x, y) [m], counter-clockwise, corners only.

    Walks along the pixels' edges with the mask on its left.
    """
    padded = np.pad(mask, 1)
    iy, ix = (int(v[0]) for v in np.nonzero(padded))  # lowest row, leftmost pixel: its lower edge is on the boundary
    start = (ix, iy)
    x, y, dx, dy = ix, iy, 1, 0
    corners: list[list[float]] = []
    while True:
        x, y = x + dx, y + dy
        left, right = _ahead(padded, x, y, dx, dy)
        if not left:  # the mask ended on the left: turn left
            turn = (-dy, dx)
        elif right:  # the mask continues on the right: turn right
            turn = (dy, -dx)
        else:
            turn = (dx, dy)
        if turn != (dx, dy):
            corners.append([origin[0] + (x - 1) * metres_per_pixel, origin[1] + (y - 1) * metres_per_pixel])
        dx, dy = turn
        if (x, y) == start and (dx, dy) == (1, 0):
            return corners


def _ahead(padded: NDArray[np.bool_], x: int, y: int, dx: int, dy: int) -> tuple[bool, bool]:
    """Whether the pixels to the left and right of the edge ahead belong to the mask; corner (x, y), pixel (x, y) is
    above right of it.
    """
    if dx:
        column = x if dx > 0 else x - 1
        above, below = bool(padded[y, column]), bool(padded[y - 1, column])
        return (above, below) if dx > 0 else (below, above)
    row = y if dy > 0 else y - 1
    east, west = bool(padded[row, x]), bool(padded[row, x - 1])
    return (west, east) if dy > 0 else (east, west)
