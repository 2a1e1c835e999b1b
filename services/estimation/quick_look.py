"""A first look at a scan on which nothing touches: by the whitening of a moment ago, so that it costs a product with a
vector. It only says that all is quiet; what is not goes the whole way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.measurement.grid import DiscGrid
from models.measurement.noise import BURST_BLOCK
from models.measurement.whitening import Whitening
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Glance:
    """Of scans that end with one part."""

    at_s: float
    white: Whitening
    newest: NDArray[np.bool_]  # (K,) of the newest block
    energy: Array  # (b, b) inverse of their precision: what their energy is taken by


@dataclass(frozen=True)
class Seen:
    """What a look found."""

    quiet: bool
    chi2: float
    z2: float
    pulled: Array  # (K,)


class QuickLook:
    """Keeps a whitening for each part; nothing that a replay would miss: it is made anew from what a scan knows."""

    def __init__(self, grid: DiscGrid) -> None:
        self._grid = grid
        self._glances: dict[int, Glance] = {}

    def forget(self) -> None:
        """The untouched skin is another."""
        self._glances.clear()

    def keep(self, part: int, at_s: float, white: Whitening, order: NDArray[np.intp]) -> None:
        newest = order >= len(order) - BURST_BLOCK
        own = white.w[:, newest]
        energy: Array = np.asarray(np.linalg.inv(own.T @ own), float)
        self._glances[part] = Glance(at_s, white, newest, energy)

    def look(self, part: int, at_s: float, y: Array, information: NDArray[np.float32]) -> Seen | None:
        """y (K,): log |Z| over the prediction, every measurement counts. None: nothing is known of such scans."""
        known = self._glances.get(part)
        if known is None or not 0 <= at_s - known.at_s < n.GLANCE_S:
            return None
        residual = known.white(y)
        pulled = known.white.w.T @ residual
        chi2 = float(residual @ residual) / len(y)
        newest = pulled[known.newest]
        fresh = float(newest @ known.energy @ newest) - len(newest)
        z2 = max(self._grid.likeliest(pulled, information)[0], fresh)
        return Seen(chi2 < n.QUIET and z2 < n.GLANCE_Z2, chi2, z2, pulled)
