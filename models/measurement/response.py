"""What any response of touches offers, discs all over the skin, and the response that a registered skin was measured to
have; a disc's by its tables is models/measurement/tables.py:DiscResponse.
"""

from __future__ import annotations

from copy import copy
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from models.locator_arrays import LocatorArrays
from models.measurement.numbers import TYPICAL_RADIUS
from models.measurement.touch import SHAPES
from models.measurement.whitening import Whitening

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class TouchModel(Protocol):
    """Relative change of |Z| by a touch of unit action."""

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        ...

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, and its slopes to x, y and log radius."""
        ...

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K): in which a touch differs from the mean one, see models/measurement/touch.py."""
        ...

    @property
    def discs(self) -> Array:
        """(A, 3) x, y, log radius: where something may touch."""
        ...


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
        self.error = _of_touches(np.asarray(arrays.error, float), np.asarray(arrays.noise, float))
        iy, ix = np.nonzero(allowed)
        places = self._corner + self._spacing * np.column_stack([ix, iy])
        self._discs = np.column_stack([places, np.full(len(places), np.log(TYPICAL_RADIUS))])

    def through(self, slopes: Array) -> MeasuredMap:
        """The same seen through a fault of the wires; slopes (K, K)."""
        seen = copy(self)
        seen._table, seen.error = self._table @ slopes.T, slopes @ self.error @ slopes.T
        return seen

    @property
    def discs(self) -> Array:
        """(A, 3) all places of the map."""
        return self._discs

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        return np.asarray(self.with_slopes(x, y, log_radius)[0])

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, its slopes to x and y, and 0 for the radius."""
        rows, columns = self._table.shape[1:3]
        across = np.clip((x - self._corner[0]) / self._spacing, 0, columns - 1.001)
        along = np.clip((y - self._corner[1]) / self._spacing, 0, rows - 1.001)
        ix, iy = int(across), int(along)
        u, v = across - ix, along - iy
        block = self._table[:, iy : iy + 2, ix : ix + 2]
        weight = np.array([[(1 - u) * (1 - v), u * (1 - v)], [(1 - u) * v, u * v]])
        found = np.zeros((4, self._table.shape[3]))
        found[:3] = np.einsum("cyxk,yx->ck", block, weight)
        return found

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K) of nothing: what touches differ by is in `error`."""
        return np.zeros((SHAPES, self._table.shape[3]))


def _of_touches(error: Array, noise: Array) -> Array:
    """The part of an error's covariance that is not noise, without negative variances."""
    values, vectors = np.linalg.eigh(error - np.diag(noise**2))
    return np.asarray(vectors * np.maximum(values, 0.0) @ vectors.T)
