"""Discs all over the skin: where something may touch, before anything is fitted."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.whitening import Whitening
from models.measurement.responses.response import TouchModel

Array = NDArray[np.float64]
Single = NDArray[np.float32]


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
