"""What a further disc would explain of what is left of a scan, and since when it would act."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.measurement.fit import FoundTouches
from models.measurement.grid import DiscGrid
from models.measurement.noise import BURST_BLOCK
from models.measurement.whitening import Whitening
from services.estimation.asked.question import ONSETS, Question
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


class LeftOver:
    """Of one skin; wrong: share of a touch's change that its response gets wrong."""

    def __init__(self, grid: DiscGrid, wrong: float) -> None:
        self._grid, self._wrong = grid, wrong

    def best(
        self,
        question: Question,
        pulled: Array,
        white: Whitening,
        fit: FoundTouches | None = None,
        onsets: Sequence[float] = (),
    ) -> tuple[float, int, float, float]:
        """z^2 of the disc that would explain most of a residual, its number, action, and since when it acts [s].
        onsets: shares of the scan after which it may have begun. One that acts in the whole scan is so unless that
        leaves more than its response gets wrong.
        """
        found = list[tuple[float, int, float, float]]()
        precision = white.conditional_precisions() if onsets else np.zeros(0)
        for share in (0.0, *onsets):
            weight, since_s = None, -np.inf
            information = question.information
            if share:
                since_s = (share - 0.5) * question.span_s
                weight = (question.times_s >= since_s).astype(float)
                information = information * self._grid_share(weight, precision)
            _, disc, _ = self._grid.likeliest(pulled, information, weight)
            column = self._grid.responses[disc].astype(float)
            column = column if weight is None else column * weight
            along = max(float(column @ pulled), 0.0)
            if fit is None:
                whitened = white(column)
                exact = float(whitened @ whitened)
            else:
                exact = fit.information(column)
            found.append((along**2 / exact - (n.ONSET_Z2 if share else 0.0), disc, along / exact, since_s))
        if not onsets:
            return found[0]
        begun = self._sharper(question, pulled, white, fit, max(found))
        return begun if begun[0] > found[0][0] * (1 + 2 * self._wrong) else found[0]

    def _sharper(
        self,
        question: Question,
        pulled: Array,
        white: Whitening,
        fit: FoundTouches | None,
        best: tuple[float, int, float, float],
    ) -> tuple[float, int, float, float]:
        """The same disc from the likeliest instant on: a strong touch tells it to a measurement or two, and none of its
        columns makes up for one that is off by more.
        """
        instants = question.instants
        column = self._grid.responses[best[1]].astype(float)
        columns = column[:, None] * (question.times_s[:, None] >= instants)
        along = np.maximum(columns.T @ pulled, 0.0)
        exact = np.sum(white(columns) ** 2, axis=0) if fit is None else fit.informations(columns)
        more = 2 * np.log(len(instants) / len(ONSETS))  # so many were looked at
        z2 = along**2 / np.maximum(exact, 1e-12) - n.ONSET_Z2 - more
        k = int(z2.argmax())
        if z2[k] <= best[0]:
            return best
        return float(z2[k]), best[1], float(along[k] / exact[k]), float(instants[k])

    def _grid_share(self, weight: Array, precision: Array) -> NDArray[np.float32]:
        """(A,) share of each disc's information that some measurements have, by their own precisions."""
        squares = self._grid.responses**2
        each = precision.astype(np.float32)
        return np.asarray(squares @ (each * weight.astype(np.float32)) / (squares @ each) + 1e-3)


def fresh(question: Question, pulled: Array, white: Whitening) -> float:
    """Energy of the newest block of measurements beyond what it is expected to have, all others given."""
    newest = question.order >= len(question.y) - BURST_BLOCK
    own = white.w[:, newest]
    energy = pulled[newest] @ np.linalg.solve(own.T @ own, pulled[newest])
    return float(energy) - BURST_BLOCK
