"""Graded triangle meshes of a skin: fine at the electrodes' ends, where the current density is nearly singular.

Five uses, five meshes that differ in spacing and in structure (the points are relaxed from different starts), so that a
network is never tested on the mesh it was trained on. The same skin and use give the same mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from skfem import MeshTri

from models.geometry import SkinGeometry
from protocol.errors import EitskinError


class MeshError(EitskinError, RuntimeError):
    """An outline that could not be meshed at the wanted spacing."""


@dataclass(frozen=True)
class Grading:
    """Spacing h(p) = min(interior, edge + growth * distance of p to the nearest electrode's end), model units."""

    edge: float
    growth: float
    interior: float
    offset: float  # where the quadtree that seeds the interior points begins: another value, another mesh
    relaxation: int = 12


USES = {
    "training": Grading(edge=4e-4, growth=0.4, interior=0.03, offset=0.0),
    "stub": Grading(edge=8e-4, growth=0.45, interior=0.036, offset=0.37),
    "world": Grading(edge=1e-3, growth=0.42, interior=0.042, offset=0.81),
    "inverse": Grading(edge=2e-3, growth=0.5, interior=0.045, offset=0.61),
    "reference": Grading(edge=5e-5, growth=0.14, interior=0.0115, offset=0.23, relaxation=3),
}


def build(skin: SkinGeometry, use: str | Grading = "training") -> MeshTri:
    """The skin's mesh for a use in USES or a grading of one's own. Every electrode end and corner is a node.

    Raises ValueError for an unknown use, MeshError where the outline's features are finer than the spacing.
    """
    if isinstance(use, str):
        if use not in USES:
            raise ValueError(f"unknown mesh {use!r}: expected one of {', '.join(USES)}")
        use = USES[use]
    arcs = _boundary_arcs(skin, use)
    rim = skin.point(arcs)
    points = np.vstack([rim, _seeds(skin, use)])
    for _ in range(use.relaxation):
        points = _relax(skin, use, points, _triangles(skin, points), len(rim))
    cells = _triangles(skin, points)
    used = np.unique(cells)
    mesh = MeshTri(points[used].T.copy(), np.searchsorted(used, cells).T.copy())
    found = len(mesh.boundary_facets())
    if found != len(rim):
        raise MeshError(
            f"skin '{skin.name}': the mesh has {found} boundary edges where the outline was cut into {len(rim)}; "
            f"its features are too fine for a spacing of {use.interior}"
        )
    return mesh


def spacing(skin: SkinGeometry, use: Grading, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) wanted spacing at points (N, 2)."""
    ends = skin.point(skin.edges.ravel())
    nearest = np.full(len(points), np.inf)
    for end in ends:
        np.minimum(nearest, np.hypot(points[:, 0] - end[0], points[:, 1] - end[1]), out=nearest)
    return np.minimum(use.interior, use.edge + use.growth * nearest)


def _boundary_arcs(skin: SkinGeometry, use: Grading) -> NDArray[np.float64]:
    """Arc lengths of the boundary nodes: fixed points, and between two of them equal steps of the integral of 1/h."""
    fixed = np.unique(
        np.round(np.mod(np.concatenate([skin.curve.corner_arcs, skin.edges.ravel()]), skin.perimeter), 12)
    )
    arcs = []
    for a, b in zip(fixed, np.append(fixed[1:], fixed[0] + skin.perimeter), strict=True):
        if b - a < 1e-9:
            continue
        # cosine spacing resolves the grading at both ends of the piece
        s = a + (b - a) * (1 - np.cos(np.linspace(0, np.pi, 4001))) / 2
        density = 1 / spacing(skin, use, skin.point(s))
        steps = np.concatenate([[0.0], np.cumsum(np.diff(s) * (density[1:] + density[:-1]) / 2)])
        n = max(1, int(np.ceil(steps[-1])))
        arcs.append(np.interp(np.linspace(0, steps[-1], n + 1)[:-1], steps, s))
    return np.asarray(np.mod(np.concatenate(arcs), skin.perimeter))


def _seeds(skin: SkinGeometry, use: Grading) -> NDArray[np.float64]:
    """Interior points: centres of the leaves of a quadtree refined to the wanted spacing, not close to the outline."""
    size = use.interior * 0.93 * 2 ** np.floor(np.log2(0.4 / use.interior))  # halving ends at the interior spacing
    n = int(np.ceil(2.2 / size)) + 1
    grid = (np.arange(n) - (n - 1) / 2 + use.offset) * size
    cells = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    leaves = []
    while len(cells):
        wanted = spacing(skin, use, cells)
        split = (
            size > wanted
        )  # a square cell of side 0.93 h has the area of a point in a triangular lattice of spacing h
        keep = cells[~split]
        keep = keep[skin.inside(keep)]
        leaves.append(keep[skin.curve.distance(keep) > 0.55 * spacing(skin, use, keep)])
        size /= 2
        cells = (cells[split][:, None] + size / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])).reshape(-1, 2)
        cells = cells[skin.inside(cells) | (skin.curve.distance(cells) < size * 2)]
    return np.vstack(leaves)


def _triangles(skin: SkinGeometry, points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Delaunay triangles inside the outline, counter-clockwise, without the slivers along straight sides."""
    cells = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[cells[:, k]] for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    longest = np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    cells[twice < 0] = cells[twice < 0][:, [0, 2, 1]]
    keep = np.abs(twice) > 1e-6 * longest
    if skin.outline is not None:
        keep &= skin.inside((a + b + c) / 3)
    return np.asarray(cells[keep])


def _relax(
    skin: SkinGeometry, use: Grading, points: NDArray[np.float64], cells: NDArray[np.int64], n_rim: int
) -> NDArray[np.float64]:
    """Smoothing: interior points move to the mean of their triangles' centroids, weighted by area over h^2."""
    corners = points[cells]
    centroid = corners.mean(axis=1)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    weight = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / spacing(skin, use, centroid) ** 2
    total = np.bincount(cells.ravel(), np.repeat(weight, 3), len(points))
    target = np.stack(
        [np.bincount(cells.ravel(), np.repeat(weight * centroid[:, k], 3), len(points)) for k in range(2)], axis=1
    )
    moved = points.copy()
    inner = np.arange(n_rim, len(points))[total[n_rim:] > 0]
    moved[inner] = target[inner] / total[inner, None]
    return moved
