"""What a touch of any shape does to a skin's impedances, to a few per mille, without a mesh (numpy only).

A conductivity drop delta(r) turns the field E0 of the untouched sheet into

    E(r) = E0(r) + int Gamma(r, r') delta(r') E(r') dr',        Gamma(r, r') = grad grad' N(r, r')

with N the sheet's Neumann function, electrodes included (the Lippmann-Schwinger equation of impedance tomography), and
an impedance by int delta E0_sense . E_drive. A touch is cut into `cells` x `cells` squares over its own extent, each
with one field (the Galerkin method), so a small touch is resolved as well as a large one. Gamma is the infinite
sheet's, known in closed form for squares, plus what the outline and the electrodes add: that is smooth, so a bundle
ships it on a coarse grid (`ResponseTables`, made by models/response_tables.py; response_file.py is their file).

Lengths are model units, drops S on a sheet of 1 S.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.patterns import incidence
from models.pressure import FOAM
from models.shapes import ROUND, SUBPOINTS, Array, Shape, polygon_coverage

CELLS = 14
MARGIN = 1.15  # of the grid over the touch's circumscribed circle
LAMINATE = 0.3  # share of the harmonic mean in a cell that an outline crosses; see Elements.touched


@dataclass(frozen=True)
class ResponseTables:
    """What a bundle ships of the untouched sheet, on pixels of the square [-1, 1]^2, [iy, ix] raveled.

    fields (2, F * F, E): x and y of E0, of a unit current in at each electrode and out at the last. regular (2, 2,
    G * G, G * G): Gamma less the infinite sheet's. inside (G, G): pixels with their centre on the skin.
    """

    fields: npt.NDArray[np.float32]
    regular: npt.NDArray[np.float32]
    inside: npt.NDArray[np.bool_]


class TouchGrid:
    """The cells over one place; every shape that stays within it is solved without building them again."""

    def __init__(self, tables: ResponseTables, free: Array, x: float, y: float, half: float, cells: int) -> None:
        self.cells, self.side = cells, 2 * half / cells
        self.low = np.array([x - half, y - half])
        axis = (np.arange(cells) + 0.5) * self.side
        centres = np.stack(np.meshgrid(self.low[0] + axis, self.low[1] + axis), axis=-1).reshape(-1, 2)
        coarse, fine = tables.inside.shape[0], round(tables.fields.shape[1] ** 0.5)
        nearest = np.clip(((centres + 1) * coarse / 2).astype(int), 0, coarse - 1)
        self.on: npt.NDArray[np.bool_] = tables.inside[nearest[:, 1], nearest[:, 0]] & (np.abs(centres) < 1).all(axis=1)
        index, weight = _bilinear(centres, fine)
        self.fields: Array = (tables.fields[:, index] * weight[None, :, :, None]).sum(axis=2)  # (2, m, E)
        index, weight = _bilinear(centres, coarse)
        used, column = np.unique(index, return_inverse=True)
        mix = np.zeros((len(centres), len(used)))
        np.add.at(mix, (np.arange(len(centres))[:, None], column.reshape(index.shape)), weight)
        regular = tables.regular[:, :, used[:, None], used]
        self.gamma: Array = free / self.side**2 + mix @ regular @ mix.T  # (2, 2, m, m)

    def holds(self, shape: Shape) -> bool:
        """Whether the shape's circle lies on the grid, with room for the derivative at its edge."""
        offset = np.array([shape.x, shape.y]) - self.low
        reach = shape.radius + 0.5 * self.side
        return bool((offset >= reach).all() and (offset <= self.side * self.cells - reach).all())

    def coverage(self, shape: Shape) -> Array:
        """(m,) share of each cell under the shape; for a Hertz contact the mean of its profile."""
        if shape.kind == "hertz":
            axis = (np.arange(self.cells * SUBPOINTS) + 0.5) * self.side / SUBPOINTS
            x, y = self.low[0] + axis - shape.x, self.low[1] + axis[:, None] - shape.y
            profile = FOAM.ball(shape.drop, np.sqrt(np.maximum(1 - (x**2 + y**2) / shape.radius**2, 0.0)))
            share = profile.reshape(self.cells, SUBPOINTS, self.cells, SUBPOINTS).mean(axis=(1, 3))
        else:
            outline = shape.outline(ROUND)
            if shape.corners is None:  # a polygon of the circle's area
                centre = np.array([shape.x, shape.y])
                outline = centre + (outline - centre) * np.sqrt(2 * np.pi / ROUND / np.sin(2 * np.pi / ROUND))
            share = polygon_coverage((outline - self.low) / self.side, self.cells)
        return np.where(self.on, share.ravel(), 0.0)


class TouchResponse:
    """d = |Z|/|Z0| - 1 of touches on one skin.

    pattern (K, 4); z0 (K,) ohm, signed or not: what d is relative to.
    """

    def __init__(self, tables: ResponseTables, pattern: npt.NDArray[np.integer], z0: Array, cells: int = CELLS) -> None:
        self._pattern = pattern
        electrodes = tables.fields.shape[2]
        self.tables, self.cells, self.z0 = tables, cells, np.asarray(z0, dtype=float)
        self._drive, self._sense = (incidence(pattern[:, k : k + 2].astype(np.int64), electrodes).T for k in (0, 2))
        self._free = _infinite_sheet(cells)

    def of_rows(self, rows: npt.NDArray[np.bool_]) -> TouchResponse:
        """The same of these measurements alone."""
        return TouchResponse(self.tables, self._pattern[rows], self.z0[rows], self.cells)

    def grid(self, x: float, y: float, radius: float) -> TouchGrid:
        """Cells for touches of about this place and circumscribed radius."""
        return TouchGrid(self.tables, self._free, x, y, MARGIN * radius, self.cells)

    def room(self, shape: Shape) -> float:
        """From the shape's circle to the skin's outline, to about a pixel of `inside`; 0 where it reaches it."""
        n = self.tables.inside.shape[0]
        off = np.argwhere(~np.pad(self.tables.inside, 1))
        y, x = (-1 + 2 * (off - 0.5) / n).T
        nearest = float(np.hypot(x - shape.x, y - shape.y).min())
        return float(max(0.0, nearest - 1 / n - shape.radius))

    def __call__(
        self, grid: TouchGrid, drop: Array, slope_at: npt.NDArray[np.integer] | None = None
    ) -> tuple[Array, Array]:
        """(K,) d of a drop (m,) of the cells, and (K, s) its derivative to the drop of the cells `slope_at` (s,)."""
        on = np.flatnonzero(drop > 1e-9)
        at = np.zeros(0, dtype=int) if slope_at is None else slope_at
        weight = np.tile(drop[on] * grid.side**2, 2)
        electrodes = grid.fields.shape[2]
        untouched = grid.fields[:, on].reshape(-1, electrodes)
        field = np.linalg.solve(np.eye(len(weight)) - _blocks(grid.gamma, on, on) * weight, untouched)
        moved = weight[:, None] * field
        d = ((untouched @ self._sense) * (moved @ self._drive)).sum(axis=0) / self.z0
        # The derivative is the product of the touched fields (the adjoint method), off the touch too.
        there = grid.fields[:, at].reshape(-1, electrodes) + _blocks(grid.gamma, at, on) @ moved
        product = (there @ self._drive) * (there @ self._sense)
        slope = (product[: len(at)] + product[len(at) :]) * grid.side**2 / self.z0
        return d, np.asarray(slope.T)

    def of(self, shape: Shape) -> Array:
        """(K,) d of one shape."""
        grid = self.grid(shape.x, shape.y, shape.radius)
        return self(grid, effective_drop(grid.coverage(shape), shape.drop, shape.kind))[0]


def effective_drop(share: Array, drop: float, kind: str) -> Array:
    """Drop of cells that a shape covers in part: between the layers' arithmetic and harmonic mean conductivity."""
    if kind == "hertz":  # no edge: the profile falls to zero by itself
        return share * drop
    along, across = 1 - share * drop, 1 / (share / (1 - drop) + 1 - share)
    return np.asarray(1 - along ** (1 - LAMINATE) * across**LAMINATE)


def _blocks(gamma: Array, rows: npt.NDArray[np.integer], columns: npt.NDArray[np.integer]) -> Array:
    """(2 r, 2 c) of (2, 2, m, m)."""
    picked = gamma[:, :, rows[:, None], columns]
    return np.asarray(picked.transpose(0, 2, 1, 3).reshape(2 * len(rows), 2 * len(columns)))


def _bilinear(points: Array, n: int) -> tuple[npt.NDArray[np.int64], Array]:
    """(m, 4) pixels of an n x n grid about each point, and their weights; constant beyond the outer centres."""
    at = np.clip((points + 1) * n / 2 - 0.5, 0, n - 1)
    low = np.minimum(at.astype(np.int64), n - 2)
    x, y = (at - low).T
    first = low[:, 1] * n + low[:, 0]
    index = np.stack([first, first + 1, first + n, first + n + 1], axis=1)
    return index, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)


# -- the infinite sheet ---------------------------------------------------------------------------------------------
def _infinite_sheet(n: int) -> Array:
    """(2, 2, n * n, n * n): means of Gamma over two cells of side 1 of an n x n grid."""
    offset = np.arange(-n, n + 1, dtype=float)
    x, y = np.meshgrid(offset, offset, indexing="ij")
    table = np.empty((2, 2, 2 * n - 1, 2 * n - 1))
    table[0, 0], table[1, 1] = _second_differences(_along(x, y)), _second_differences(_along(y, x))
    table[0, 1] = table[1, 0] = _second_differences(_crossed(x, y))
    iy, ix = np.divmod(np.arange(n * n), n)
    return np.asarray(table[:, :, ix[:, None] - ix + n - 1, iy[:, None] - iy + n - 1])


def _second_differences(values: Array) -> Array:
    """Along both axes: a cell's mean is a difference of integrals, and both cells are averaged over."""
    first = values[2:] - 2 * values[1:-1] + values[:-2]
    return np.asarray(first[:, 2:] - 2 * first[:, 1:-1] + first[:, :-2])


def _along(x: Array, y: Array) -> Array:
    """1/(4 pi) int int ln(x^2 + y^2) dy dy: its differences are the xx part, the dipole's own field included."""
    r2, angle = x**2 + y**2, np.arctan(np.divide(y, x, out=np.zeros_like(x), where=x != 0))
    log = np.log(np.where(r2 > 0, r2, 1.0))
    log_x = np.where(x != 0, np.log(np.where(x != 0, x**2, 1.0)), log)
    return np.asarray((0.5 * (r2 * log - y**2) - y**2 + 2 * x * y * angle - x**2 * (log - log_x)) / (4 * np.pi))


def _crossed(x: Array, y: Array) -> Array:
    """1/(4 pi) int int ln(x^2 + y^2) dx dy: its differences are the xy part."""
    r2 = x**2 + y**2
    log = np.log(np.where(r2 > 0, r2, 1.0))
    y_over_x = np.arctan(np.divide(y, x, out=np.zeros_like(x), where=x != 0))
    x_over_y = np.arctan(np.divide(x, y, out=np.zeros_like(x), where=y != 0))
    return np.asarray((x * y * log - 3 * x * y + x**2 * y_over_x + y**2 * x_over_y) / (4 * np.pi))
