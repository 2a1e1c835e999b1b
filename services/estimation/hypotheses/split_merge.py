"""Whether there are as many touches as an answer has, or fewer, or more. All are asked as if nothing were known: an
outline that was learnt while two pressed explains both at no cost. Plain discs find them, as outlines lead to wherever
one touch looks like two.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from itertools import product, takewhile

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from models.measurement.fit import FoundTouches
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, TouchPrior, anywhere, plain
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import Innovation, Priors, ScoredAnswer, begun_as, likeliest, started
from services.estimation.overlap import gaps, neighbours
from services.estimation.track import oddness
from services.estimation.values import numbers as n

Array = NDArray[np.float64]

HALVED_ANGLES = np.linspace(0, np.pi, 8, endpoint=False)  # along which two discs are tried instead of one
HALVED_APART = (0.6, 1.0, 1.4)  # how far each lies from its middle, in radii


class SplitMergeTest:
    """The evidence of more touches, or of fewer, than an answer has. Of one skin, seen as its hypotheses see it."""

    def __init__(self, hypotheses: Hypotheses, separate: bool, least_gain: float) -> None:
        """separate: of scans that stand by themselves: evidence alone decides, and no later one is asked again. Of
        others least_gain [nat] decides.
        """
        self._separate, self._least_gain = separate, 0.0 if separate else least_gain
        self._hypotheses = copy(hypotheses)
        self._hypotheses.wide = False  # what explains everything would hide how many there are

    def __call__(self, innovation: Innovation, answer: ScoredAnswer) -> ScoredAnswer | None:
        """Other touches than those of an answer, where they are likelier: None where they are not."""
        fit = answer.fit
        assert fit is not None
        ask, new = self._hypotheses, (-1,) * len(fit)
        begun = begun_as(fit, innovation.span_s)
        same = self._same(innovation, answer, begun)
        discs = ask.fitted(innovation, [plain(prior) for prior in begun], new)
        enough = max(each.score for each in (*same, discs)) + self._least_gain
        found = [discs, *ask.search(innovation, discs, begun)]
        assert same[0].fit is not None
        if (pair := neighbours(same[0].fit.states, new)) is not None:
            found += ask.merged(innovation, same[0], *pair)
        elif not any(other.explained and other.score > enough for other in found):
            for one in takewhile(lambda _: not innovation.spent, self._odd_ones(fit)):
                found += self._halved(innovation, begun, discs, one)
        if not any(other.explained for other in found):
            found += ask.search(innovation)
        others = [other for other in found if other.explained and _others(other.fit, fit)]
        if not others or likeliest(others).score < enough:
            return None
        return likeliest(others)

    def _same(self, innovation: Innovation, answer: ScoredAnswer, begun: Priors) -> list[ScoredAnswer]:
        """As many touches, as they are and by what else the answer explains its scan with."""
        ask, new = self._hypotheses, (-1,) * len(begun)
        found = [ask.fitted(innovation, begun, new)]
        if answer.wide:
            found.append(ask.fitted(innovation, begun, new, wide=True))
        if answer.cause:
            found += ask.with_cause(innovation, begun, new, answer.cause, answer.residual)
        return found

    def _odd_ones(self, fit: FoundTouches) -> list[int]:
        """Which touches may be two discs, the oddest outline first: two that were followed as one are odd, where
        outlines are fitted.
        """
        odd = [oddness(shape) for shape in fit.shapes]
        may = [k for k in range(len(fit)) if self._separate or odd[k] > n.ODD_OUTLINE or not fit.shapes[k].any()]
        return sorted(may, key=lambda k: -odd[k])

    def _halved(self, innovation: Innovation, begun: Priors, discs: ScoredAnswer, one: int) -> list[ScoredAnswer]:
        """Two discs instead of one, as one beside it leads to neither. begun: the touches of those discs, outlined."""
        fit = discs.fit
        if fit is None or len(fit) >= n.MOST_TOUCHES:
            return []
        halves = self._halves(innovation, fit, one)
        if not halves:
            return []
        as_discs, new = started(fit), (-1,) * (len(fit) + 1)
        others = [k for k in range(len(fit)) if k != one]
        priors = [*(as_discs[k] for k in others), *map(plain, halves)]
        found = self._hypotheses.fitted(innovation, priors, new, 2 * n.STEPS_COLD)
        outlined = started(found.fit, [*(begun[k] for k in others), *halves])
        both = found, self._hypotheses.fitted(innovation, outlined, new)
        return [other for other in both if other.fit is not None and gaps(other.fit.states).min() > 0]

    def _halves(self, innovation: Innovation, fit: FoundTouches, one: int) -> list[TouchPrior]:
        """The two discs beside its middle that explain most of what one does; empty where none explain more than it."""
        white, response = innovation.white, self._hypotheses.response
        each = [s[ACTION] * response(s[0], s[1], s[LOG_RADIUS]) for s in fit.states]
        target = white(np.where(innovation.live, np.expm1(innovation.y) - sum(each) + each[one], 0.0))
        halves, least = list[TouchPrior](), np.inf
        if not self._separate:
            least = float(np.linalg.norm(target - white(np.where(innovation.live, each[one], 0.0))))
        for places, radius in _pairs(fit.states[one]):
            both = np.stack([response(*place, radius) for place in places], axis=1)
            actions, residual = nnls(white(np.where(innovation.live[:, None], both, 0.0)), target)
            if residual < least and actions.min() > 0:
                least = residual
                halves = [anywhere(*at, acts, innovation.span_s) for at, acts in zip(places, actions, strict=True)]
        return halves


def _pairs(state: Array) -> Iterator[tuple[list[tuple[float, float]], float]]:
    """Places of two discs on either side of the middle of one (7,), and log radius of each: both have its area."""
    (x, y), radius = state[PLACE], float(np.exp(state[LOG_RADIUS]))
    small = float(state[LOG_RADIUS]) - 0.5 * np.log(2.0)
    for angle, apart in product(HALVED_ANGLES, HALVED_APART):
        way = apart * radius * np.array([np.cos(angle), np.sin(angle)])
        yield [(x + side * way[0], y + side * way[1]) for side in (-1, 1)], small


def _others(fit: FoundTouches | None, than: FoundTouches) -> bool:
    """Whether touches are others than some, or elsewhere."""
    if fit is None or len(fit) != len(than):
        return True
    return any(
        np.hypot(*(than.states[:, PLACE] - state[PLACE]).T).min() > max(n.SAME_TOUCH, float(np.exp(state[LOG_RADIUS])))
        for state in fit.states
    )
