"""What any response of touches offers, a disc's or a map's that was measured; and discs all over the skin."""

from __future__ import annotations

from copy import copy
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.whitening import Whitening

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
