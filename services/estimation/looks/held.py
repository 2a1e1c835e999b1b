"""A look at a part of a scan under touches that stay as they are: by the whitening of a moment ago, so that it costs
one warm fit. It only says that all goes on; what does not goes the whole way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.measurement.fit import KnownWhitening, Turned
from services.estimation.asked.question import AS_IT_IS, Question, ScoredAnswer
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeldGlance:
    """Of scans that are disturbed alike, under the same touches."""

    at_s: float
    ids: tuple[int, ...]
    covariance: Array  # (K, K) without touches
    white: KnownWhitening  # with them
    turned: Turned


class HeldLook:
    """Keeps what is needed of a scan that was explained; nothing that a replay would miss."""

    def __init__(self) -> None:
        self._glances: dict[int, HeldGlance] = {}

    def forget(self) -> None:
        """The untouched skin is another."""
        self._glances.clear()

    def keep(self, lines: int, at_s: float, ids: Sequence[int], question: Question, answer: ScoredAnswer) -> None:
        """lines: of which part a line's columns are, 0 without one."""
        if answer.fit is None or answer.cause != AS_IT_IS or not answer.explained:
            self._glances.pop(lines, None)
            return
        known = answer.fit.known
        self._glances[lines] = HeldGlance(at_s, tuple(ids), question.covariance, known, answer.fit.turned)

    def known(self, lines: int, at_s: float, ids: Sequence[int]) -> HeldGlance | None:
        """None: nothing is known of such scans."""
        found = self._glances.get(lines)
        if found is None or found.ids != tuple(ids) or not 0 <= at_s - found.at_s < n.GLANCE_S:
            return None
        return found
