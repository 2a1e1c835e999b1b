"""A first look at a scan on which nothing touches: by the whitening of a moment ago, so that it costs a product with a
vector. It only says that all is quiet; what is not goes the whole way.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.measurement.grid import DiscGrid
from models.measurement.noise import BURST_BLOCK
from models.measurement.whitening import Whitening
from services.estimation.values import numbers as n
from services.estimation.values.scan import Scan

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Newest:
    """The newest block of a scan's measurements."""

    rows: NDArray[np.intp]  # (b,)
    energy: Array  # (b, b) inverse of their precision: what their energy is taken by


@dataclass(frozen=True)
class Glance:
    """Of scans that are disturbed alike."""

    at_s: float
    white: Whitening
    newest: dict[int, Newest] = field(default_factory=dict)  # by the part measured last

    def newest_of(self, part: int, ages_s: Array) -> Newest:
        """ages_s (K,): of a scan that ends with this part."""
        known = self.newest.get(part)
        if known is None:
            rows = np.argpartition(ages_s, BURST_BLOCK)[:BURST_BLOCK]
            own = self.white.w[:, rows]
            known = self.newest[part] = Newest(rows, np.asarray(np.linalg.inv(own.T @ own), float))
        return known


@dataclass(frozen=True)
class Seen:
    """What a look found."""

    quiet: bool
    chi2: float
    z2: float
    pulled: Array  # (K,)


class QuickLook:
    """Keeps a whitening for all parts that are disturbed alike; nothing that a replay would miss."""

    def __init__(self, grid: DiscGrid) -> None:
        self._grid = grid
        self._glances: dict[int, Glance] = {}

    def forget(self) -> None:
        """The untouched skin is another."""
        self._glances.clear()

    def keep(self, alike: int, at_s: float, white: Whitening) -> None:
        """alike: as NoiseModel.alike."""
        self._glances[alike] = Glance(at_s, white)

    def look(self, alike: int, scan: Scan, at_s: float, y: Array, information: NDArray[np.float32]) -> Seen | None:
        """y (K,): log |Z| over the prediction, 0 where it does not count. None: nothing is known of such scans."""
        known = self._glances.get(alike)
        if known is None or not 0 <= at_s - known.at_s < n.GLANCE_S:
            return None
        residual = known.white(y)
        pulled = known.white.w.T @ residual
        chi2 = float(residual @ residual) / max(int(np.count_nonzero(y)), 1)
        newest = known.newest_of(scan.part, scan.ages_s)
        own = pulled[newest.rows]
        fresh = float(own @ newest.energy @ own) - len(own)
        z2 = max(self._grid.likeliest(pulled, information)[0], fresh)
        return Seen(chi2 < n.QUIET and z2 < n.GLANCE_Z2, chi2, z2, pulled)
