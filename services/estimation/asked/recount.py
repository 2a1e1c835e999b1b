"""Whether there are as many touches as an answer has, or fewer, or more. All are asked as if nothing were known: an
outline that was learnt while two pressed explains both at no cost. Plain discs find them, as outlines lead to wherever
one touch looks like two.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from models.measurement.fit import FoundTouches
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, TouchPrior, anywhere, plain
from services.estimation.asked.hypotheses import Hypotheses
from services.estimation.asked.question import (
    Question,
    ScoredAnswer,
    begun_as,
    likeliest,
    started,
    started_from,
)
from services.estimation.overlap import gaps, neighbours
from services.estimation.touches import oddness
from services.estimation.values import numbers as n

Array = NDArray[np.float64]

HALVED_ANGLES = np.arange(8) * np.pi / 8  # along which two discs are tried instead of one
HALVED_APART = (0.6, 1.0, 1.4)  # how far each lies from its middle, in radii


class Recount:
    """Of one skin, seen as its hypotheses see it."""

    def __init__(self, hypotheses: Hypotheses, least_gain: float) -> None:
        """least_gain: by which others must be likelier [nat]."""
        self._least_gain = least_gain
        self._hypotheses = copy(hypotheses)
        self._hypotheses.wide = False  # what explains everything would hide how many there are

    def __call__(self, question: Question, answer: ScoredAnswer) -> ScoredAnswer | None:
        """Other touches than those of an answer, where they are likelier: None where they are not."""
        assert answer.fit is not None
        ask, new = self._hypotheses, (-1,) * len(answer.fit)
        begun = begun_as(answer.fit, question.span_s)
        same = [ask.fitted(question, begun, new, n.STEPS_COLD)]
        if answer.wide:
            same.append(ask.fitted(question, begun, new, n.STEPS_COLD, wide=True))
        if answer.cause:
            same += ask.with_cause(question, begun, new, answer.cause, answer.left)
        discs = ask.fitted(question, [plain(prior) for prior in begun], new, n.STEPS_COLD)
        found = [discs, *ask.search(question, discs, begun)]
        enough = max(each.score for each in (*same, discs)) + self._least_gain
        assert same[0].fit is not None
        if (pair := neighbours(same[0].fit.states, new)) is not None:
            found += ask.merged(question, same[0], *pair)
        elif not any(other.explained and other.score > enough for other in found):
            oddest = np.argsort([-oddness(shape) for shape in answer.fit.shapes])
            for one in takewhile(lambda _: not question.spent, oddest):
                found += self._halved(question, begun, discs, int(one))
        if not any(other.explained for other in found):
            found += ask.search(question)
        others = [other for other in found if other.explained and _others(other.fit, answer.fit)]
        if not others or likeliest(others).score < enough:
            return None
        return likeliest(others)

    def _halved(
        self, question: Question, begun: Sequence[TouchPrior], discs: ScoredAnswer, one: int
    ) -> list[ScoredAnswer]:
        """Two discs instead of one: a disc beside one that lies between two leads to neither. begun: the touches of
        those discs, with their outlines.
        """
        fit = discs.fit
        if fit is None or len(fit) >= n.MOST_TOUCHES:
            return []
        halves = self._halves(question, fit, one)
        if not halves:
            return []
        as_discs, new = started_from(fit), (-1,) * (len(fit) + 1)
        rest = [k for k in range(len(fit)) if k != one]
        found = self._hypotheses.fitted(
            question, [*(as_discs[k] for k in rest), *map(plain, halves)], new, 2 * n.STEPS_COLD
        )
        outlined = started([*(begun[k] for k in rest), *halves], found.fit)
        both = found, self._hypotheses.fitted(question, outlined, new, n.STEPS_COLD)
        return [other for other in both if other.fit is not None and gaps(other.fit.states).min() > 0]

    def _halves(self, question: Question, fit: FoundTouches, one: int) -> list[TouchPrior]:
        """The two discs that explain most of what one does, on either side of its middle; empty where none do."""
        white, response = question.white, self._hypotheses.response
        others = [s[ACTION] * response(s[0], s[1], s[LOG_RADIUS]) for k, s in enumerate(fit.states) if k != one]
        target = white(np.where(question.live, np.expm1(question.y) - sum(others), 0.0))
        (x, y), radius = fit.states[one, PLACE], float(np.exp(fit.states[one, LOG_RADIUS]))
        small = float(fit.states[one, LOG_RADIUS]) - 0.5 * np.log(2.0)
        best, least = list[TouchPrior](), np.inf
        for angle in HALVED_ANGLES:
            for apart in HALVED_APART:
                way = apart * radius * np.array([np.cos(angle), np.sin(angle)])
                places = [(x + side * way[0], y + side * way[1]) for side in (-1, 1)]
                both = np.stack([response(*place, small) for place in places], axis=1)
                columns = white(np.where(question.live[:, None], both, 0.0))
                actions, left = nnls(columns, target)
                if left < least and actions.min() > 0:
                    least = left
                    best = [anywhere(*at, acts, question.span_s) for at, acts in zip(places, actions, strict=True)]
        return best


def _others(fit: FoundTouches | None, than: FoundTouches) -> bool:
    """Whether touches are others than some, or elsewhere."""
    if fit is None or len(fit) != len(than):
        return True
    for state in fit.states:
        away = np.hypot(*(than.states[:, PLACE] - state[PLACE]).T).min()
        if away > max(n.SAME_TOUCH, float(np.exp(state[LOG_RADIUS]))):
            return True
    return False
