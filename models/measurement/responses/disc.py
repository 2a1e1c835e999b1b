"""What a disc of conductivity drop does to the measurements: its response, its slopes, and its own shape's directions.

A disc covers pixels by its distance to their centres, linearly over one pixel's side; that adds side^2 / 12 to the
mean square of its radius, which is taken off again.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from models.measurement.numbers import EDGE_WIDTH, SHEET
from models.measurement.touch import SHAPES, area_of

Array = NDArray[np.float64]

RIM = 2.0  # pixels over which slopes are taken: over one they scatter by a fifth
CLOSE = 1e-6  # units: nearer to the centre no direction is known
HARMONICS = (2, 3, 4)
RADII = ((0.09, 0.1), (0.18, 0.12), (0.33, 0.2))  # of discs, and how far apart their centres are [unit]
INWARD = 0.9  # of its radius that a disc's centre is within the sheet's edge


class DropTables(Protocol):
    """What drops in pixels do, see models/measurement/responses/tables.py:SkinTables."""

    @property
    def jacobian(self) -> NDArray[np.float32]: ...

    @property
    def along(self) -> NDArray[np.float32]: ...

    @property
    def turned(self) -> NDArray[np.float32]: ...

    @property
    def inside(self) -> NDArray[np.bool_]: ...

    @property
    def pixel(self) -> float: ...

    @property
    def measurements(self) -> int: ...


class Covered(NamedTuple):
    """Pixels about a disc."""

    rows: slice
    columns: slice
    x: Array  # (n, m) from the centre
    y: Array
    distance: Array
    share: Array  # covered
    rim: Array  # share per length that the outline moves outward


class DiscResponse:
    """Of unit action, on one skin's tables: the disc's strength times its area is 1, whatever its radius."""

    def __init__(self, tables: DropTables) -> None:
        self.tables = tables
        side = len(tables.jacobian)
        self._pixel = tables.pixel
        self._axis: Array = np.asarray((np.arange(side) + 0.5) * self._pixel - 1, float)

    @property
    def discs(self) -> Array:
        """(A, 3) x, y, log radius: all over the skin."""
        return _on_the_skin(_grid_of_discs(), self.tables.inside)

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        at = self._covered(x, y, log_radius)
        return np.asarray(self._sum(self.tables.jacobian, at, at.share[None])[0] / area_of(log_radius))

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, and its slopes to x, y and log radius."""
        at = self._covered(x, y, log_radius)
        found = self._sum(self.tables.jacobian, at, self._moved(at, log_radius)) / area_of(log_radius)
        found[3] -= 2 * found[0]  # a larger disc of the same action is weaker
        return found

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K) the touch's own directions, see models/measurement/touch.py."""
        at = self._covered(x, y, log_radius)
        found = np.empty((SHAPES, self.tables.measurements))
        outlines = np.stack([*self._outlines(at, log_radius), self._edge(at)])
        found[:-2] = self._sum(self.tables.jacobian, at, outlines)
        found[-2] = self._sum(self.tables.along, at, at.share[None])[0]
        found[-1] = self._sum(self.tables.turned, at, at.share[None])[0]
        return found / area_of(log_radius)

    def _covered(self, x: float, y: float, log_radius: float) -> Covered:
        pixel, side = self._pixel, len(self._axis)
        radius = np.exp(log_radius)
        reach = radius + 2 * pixel
        rows = slice(max(0, int((y - reach + 1) / pixel)), min(side, int((y + reach + 1) / pixel) + 1))
        columns = slice(max(0, int((x - reach + 1) / pixel)), min(side, int((x + reach + 1) / pixel) + 1))
        from_x: Array = self._axis[None, columns] - x
        from_y: Array = self._axis[rows, None] - y
        distance = np.sqrt(from_x**2 + from_y**2)
        drawn = np.sqrt(max(radius**2 - pixel**2 / 12, (pixel / 2) ** 2))
        inward = (drawn - distance) / pixel
        share = np.minimum(np.maximum(inward + 0.5, 0.0), 1.0)
        rim = (np.abs(inward) < RIM / 2) / (RIM * pixel)
        return Covered(rows, columns, from_x, from_y, distance, share, rim)

    def _moved(self, at: Covered, log_radius: float) -> Array:
        outward = at.rim / np.maximum(at.distance, CLOSE)
        weights = np.empty((4, *at.share.shape))
        weights[0] = at.share
        weights[1] = outward * at.x
        weights[2] = outward * at.y
        weights[3] = at.rim * np.exp(log_radius)
        return weights

    def _outlines(self, at: Covered, log_radius: float) -> list[Array]:
        """Outlines r (1 + h cos m phi) and r (1 + h sin m phi)."""
        turned = (at.x + 1j * at.y) / np.maximum(at.distance, CLOSE)
        lifted = at.rim * np.exp(log_radius)
        found = []
        for harmonic in HARMONICS:
            wave = turned**harmonic
            found += [lifted * wave.real, lifted * wave.imag]
        return found

    def _edge(self, at: Covered) -> Array:
        """A blur of variance w^2 adds w^2 / 2 times the Laplacian."""
        bent = -4 * at.share
        bent[1:] += at.share[:-1]
        bent[:-1] += at.share[1:]
        bent[:, 1:] += at.share[:, :-1]
        bent[:, :-1] += at.share[:, 1:]
        return 0.5 * (EDGE_WIDTH / self._pixel) ** 2 * bent

    def _sum(self, table: NDArray[np.float32], at: Covered, weights: Array) -> Array:
        """(c, K) of weights (c, n, m)."""
        block = table[at.rows, at.columns].reshape(-1, table.shape[2])
        return (weights.reshape(len(weights), -1).astype(np.float32) @ block).astype(float)


def _grid_of_discs() -> Array:
    found = list[Array]()
    for radius, step in RADII:
        reach = SHEET - INWARD * radius
        axis = np.linspace(-reach, reach, 1 + round(2 * reach / step))
        x, y = np.meshgrid(axis, axis)
        found.append(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.log(radius))]))
    return np.concatenate(found)


def _on_the_skin(discs: Array, inside: NDArray[np.bool_]) -> Array:
    """Those whose centres are; inside (F, F): its pixels."""
    pixels = np.floor((discs[:, :2] + 1) / 2 * len(inside)).astype(int)
    return np.asarray(discs[inside[pixels[:, 1], pixels[:, 0]]])
