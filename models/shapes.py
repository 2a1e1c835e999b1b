"""What presses on the skin: contact shapes as geometry, without a mesh and without a skin.

Lengths are model units (half a side of the square skin), angles radians, drops S/m (positive where pressed). A shape
is given by its circumscribed circle: every corner of a triangle, rectangle, square and of the square round an L lies on
the circle of radius `radius` about (x, y); an L has arms 0.4 of its side thick; a Hertz contact is a circle whose
pressure is that under a ball, sqrt(1 - (r / R)^2) of the middle's, and so is its drop as long as the foam does not
saturate (models/pressure.py). Kinds are numbered 1-6 in files (`ROW`), in this order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from models.pressure import FOAM

Array = NDArray[np.float64]

KINDS = ("circle", "triangle", "rectangle", "square", "L", "hertz")
SIMULATED = (*KINDS, "ellipse")  # what a sheet can be pressed with; no fit and no file knows an ellipse
CLASSES = KINDS[:5]  # what a shape classifier names: a Hertz contact is a circle to it
ROW = ("kind", "x", "y", "radius", "drop", "rotation", "aspect")  # one row of a `shapes` array, kind 1-based
L_ARM = 0.4  # of the L's side
SUBPOINTS = 5  # per pixel and axis, for profiles that are not flat
ROUND = 180  # corners of the polygon that stands for a circle


def _corners(kind: str, aspect: float) -> Array | None:
    """Corners on or inside the unit circle, counter-clockwise, not rotated; None for round shapes."""
    if kind == "triangle":
        angles = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
        return np.column_stack([np.cos(angles), np.sin(angles)])
    if kind in ("rectangle", "square"):
        half = np.array([aspect, 1.0] if kind == "rectangle" else [1.0, 1.0])
        corners: Array = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half / np.linalg.norm(half)
        return corners
    if kind == "ellipse":
        angles = 2 * np.pi / ROUND * np.arange(ROUND)
        return np.column_stack([np.cos(angles), np.sin(angles) / aspect])
    if kind == "L":
        h = np.sqrt(0.5)
        inner = -h + 2 * h * L_ARM
        return np.array([[-h, -h], [h, -h], [h, inner], [inner, inner], [inner, h], [-h, h]])
    return None


def _inside_polygon(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Even-odd rule for points (..., 2)."""
    x, y = points[..., 0], points[..., 1]
    inside = np.zeros(points.shape[:-1], bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (x1 - x0) * (y - y0) / (y1 - y0))
    return inside


def polygon_coverage(corners: Array, n: int) -> Array:
    """Exact share of each pixel of an n x n grid that a counter-clockwise polygon (m, 2), in pixels, covers.

    The signed-area accumulation of font rasterisers: every edge, cut at the grid lines, changes the coverage of its own
    pixel by the area to its right, and of all pixels further right by its height; a running sum along each row adds up.
    """
    start, end = corners, np.roll(corners, -1, axis=0)
    step = end - start
    cuts = [np.zeros((len(corners), 1)), np.ones((len(corners), 1))]
    for axis in (0, 1):
        first = np.ceil(np.minimum(start, end)[:, axis])
        most = int(max(0, (np.floor(np.maximum(start, end)[:, axis]) - first).max() + 1))
        along = np.where(step[:, axis] == 0, np.inf, step[:, axis])
        cuts.append((first[:, None] + np.arange(most) - start[:, axis, None]) / along[:, None])
    t = np.sort(np.clip(np.hstack(cuts), 0, 1), axis=1)  # cuts off the edge become pieces of no length
    points = start[:, None] + t[..., None] * step[:, None]
    x0, y0 = points[:, :-1].reshape(-1, 2).T
    x1, y1 = points[:, 1:].reshape(-1, 2).T
    row = np.floor((y0 + y1) / 2).astype(int)
    x = np.clip((x0 + x1) / 2, 0, n)
    column = np.minimum(x.astype(int), n)
    height = y0 - y1
    on_grid = (row >= 0) & (row < n)
    change = np.zeros((n, n + 2))
    share = x - column
    np.add.at(change, (row[on_grid], column[on_grid]), (height * (1 - share))[on_grid])
    np.add.at(change, (row[on_grid], column[on_grid] + 1), (height * share)[on_grid])
    return np.asarray(np.clip(change.cumsum(1)[:, :n], 0, 1))


@dataclass(frozen=True)
class Shape:
    """One contact. `kind` is one of SIMULATED; `aspect` (length over width) is the rectangle's and the ellipse's alone.

    Raises ValueError for an unknown kind or a size that is none.
    """

    kind: str
    x: float
    y: float
    radius: float
    drop: float
    rotation: float = 0.0
    aspect: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in SIMULATED:
            raise ValueError(f"shape kind {self.kind!r}: expected one of {', '.join(SIMULATED)}")
        if not self.radius > 0 or not self.aspect > 0:
            raise ValueError(f"shape of radius {self.radius} and aspect {self.aspect}: both must be positive")

    # -- geometry ---------------------------------------------------------------------------------------------------
    @cached_property
    def corners(self) -> Array | None:
        """Corners (m, 2), counter-clockwise; None for a circle or a Hertz contact."""
        unit = _corners(self.kind, self.aspect)
        if unit is None:
            return None
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        corners: Array = self.radius * unit @ np.array([[c, s], [-s, c]]) + (self.x, self.y)
        return corners

    def outline(self, n: int = 64) -> Array:
        """Outline polygon, counter-clockwise: the corners, or n points of the circle."""
        if self.corners is not None:
            return self.corners
        angles = 2 * np.pi * np.arange(n) / n
        return np.column_stack([self.x + self.radius * np.cos(angles), self.y + self.radius * np.sin(angles)])

    @cached_property
    def area(self) -> float:
        if self.corners is None:
            return float(np.pi * self.radius**2)
        x, y = self.corners.T
        return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))

    @cached_property
    def centroid(self) -> Array:
        """Centroid of the patch's area, (2,); it differs from (x, y) for the L only."""
        if self.corners is None:
            return np.array([self.x, self.y])
        p, q = self.corners, np.roll(self.corners, -1, axis=0)
        cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
        return np.asarray(((p + q) * cross[:, None]).sum(0) / (6 * self.area))

    @property
    def integral(self) -> float:
        """Integrated drop, S/m times square model units: what survives when peak and area trade off."""
        return self.drop * self.area * (FOAM.ball_mean(self.drop) if self.kind == "hertz" else 1.0)

    def force(self, metres_per_unit: float) -> float:
        """Newtons that make this touch on a sheet of FOAM: its pressure summed over the patch."""
        return FOAM.force(self.kind, self.drop, self.area * metres_per_unit**2)

    @property
    def shape_class(self) -> int:
        """Index into CLASSES; a Hertz contact and an ellipse count as circles."""
        return 0 if self.kind in ("hertz", "ellipse") else KINDS.index(self.kind)

    # -- drop -------------------------------------------------------------------------------------------------------
    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which of points (..., 2) the patch covers."""
        if self.corners is not None:
            return _inside_polygon(self.corners, points)
        return (points[..., 0] - self.x) ** 2 + (points[..., 1] - self.y) ** 2 < self.radius**2

    def profile(self, points: Array) -> Array:
        """Drop at points (..., 2) over the peak drop, 0 to 1."""
        if self.kind != "hertz":
            return self.contains(points).astype(float)
        r2 = ((points[..., 0] - self.x) ** 2 + (points[..., 1] - self.y) ** 2) / self.radius**2
        return FOAM.ball(self.drop, np.sqrt(np.maximum(0.0, 1.0 - r2)))

    def fraction(self, n: int, *, covered: bool = False) -> Array:
        """Pixel means of `profile` on the square [-1, 1]^2: (n, n), row 0 at the lowest y.

        `covered` asks for the area fraction instead, which for a Hertz contact is not the same. Area fractions are
        exact (a circle is a polygon of equal area, 1e-4 of its radius off); a Hertz profile is averaged over points.
        """
        if self.kind == "hertz" and not covered:
            image = np.zeros((n, n))
            windows = []  # pixels that the circle reaches, along x and y
            for middle in (self.x, self.y):
                low, high = (math.floor((middle + side * self.radius + 1) * n / 2) for side in (-1, 1))
                windows.append(slice(min(max(low, 0), n), min(max(high + 1, 0), n)))
            x, y = (
                -1 + 2 * (np.arange(w.start * SUBPOINTS, w.stop * SUBPOINTS) + 0.5) / (n * SUBPOINTS) for w in windows
            )
            points = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
            part = self.profile(points).reshape(len(y) // SUBPOINTS, SUBPOINTS, len(x) // SUBPOINTS, SUBPOINTS)
            image[windows[1], windows[0]] = part.mean((1, 3))
            return image
        outline = self.outline(ROUND)
        if self.corners is None:
            outline = (outline - (self.x, self.y)) * np.sqrt(2 * np.pi / ROUND / np.sin(2 * np.pi / ROUND))
            outline += (self.x, self.y)
        return polygon_coverage((outline + 1) * n / 2, n)

    def edge_distance(self, points: Array) -> Array:
        """Distance of points (m, 2) to the outline."""
        if self.corners is None:
            return np.asarray(np.abs(np.hypot(points[:, 0] - self.x, points[:, 1] - self.y) - self.radius))
        nearest = np.full(len(points), np.inf)
        for p, q in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            along = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            foot = points - p - along[:, None] * (q - p)
            np.minimum(nearest, np.hypot(foot[:, 0], foot[:, 1]), out=nearest)
        return nearest

    # -- rows -------------------------------------------------------------------------------------------------------
    def as_row(self) -> Array:
        """(7,) in the order of ROW, kind 1-based."""
        return np.array(
            [KINDS.index(self.kind) + 1, self.x, self.y, self.radius, self.drop, self.rotation, self.aspect], float
        )

    @classmethod
    def from_row(cls, row: Sequence[float] | Array) -> Shape:
        kind, *rest = (float(v) for v in row)
        if not 1 <= kind <= len(KINDS):
            raise ValueError(f"shape kind {kind}: expected 1 to {len(KINDS)} ({', '.join(KINDS)})")
        return cls(KINDS[int(kind) - 1], *rest)


# -- several shapes ---------------------------------------------------------------------------------------------------
def drop_image(shapes: Iterable[Shape], n: int) -> Array:
    """Conductivity drop, S/m, pixel means (n, n) of touches that do not overlap (where they do, the larger drop)."""
    image = np.zeros((n, n))
    for shape in shapes:
        image = np.maximum(image, shape.drop * shape.fraction(n))
    return image


def to_rows(shapes: Sequence[Shape], length: int = 3) -> Array:
    """(length, 7), NaN where unused: the form shapes have in files."""
    rows = np.full((length, len(ROW)), np.nan)
    for k, shape in enumerate(shapes):
        rows[k] = shape.as_row()
    return rows


def from_rows(rows: Array) -> list[Shape]:
    """Inverse of `to_rows`."""
    return [Shape.from_row(row) for row in rows if np.isfinite(row[0])]


def _dense_outline(shape: Shape, n: int = 24) -> Array:
    corners = shape.outline(64)
    if shape.corners is None:
        return corners
    t = np.arange(n)[:, None, None] / n
    return ((1 - t) * corners + t * np.roll(corners, -1, axis=0)).reshape(-1, 2)


def gap(a: Shape, b: Shape) -> float:
    """Distance between two outlines, model units, to about a hundredth of a radius; 0 where they overlap."""
    free = float(np.hypot(a.x - b.x, a.y - b.y)) - a.radius - b.radius
    if a.corners is None and b.corners is None:
        return max(0.0, free)
    p, q = _dense_outline(a), _dense_outline(b)
    if a.contains(q).any() or b.contains(p).any():
        return 0.0
    return float(np.sqrt(((p[:, None] - q[None]) ** 2).sum(-1).min()))
