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
        # the pixels to the left and right of the edge ahead; pixel (x, y) is above right of corner (x, y)
        left = padded[y + (dx + dy - 1) // 2, x + (dx - dy - 1) // 2]
        right = padded[y + (dy - dx - 1) // 2, x + (dx + dy - 1) // 2]
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
