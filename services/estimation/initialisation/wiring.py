"""Are the board's wires as they belong when nothing is known of the skin yet? Its first scans, judged by evidence.

What each fault of the wires would make of the bundle's skin is held against what sound wires show, both with all that a
skin may differ by from its bundle (first/start.py) and with any touches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.measurement.responses.tables import SkinTables
from services.estimation.faults.table import BoardScan, WireTable, any_touches
from services.estimation.faults.wires import WireFault, WireMaps
from services.estimation.initialisation.start import LADDER, grain, smooth_field
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


class WiringTest:
    """Which fault of the wires explains the first scans. tables: of the skin's bundle."""

    def __init__(self, tables: SkinTables) -> None:
        self.maps = WireMaps(tables.pattern)
        self._tables, self._table = tables, WireTable(self.maps)
        self._covariances: list[Array] = []  # (K, K) of an untouched or touched skin, for differences of each size

    def __call__(self, log_z: Array, variance: Array, live: NDArray[np.bool_]) -> WireFault | None:
        """log_z (K,): mean of the first scans; variance (K,): of that mean; live (K,): what of it counts."""
        if not self.maps.knows or not self._tables.predicted or live.mean() < n.LEAST_LIVE:
            return None
        expected = np.log(self._tables.z0)
        predicted = expected + float(np.median((log_z - expected)[live]))
        times_s = np.zeros(len(log_z))
        scan = BoardScan(np.where(live, log_z, 0.0), predicted, ~live, np.ones_like(live), times_s, 1.0)
        if not self._table.suspicious(scan, None):
            return None
        if not self._covariances:
            self._covariances = covariances(self._tables)
        own = np.diag(np.where(live, variance, 1.0))
        best = dict[WireFault | None, float]()
        for times, covariance in zip(LADDER, self._covariances, strict=True):
            for guess in self._table.guesses(scan, None, covariance, own):
                score = guess.score - float(np.log(times))
                best[guess.fault] = max(best.get(guess.fault, -np.inf), score)
        return likeliest(best)


def likeliest(score: dict[WireFault | None, float]) -> WireFault | None:
    """The fault that is surely likelier than sound wires and than every other."""
    first, *others = sorted(score, key=lambda fault: -score[fault])
    if first is None or score[first] < score[None] + n.WIRE_SURE:
        return None
    apart = all(score[first] > score[other] + n.WIRE_APART for other in others)
    return first if apart else None


def covariances(tables: SkinTables) -> list[Array]:
    """(K, K) of log |Z| over what a skin and its bundle differ by, of each size, and touches anywhere."""
    contact = tables.contact * n.START_CONTACT
    base = contact @ contact.T + n.START_GAIN**2 + any_touches(tables.grid)
    base += n.START_FIELD**2 * smooth_field(tables) + n.START_GRAIN**2 * grain(tables)
    form = n.START_LAYER**2 * tables.layer @ tables.layer.T + n.START_ABSOLUTE**2 * np.eye(len(base))
    return [base + times**2 * form for times in LADDER]
