"""What a further disc would explain of what is left of a scan, and since when it would act."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.measurement.noise import BURST_BLOCK
from models.measurement.response import DiscGrid
from models.measurement.whitening import Whitening
from services.estimation.hypotheses.innovation import ONSETS, Innovation, ScoredAnswer
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


class Detection(NamedTuple):
    """A further disc of the grid."""

    z2: float
    disc: int
    action: float
    since_s: float  # it acts


class TouchDetector:
    """The generalised likelihood ratio of one further disc, over all discs of a grid and instants at which it may have
    begun. wrong: share of a touch's change that its response gets wrong.
    """

    def __init__(self, grid: DiscGrid, wrong: float) -> None:
        self._grid, self._wrong = grid, wrong
        self._squares = grid.responses**2

    def best(self, innovation: Innovation, answer: ScoredAnswer, onsets: Sequence[float] = ()) -> Detection:
        """The disc that would explain most of what an answer leaves. onsets: shares of the scan after which it may have
        begun. One that acts in the whole scan is so unless that leaves more than its response gets wrong.
        """
        weighted_residual = answer.weighted_residual
        since_s = np.array([-np.inf, *((share - 0.5) * innovation.span_s for share in onsets)])
        acts = (innovation.times_s[:, None] >= since_s).astype(np.float32)  # (K, n)
        shares = self._shares(acts, answer.white) if onsets else np.ones((1, 1), np.float32)
        along = np.maximum(self._grid.responses @ (acts * weighted_residual[:, None].astype(np.float32)), 0)
        discs = (along**2 / (innovation.information[:, None] * shares)).argmax(axis=0)  # (n,)
        columns = self._grid.responses[discs].T.astype(float) * acts
        along = np.maximum(weighted_residual @ columns, 0.0)
        exact = answer.informations(columns)
        z2 = along**2 / exact - np.where(since_s > -np.inf, float(n.ONSET_Z2), 0.0)
        found = zip(z2.tolist(), discs.tolist(), (along / exact).tolist(), since_s.tolist(), strict=True)
        whole, *begun = (Detection(*each) for each in found)
        if not begun:
            return whole
        sharper = self._sharper(innovation, answer, max(whole, *begun))
        return sharper if sharper.z2 > whole.z2 * (1 + 2 * self._wrong) else whole

    def _sharper(self, innovation: Innovation, answer: ScoredAnswer, best: Detection) -> Detection:
        """The same disc since the likeliest instant: a strong touch tells it to a measurement or two, and must."""
        instants = innovation.instants
        column = self._grid.responses[best.disc].astype(float)
        columns = column[:, None] * (innovation.times_s[:, None] >= instants)
        along, exact = np.maximum(columns.T @ answer.weighted_residual, 0.0), answer.informations(columns)
        more = 2 * np.log(len(instants) / len(ONSETS))  # so many were tried
        z2 = along**2 / np.maximum(exact, n.TINY) - n.ONSET_Z2 - more
        k = int(z2.argmax())
        if z2[k] <= best.z2:
            return best
        return Detection(float(z2[k]), best.disc, float(along[k] / exact[k]), float(instants[k]))

    def _shares(self, acts: NDArray[np.float32], white: Whitening) -> NDArray[np.float32]:
        """(A, n) share of each disc's information in the values in which it acts (K, n); the first acts in all."""
        precision = white.conditional_precisions().astype(np.float32)
        information = self._squares @ (precision[:, None] * acts)
        shares = information / information[:, :1] + np.float32(1e-3)
        shares[:, 0] = 1.0
        return np.asarray(shares)


def newest_z2(innovation: Innovation, answer: ScoredAnswer) -> float:
    """Energy of the newest block of measurements beyond what it is expected to have, all others given."""
    newest = innovation.order >= len(innovation.y) - BURST_BLOCK
    own, weighted_residual = answer.white.w[:, newest], answer.weighted_residual[newest]
    energy = weighted_residual @ np.linalg.solve(own.T @ own, weighted_residual)
    return float(energy) - BURST_BLOCK
