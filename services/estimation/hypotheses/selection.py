"""How one scan is asked about: touched or not, of a skin that predicts its touches or not, or one that is lost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from models.measurement.touch import anywhere
from services.estimation.filter import Prediction
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import (
    AS_IT_IS,
    Innovation,
    Observation,
    Priors,
    ScoredAnswer,
    StepBudget,
)
from services.estimation.hypotheses.split_merge import SplitMergeTest
from services.estimation.tared import TaredSkin
from services.estimation.values import numbers as n


class HypothesisSelection:
    """Which hypotheses are asked of one scan, and which of their answers is taken."""

    def __init__(self, skin: TaredSkin, measured: Observation, predicted: Prediction, unexplained_s: float) -> None:
        """unexplained_s: for how long nothing has explained the scans before."""
        self._skin, self._tables, self._measured = skin, skin.tables, measured
        self._predicted, self._unexplained_s = predicted, unexplained_s
        self._searched = False  # anew, whatever is tracked: once, it costs four scans' steps
        self._scans = round(unexplained_s / measured.span_s)  # that nothing explained
        self._due = not self._scans & (self._scans - 1)  # ever more seldom: at 1, 2, 4, 8 ... of them

    def answer(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """The likeliest one."""
        if not self._tables.predicted:
            return self._of_measured(hypotheses, innovation)
        if self._unexplained_s > n.LOST_S:
            return self._of_lost(hypotheses, innovation)
        return self._of_touched(hypotheses, innovation)

    def _of_touched(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        if not len(self._skin.touches):
            return self._of_untouched(hypotheses, innovation)
        tracked = self._skin.touches.expected(self._measured)
        manoeuvring = self._skin.touches.expected(self._measured, manoeuvring=True)
        if self._skin.touches.lost:
            return _judged_by_itself(hypotheses, innovation, tracked, manoeuvring)
        for answer in self._first_of_whole(hypotheses, innovation, tracked):
            if answer.explained:
                return answer
        return hypotheses.ask(innovation, tracked, manoeuvring)

    def _first_of_whole(
        self, hypotheses: Hypotheses, innovation: Innovation, tracked: Priors
    ) -> Iterator[ScoredAnswer]:
        """What is asked of a whole scan before all else."""
        if not self._measured.whole:
            return
        if self._unexplained_s > 0 and self._due and not self._searched:
            self._searched = True  # they may be others than those that are tracked
            yield self._from_nothing(hypotheses, innovation)
        if hypotheses.wide:  # they stay as they are, and their response is as wrong as it should be
            yield hypotheses.fitted(innovation, tracked, most_steps=n.STEPS_WARM, wide=False)

    def _of_untouched(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Where nothing touched: nothing does, or what presses again where foam remembers more than it may, or all."""
        quiet = hypotheses.untouched(innovation)
        memory = self._skin.drift.beyond_memory(self._predicted, quiet.weighted_residual, quiet.white)
        if memory is not None and self._measured.whole and self._skin.faults.now.wire is None:
            pressed = hypotheses.fitted(innovation, [anywhere(memory.x, memory.y, 0.0, innovation.span_s)], (-1,))
            if pressed.explained:
                return pressed
        return quiet if quiet.quiet else hypotheses.ask(innovation, (), ())

    def recounted(self, hypotheses: Hypotheses, innovation: Innovation, answer: ScoredAnswer) -> ScoredAnswer:
        """An answer, or rather more touches than it has, or fewer. Asked with steps of its own: what explains a scan
        badly has spent those of the scan, and would never be asked otherwise.
        """
        if not self._measured.whole or answer.fit is None or any(prior.until_s < np.inf for prior in answer.fit.priors):
            return answer
        separate = self._measured.scan.separate
        if not (_strained(answer) or self._skin.touches.claim_recount() or separate) or not (
            answer.explained or self._due
        ):
            return answer
        own = replace(innovation, budget=StepBudget.of(1.0, separate), keeps=0.0)
        recount = SplitMergeTest(hypotheses, separate)
        other = found = recount(own, answer)
        while other is not None and not own.spent:
            other = recount(own, other)
            found = other or found
        if found is None or found.fit is None:
            return answer
        if found.count < answer.count and self._skin.touches.meeting(self._measured):
            return answer  # they stood apart a moment ago: that they are several is known
        association = self._skin.touches.associated(found.fit, found.association)
        known = sum(place >= 0 for place in association)
        return replace(found, association=association, score=found.score - own.touch_log_prior * known, recounted=True)

    def _of_measured(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Of a skin whose touches no response tells, or one that real touches differ from by more than anybody knows.
        While something touches that nothing explains, all else is asked seldom.
        """
        map_known = self._tables.tells
        often = self._unexplained_s <= n.CHANGING_S or not self._scans % n.LOST_SCANS
        if not often:
            innovation.budget.left = 0.0
        elif map_known and len(self._skin.touches):
            return self._of_touched(hypotheses, innovation)
        found = hypotheses.of_unmodelled(innovation, self._skin.refused.now.column, often and not map_known)
        if found.quiet or not (often and map_known):
            return found
        return self._of_touched(hypotheses, innovation)

    def _of_lost(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """While nothing has explained the skin for long: a search now and then, from nothing."""
        self._skin.remember(self._skin.touches.forget(self._measured.oldest_s))
        found = hypotheses.glance(innovation)
        if found.quiet or not self._measured.whole or self._scans % n.LOST_SCANS:
            return found
        return self._from_nothing(hypotheses, innovation)

    def _from_nothing(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Whatever touches, with the steps of a scan that stands by itself."""
        return hypotheses.ask(replace(innovation, budget=StepBudget.of(1.0, separate=True), keeps=0.0), (), ())


def _judged_by_itself(
    hypotheses: Hypotheses, innovation: Innovation, tracked: Priors, manoeuvring: Priors
) -> ScoredAnswer:
    """After lost time, or a board's reset, nothing vouches for what touched before. The likeliest of: the touches that
    there were, which count as new ones; others, or none.
    """
    anew = hypotheses.ask(innovation.leaving(0.5), (), ())
    before = hypotheses.ask(innovation, tracked, manoeuvring)
    known = sum(place >= 0 for place in before.association)
    vouched = replace(before, score=before.score + innovation.touch_log_prior * known)
    return max((anew, vouched), key=lambda answer: (answer.holds, answer.score))


def _strained(answer: ScoredAnswer) -> bool:
    """Whether touches explain a scan only roughly, or with the help of something else."""
    return answer.cause != AS_IT_IS or not answer.explained or (answer.wide and -1 in answer.association)
