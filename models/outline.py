"""The closed curve round a skin, a polygon or a disc, measured by arc length counter-clockwise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.errors import EitskinError

Array = NDArray[np.float64]


class GeometryError(EitskinError, ValueError):
    """A skin that cannot exist; the message says which part and what was expected."""


@dataclass(frozen=True, eq=False)
class Outline:
    """corners (m, 2), counter-clockwise, or None for a disc of `radius` round the origin.

    Arc length starts at the first corner (polygon) or at angle 0 (disc). Model units. Raises GeometryError.
    """

    corners: Array | None
    radius: float = 0.0

    def __post_init__(self) -> None:
        if self.corners is None:
            if not self.radius > 0:
                raise GeometryError(f"the radius must be positive, found {self.radius}")
        else:
            _check_polygon(self.corners)
        if np.abs(self.polygon()).max() > 1 + 1e-9:
            raise GeometryError("the outline must fit -1..1 in x and y (scale with metres_per_unit)")

    @cached_property
    def _steps(self) -> Array:
        """(m, 2) from each corner to the next."""
        assert self.corners is not None
        return np.asarray(np.roll(self.corners, -1, axis=0) - self.corners)

    @cached_property
    def _sides(self) -> Array:
        """(m,) their lengths."""
        return np.asarray(np.linalg.norm(self._steps, axis=1))

    @cached_property
    def corner_arcs(self) -> Array:
        """Arc length of each corner; empty for a disc."""
        return np.zeros(0) if self.corners is None else np.concatenate([[0.0], np.cumsum(self._sides)[:-1]])

    @cached_property
    def perimeter(self) -> float:
        return 2 * np.pi * self.radius if self.corners is None else float(self._sides.sum())

    def point(self, arc: ArrayLike) -> Array:
        """(..., 2) points at the given arc lengths, taken modulo the perimeter."""
        s = np.mod(np.asarray(arc, dtype=float), self.perimeter)
        if self.corners is None:
            return self.radius * np.stack([np.cos(s / self.radius), np.sin(s / self.radius)], axis=-1)
        side = np.clip(np.searchsorted(self.corner_arcs, s, side="right") - 1, 0, len(self.corners) - 1)
        along = (s - self.corner_arcs[side]) / self._sides[side]
        return np.asarray(self.corners[side] + along[..., None] * self._steps[side])

    def arc(self, points: ArrayLike) -> Array:
        """(N,) arc length of the curve's point nearest to each of the points (N, 2)."""
        p = np.atleast_2d(np.asarray(points, dtype=float))
        if self.corners is None:
            return np.asarray(np.mod(np.arctan2(p[:, 1], p[:, 0]), 2 * np.pi) * self.radius)
        distance, along = self._project(p)
        side = distance.argmin(axis=1)
        return np.asarray(self.corner_arcs[side] + along[np.arange(len(p)), side])

    def distance(self, points: ArrayLike) -> Array:
        """(N,) distance of points (N, 2) to the curve."""
        p = np.atleast_2d(np.asarray(points, dtype=float))
        if self.corners is None:
            return np.asarray(np.abs(self.radius - np.hypot(p[:, 0], p[:, 1])))
        return np.asarray(self._project(p)[0].min(axis=1))

    def inside(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the points (..., 2) the curve surrounds."""
        p = np.asarray(points, dtype=float)
        x, y = p[..., 0], p[..., 1]
        if self.corners is None:
            return np.asarray(np.hypot(x, y) <= self.radius)
        odd = np.zeros(x.shape, dtype=bool)
        for (x0, y0), (dx, dy) in zip(self.corners, self._steps, strict=True):
            if dy != 0:
                odd ^= ((y0 > y) != (y0 + dy > y)) & (x < dx * (y - y0) / dy + x0)
        return odd

    def polygon(self, n: int = 128) -> Array:
        """(m, 2) corners; of a disc n points."""
        return self.point(np.arange(n) / n * self.perimeter) if self.corners is None else self.corners.copy()

    def _project(self, p: Array) -> tuple[Array, Array]:
        """Distance of each point to each side, and how far along the side its foot is: both (N, m)."""
        assert self.corners is not None
        direction = self._steps / self._sides[:, None]
        offset = p[:, None] - self.corners
        along = np.clip(np.einsum("nmk,mk->nm", offset, direction), 0, self._sides)
        return np.linalg.norm(offset - along[..., None] * direction, axis=2), along


def _check_polygon(corners: Array) -> None:
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise GeometryError(f"an outline is at least three corners [x, y], found shape {corners.shape}")
    following = np.roll(corners, -1, axis=0)
    twice = np.linalg.norm(following - corners, axis=1) < 1e-9
    if twice.any():
        raise GeometryError(f"corner {int(np.flatnonzero(twice)[0])} of the outline is given twice")
    crossing = _self_crossing(corners)
    if crossing:
        near = [tuple(round(float(v), 4) for v in corners[side]) for side in crossing]
        raise GeometryError(
            f"sides {crossing[0]} and {crossing[1]} of the outline cross (they begin at {near[0]} and {near[1]}): "
            "expected one closed line that nowhere meets itself; check the order of its corners"
        )
    if (corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]).sum() <= 0:
        raise GeometryError("the outline's corners must run counter-clockwise; they run clockwise: reverse their order")


def _self_crossing(corners: Array) -> tuple[int, int] | None:
    """Two sides of a polygon that cross each other, if any."""

    def turn(a: Array, b: Array, c: Array) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    m = len(corners)
    for i in range(m):
        for j in range(i + 2, m if i else m - 1):
            a, b, c, d = corners[i], corners[(i + 1) % m], corners[j], corners[(j + 1) % m]
            if turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0:
                return i, j
    return None
