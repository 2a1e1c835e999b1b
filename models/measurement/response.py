"""What touches do to the measurements: discs of conductivity drop, or what was measured on a registered skin.

A disc covers each pixel by the area that they share, in closed form, and slopes are that area's derivatives: by its
distance alone a small disc's slopes would mostly be those of the pixels.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, laplace

from models.locator_arrays import LocatorArrays
from models.measurement import numbers as n
from models.measurement.arrays import Array, Mask, Single
from models.measurement.touch import SHAPES, area_of
from models.measurement.whitening import Whitening

CLOSE = 1e-6  # units: nearer to the centre no direction is known
HARMONICS = range(2, 2 + len(n.HARMONIC_SDS))
RADII = ((n.TYPICAL_RADIUS / 2, 0.1), (n.TYPICAL_RADIUS, 0.12), (0.33, 0.2))  # of discs, and between centres [unit]
INWARD = 0.9  # of its radius that a disc's centre is within the sheet's edge


class Covered(NamedTuple):
    """Pixels (n, m) about a disc."""

    rows: slice
    columns: slice
    shares: Array  # (4, n, m) covered, and its slopes to x, y and log radius


class DiscResponse:
    """Relative change of |Z| by a disc of unit action: its strength times its area is 1, whatever its radius."""

    def __init__(self, jacobian: Single, along: Single, turned: Single, inside: Mask) -> None:
        """See models/measurement/tables.py:SkinTables."""
        self._jacobian, self._along, self._turned = jacobian, along, turned
        self._pixel = 2.0 / len(jacobian)
        self._borders: Array = np.linspace(-1.0, 1.0, len(jacobian) + 1)  # of pixels
        self._axis: Array = self._borders[:-1] + self._pixel / 2
        self.discs = _discs_on(inside)  # (A, 3) x, y, log radius: all over the skin

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        at = self._covered(x, y, log_radius)
        return np.asarray(self._sum(self._jacobian, at, at.shares[:1])[0] / area_of(log_radius))

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, and its slopes to x, y and log radius."""
        at = self._covered(x, y, log_radius)
        found = self._sum(self._jacobian, at, at.shares) / area_of(log_radius)
        found[3] -= 2 * found[0]  # a larger disc of the same action is weaker
        return found

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K) the touch's own directions, see models/measurement/touch.py."""
        at = self._covered(x, y, log_radius)
        from_centre = self._axis[None, at.columns] - x + 1j * (self._axis[at.rows, None] - y)
        angles = from_centre / np.maximum(np.abs(from_centre), CLOSE)
        waves = [angles**harmonic for harmonic in HARMONICS]  # outlines r (1 + h cos m phi) and r (1 + h sin m phi)
        shares = [at.shares[3] * part for wave in waves for part in (wave.real, wave.imag)]
        blur = 0.5 * (n.EDGE_WIDTH / self._pixel) ** 2  # of variance w^2: w^2 / 2 times the Laplacian
        shares.append(blur * laplace(at.shares[0], mode="constant"))
        found = [self._sum(self._jacobian, at, np.stack(shares))]
        found += [self._sum(table, at, at.shares[:1]) for table in (self._along, self._turned)]
        return np.concatenate(found) / area_of(log_radius)

    def _covered(self, x: float, y: float, log_radius: float) -> Covered:
        radius = float(np.exp(log_radius))
        rows, columns = self._about(y, radius), self._about(x, radius)
        borders = self._borders
        below = _disc_below(
            np.minimum(np.maximum((borders[columns.start : columns.stop + 1] - x) / radius, -1.0), 1.0),
            np.minimum(np.maximum((borders[rows.start : rows.stop + 1] - y) / radius, -1.0), 1.0),
        )
        left = below[:, 1:] - below[:, :-1]
        shares = left[:, :, 1:] - left[:, :, :-1]
        shares *= (np.array([radius, -1.0, -1.0, radius]) * radius / self._pixel**2)[:, None, None]
        return Covered(rows, columns, shares)

    def _about(self, centre: float, radius: float) -> slice:
        """The rows or columns of a disc, and one more on each side."""
        first, last = ((centre + way + 1) / self._pixel for way in (-radius, radius))
        begin = min(max(0, int(first) - 1), len(self._axis) - 1)  # one pixel at least, also beyond the sheet
        return slice(begin, max(begin + 1, min(len(self._axis), int(last) + 2)))

    def _sum(self, table: Single, at: Covered, weights: Array) -> Array:
        """(c, K) of weights (c, n, m)."""
        block = table[at.rows, at.columns].reshape(-1, table.shape[2])
        return (weights.reshape(len(weights), -1).astype(np.float32) @ block).astype(float)


def _disc_below(x: Array, y: Array) -> Array:
    """(4, n, m) area of the unit disc that lies left of x (m,) and below y (n,), both from -1 to 1, its slopes to
    these, and how it grows with the logarithm of the disc's radius: integrals of the chord along y, 2 (1 - x^2)^0.5, of
    which all is below y, or none, where it is shorter than 2 |y|.
    """
    half_x, half_y, angle = np.sqrt(1 - x**2), np.sqrt(1 - y**2)[:, None], np.arcsin(x) + np.pi / 2
    y, twice = y[:, None], 2.0 * (y > 0)[:, None]
    within = np.minimum(np.maximum(x, -half_y), half_y)
    below = np.empty((4, len(y), len(x)))
    np.add(within, half_y, out=below[2])  # length in which y cuts the chord
    arc = np.arcsin(within) + np.arcsin(half_y)
    half = 0.5 * (within * np.sqrt(1 - within**2) + half_y * np.abs(y) + arc)
    below[0] = y * below[2] + half + twice * (0.5 * (x * half_x + angle) - half)
    below[1] = np.minimum(np.maximum(y, -half_x), half_x) + half_x
    below[3] = arc + twice * (angle - arc)
    return below


def _discs_on(inside: Mask) -> Array:
    """(A, 3) of RADII, whose centres are on the skin; inside (F, F): its pixels."""
    found = list[Array]()
    for radius, step in RADII:
        reach = n.SHEET - INWARD * radius
        axis = np.linspace(-reach, reach, 1 + round(2 * reach / step))
        x, y = np.meshgrid(axis, axis)
        found.append(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.log(radius))]))
    discs = np.concatenate(found)
    pixels = np.floor((discs[:, :2] + 1) / 2 * len(inside)).astype(int)
    return np.asarray(discs[inside[pixels[:, 1], pixels[:, 0]]])


class MeasuredMap:
    """What a mean press does at each place of one registered skin, its slopes, and its error. An action of 1 is the
    registration's mean press. The map has no radius: how large a touch is, it does not tell. Its error is one dense
    covariance of a fixed size, from presses that were left out of it: as a diagonal, or in proportion to the touch,
    places are worse.
    """

    def __init__(self, arrays: LocatorArrays, metres_per_unit: float, mean_press: float = 1.0) -> None:
        """mean_press: action of the registration's mean press."""
        rows, columns = (int(side) for side in arrays.shape)
        allowed = arrays.allowed.reshape(rows, columns)
        table = np.zeros((rows, columns, arrays.map.shape[1]))
        table[allowed] = arrays.map / mean_press
        nearest = distance_transform_edt(~allowed, return_distances=False, return_indices=True)
        table = table[tuple(nearest)]  # beyond the presses, as where they end
        self._corner = np.asarray(arrays.corner, float) / metres_per_unit
        self._spacing = float(arrays.spacing) / metres_per_unit
        slopes = [np.gradient(table, self._spacing, axis=axis) for axis in (1, 0)]
        self._table: Array = np.stack([table, *slopes])  # (3, rows, columns, K)
        noise = np.diag(np.asarray(arrays.noise, float) ** 2)
        values, vectors = np.linalg.eigh(np.asarray(arrays.error, float) - noise)
        self.error: Array = vectors * np.maximum(values, 0.0) @ vectors.T  # (K, K) without negative variances
        iy, ix = np.nonzero(allowed)
        places = self._corner + self._spacing * np.column_stack([ix, iy])
        self.discs = np.column_stack([places, np.full(len(places), np.log(n.TYPICAL_RADIUS))])  # (A, 3) all of the map

    def through(self, slopes: Array) -> MeasuredMap:
        """The same seen through a fault of the wires; slopes (K, K)."""
        seen = copy(self)
        seen._table, seen.error = self._table @ slopes.T, slopes @ self.error @ slopes.T
        return seen

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        return np.asarray(self.with_slopes(x, y, log_radius)[0])

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, its slopes to x and y, and 0 for the radius."""
        rows, columns = self._table.shape[1:3]
        across = np.clip((x - self._corner[0]) / self._spacing, 0, columns - 1)
        along = np.clip((y - self._corner[1]) / self._spacing, 0, rows - 1)
        ix, iy = min(int(across), columns - 2), min(int(along), rows - 2)
        u, v = across - ix, along - iy
        block = self._table[:, iy : iy + 2, ix : ix + 2]
        weight = np.array([[(1 - u) * (1 - v), u * (1 - v)], [(1 - u) * v, u * v]])
        found = np.einsum("cyxk,yx->ck", block, weight)
        return np.concatenate([found, np.zeros_like(found[:1])])

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K) of nothing: what touches differ by is in `error`."""
        return np.zeros((SHAPES, self._table.shape[3]))


TouchModel = DiscResponse | MeasuredMap


class DiscGrid:
    """A discs, each with what it does to the measurements at unit action."""

    def __init__(self, response: TouchModel) -> None:
        self.discs = response.discs  # (A, 3) x, y, log radius
        self.responses: Single = np.array([response(*disc) for disc in self.discs], np.float32)  # (A, K)

    def through(self, slopes: Array) -> DiscGrid:
        """The same seen through a fault of the wires."""
        seen = copy(self)
        seen.responses = self.responses @ slopes.T.astype(np.float32)
        return seen

    def information(self, white: Whitening) -> Single:
        """(A,) of each disc's action: 1 / variance, where nothing else touches."""
        whitened = self.responses @ white.w.T.astype(np.float32)
        return np.asarray(np.einsum("ak,ak->a", whitened, whitened))

    def likeliest(self, weighted_residual: Array, information: Single) -> tuple[float, int, float]:
        """z^2, number and action of the disc that explains most of a residual; weighted_residual (K,): S^-1 of it."""
        along = np.maximum(self.responses @ weighted_residual.astype(np.float32), 0)
        z2 = along**2 / information
        best = int(z2.argmax())
        return float(z2[best]), best, float(along[best] / information[best])
