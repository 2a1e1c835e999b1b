"""What a further disc would explain of what is left of a scan, and since when it would act."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.noise import BURST_BLOCK
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import FoundTouches
from models.measurement.responses.response import DiscGrid
from services.estimation.hypotheses.innovation import ONSETS, Innovation
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


class TouchDetector:
    """The generalised likelihood ratio of one further disc, over all discs of a grid and instants at which it may have
    begun. wrong: share of a touch's change that its response gets wrong.
    """

    def __init__(self, grid: DiscGrid, wrong: float) -> None:
        self._grid, self._wrong = grid, wrong
        self._squares = grid.responses**2

    def best(
        self,
        innovation: Innovation,
        weighted_residual: Array,
        white: Whitening,
        fit: FoundTouches | None = None,
        onsets: Sequence[float] = (),
    ) -> tuple[float, int, float, float]:
        """z^2 of the disc that would explain most of a residual, its number, action, and since when it acts [s].
        onsets: shares of the scan after which it may have begun. One that acts in the whole scan is so unless that
        leaves more than its response gets wrong.
        """
        since_s = np.array([-np.inf, *((share - 0.5) * innovation.span_s for share in onsets)])
        acts = (innovation.times_s[:, None] >= since_s).astype(np.float32)  # (K, n)
        shares = self._shares(acts, white) if onsets else np.ones((1, 1), np.float32)
        along = np.maximum(self._grid.responses @ (acts * weighted_residual[:, None].astype(np.float32)), 0)
        discs = (along**2 / (innovation.information[:, None] * shares)).argmax(axis=0)  # (n,)
        columns = self._grid.responses[discs].T.astype(float) * acts
        exactly = np.maximum(weighted_residual @ columns, 0.0)
        exact = np.sum(white(columns) ** 2, axis=0) if fit is None else fit.informations(columns)
        z2 = exactly**2 / exact - np.where(since_s > -np.inf, float(n.ONSET_Z2), 0.0)
        found = list(zip(z2.tolist(), discs.tolist(), (exactly / exact).tolist(), since_s.tolist(), strict=True))
        if not onsets:
            return found[0]
        begun = self._sharper(innovation, weighted_residual, white, fit, max(found))
        return begun if begun[0] > found[0][0] * (1 + 2 * self._wrong) else found[0]

    def _sharper(
        self,
        innovation: Innovation,
        weighted_residual: Array,
        white: Whitening,
        fit: FoundTouches | None,
        best: tuple[float, int, float, float],
    ) -> tuple[float, int, float, float]:
        """The same disc from the likeliest instant on: a strong touch tells it to a measurement or two, and none of its
        columns makes up for one that is off by more.
        """
        instants = innovation.instants
        column = self._grid.responses[best[1]].astype(float)
        columns = column[:, None] * (innovation.times_s[:, None] >= instants)
        along = np.maximum(columns.T @ weighted_residual, 0.0)
        exact = np.sum(white(columns) ** 2, axis=0) if fit is None else fit.informations(columns)
        more = 2 * np.log(len(instants) / len(ONSETS))  # so many were looked at
        z2 = along**2 / np.maximum(exact, 1e-12) - n.ONSET_Z2 - more
        k = int(z2.argmax())
        if z2[k] <= best[0]:
            return best
        return float(z2[k]), best[1], float(along[k] / exact[k]), float(instants[k])

    def _shares(self, acts: NDArray[np.float32], white: Whitening) -> NDArray[np.float32]:
        """(A, n) share of each disc's information that the measurements have in which it acts (K, n), by their own
        precisions; the first acts in all.
        """
        precision = white.conditional_precisions().astype(np.float32)
        told = self._squares @ (precision[:, None] * acts)
        shares = told / told[:, :1] + np.float32(1e-3)
        shares[:, 0] = 1.0
        return np.asarray(shares)


def fresh(innovation: Innovation, weighted_residual: Array, white: Whitening) -> float:
    """Energy of the newest block of measurements beyond what it is expected to have, all others given."""
    newest = innovation.order >= len(innovation.y) - BURST_BLOCK
    own = white.w[:, newest]
    energy = weighted_residual[newest] @ np.linalg.solve(own.T @ own, weighted_residual[newest])
    return float(energy) - BURST_BLOCK
