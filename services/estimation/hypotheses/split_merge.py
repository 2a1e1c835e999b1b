"""Whether there are as many touches as an answer has, or fewer, or more. All are asked as if nothing were known: an
outline that was learnt while two pressed explains both at no cost. Plain discs find them, as outlines lead to wherever
one touch looks like two.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import takewhile

import numpy as np

from models.measurement.arrays import Array
from models.measurement.fit import FoundTouches
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, TouchPrior, anywhere, plain
from services.estimation.hypotheses.detector import DiscActions
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import Innovation, Priors, ScoredAnswer, begun_as, likeliest, started
from services.estimation.overlap import neighbours
from services.estimation.track import may_be_several, oddness
from services.estimation.values import numbers as n

HALVED_ANGLES = np.linspace(0, np.pi, 8, endpoint=False)  # along which two discs are tried instead of one
HALVED_APART = (0.6, 1.0, 1.4)  # how far each lies from its middle, in radii


class SplitMergeTest:
    """The evidence of more touches, or of fewer, than an answer has. Of one skin, seen as its hypotheses see it."""

    def __init__(self, hypotheses: Hypotheses, separate: bool, least_gain: float) -> None:
        """separate: of scans that stand by themselves: evidence alone decides, as no later one is asked again. Of
        others least_gain [nat] decides.
        """
        self._separate, self._least_gain = separate, 0.0 if separate else least_gain
        self._hypotheses = hypotheses

    def __call__(self, innovation: Innovation, answer: ScoredAnswer) -> ScoredAnswer | None:
        """Other touches than those of an answer, where they are likelier: None where they are not."""
        fit = answer.fit
        assert fit is not None
        ask, new = self._hypotheses, (-1,) * len(fit)
        begun = begun_as(fit, innovation.span_s)
        same = self._same(innovation, answer, begun)
        discs = ask.fitted(innovation, [plain(prior) for prior in begun], new)
        if answer.nearly_holds and not any(each.nearly_holds for each in (*same, discs)):
            return None  # what is known of its touches explains the scan: they change within it
        anew = (answer,) if answer.association == new else ()  # by what was known of none of them
        enough = max(each.score for each in (*same, discs, *anew)) + self._least_gain
        found = [discs, *ask.search(innovation, discs, begun)]
        assert same[0].fit is not None
        if (pair := neighbours(same[0].fit.states, new)) is not None:
            found += ask.merged(innovation, same[0], *pair)
        elif not any(other.explained and other.score > enough for other in found):
            for one in takewhile(lambda _: not innovation.spent, self._odd_ones(fit)):
                found += self._halved(innovation, discs, one)
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
        may = [k for k in range(len(fit)) if self._separate or may_be_several(fit.shapes[k])]
        return sorted(may, key=lambda k: -oddness(fit.shapes[k]))

    def _halved(self, innovation: Innovation, discs: ScoredAnswer, one: int) -> Iterator[ScoredAnswer]:
        """Two discs instead of one, as one beside it leads to neither; then all with their outlines."""
        fit = discs.fit
        halves = [] if fit is None or len(fit) >= n.MOST_TOUCHES else self._halves(innovation, fit, one)
        if fit is None or not halves:
            return
        others, as_discs = [k for k in range(len(fit)) if k != one], started(fit)
        association = (*(discs.association[k] for k in others), -1, -1)
        priors = [*(as_discs[k] for k in others), *map(plain, halves)]
        found = self._hypotheses.fitted(innovation, priors, association, 2 * n.STEPS_COLD)
        yield found
        begun = begun_as(fit, innovation.span_s)
        outlined = started(found.fit, [*(begun[k] for k in others), *halves])
        yield self._hypotheses.fitted(innovation, outlined, association)

    def _halves(self, innovation: Innovation, fit: FoundTouches, one: int) -> list[TouchPrior]:
        """The two discs beside its middle that explain most of what one does; empty where none explain more than it."""
        white, response = innovation.white, self._hypotheses.response
        live, times_s = innovation.live, innovation.times_s
        counts = [live & (times_s >= prior.since_s) & (times_s < prior.until_s) for prior in fit.priors]
        each = [s[ACTION] * response(s[0], s[1], s[LOG_RADIUS]) * c for s, c in zip(fit.states, counts, strict=True)]
        target = white(np.where(live, np.expm1(innovation.y), 0.0) - sum(each) + each[one])
        least = np.inf
        if not self._separate:
            least = float(np.sum((target - white(each[one])) ** 2))
            least -= 0.0 if innovation.whole else 2 * n.ANOTHER
        places, radius = _pairs(fit.states[one])
        columns = white(np.stack([response(x, y, radius) for x, y in places], axis=1) * counts[one][:, None])
        opposite = np.kron(np.eye(len(places) // 2), 1 - np.eye(2)) > 0
        discs = DiscActions(columns.T @ columns, columns.T @ target, float(target @ target), opposite)
        if not (pairs := discs.pairs()) or discs.left(pairs[0]) >= least:
            return []
        two = zip(places[pairs[0]], discs.solved(pairs[0], discs.along), strict=True)
        since_s, span_s = fit.priors[one].since_s, innovation.span_s
        return [replace(anywhere(x, y, action, span_s), since_s=since_s) for (x, y), action in two]


def _pairs(state: Array) -> tuple[Array, float]:
    """(2 n, 2) places, by twos on either side of the middle of a disc (7,), and log radius: both have its area."""
    radius, small = float(np.exp(state[LOG_RADIUS])), float(state[LOG_RADIUS]) - 0.5 * np.log(2.0)
    angles, apart = np.meshgrid(HALVED_ANGLES, HALVED_APART, indexing="ij")
    way = (radius * apart[..., None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)).reshape(-1, 1, 2)
    return (state[PLACE] + way * np.array([[-1.0], [1.0]])).reshape(-1, 2), small


def _others(fit: FoundTouches | None, than: FoundTouches) -> bool:
    """Whether touches are others than some, or elsewhere."""
    if fit is None or len(fit) != len(than):
        return True
    return any(
        np.hypot(*(than.states[:, PLACE] - state[PLACE]).T).min() > max(n.SAME_TOUCH, float(np.exp(state[LOG_RADIUS])))
        for state in fit.states
    )
