"""How one scan is asked about: touched or not, of a skin that predicts its touches or not, or one that is lost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.measurement.arrays import Array
from models.measurement.numbers import LINE_SCANS
from models.measurement.touch import anywhere
from models.measurement.whitening import Whitening
from services.estimation.faults.board import BoardView
from services.estimation.filter import Prediction
from services.estimation.hypotheses.hypotheses import Hypotheses
from services.estimation.hypotheses.innovation import (
    AS_IT_IS,
    Innovation,
    Observation,
    OpenTouch,
    Priors,
    ScoredAnswer,
    StepBudget,
    begun_as,
    likeliest,
    started,
)
from services.estimation.hypotheses.split_merge import SplitMergeTest
from services.estimation.tared import GridInformation, TaredSkin
from services.estimation.track import is_broad, oddness
from services.estimation.values import numbers as n


@dataclass
class HypothesisSelection:
    """Which hypotheses are asked of one scan, and which of their answers is taken."""

    skin: TaredSkin
    measured: Observation
    predicted: Prediction
    unexplained_s: float  # for which nothing has explained the scans before
    left_open: Sequence[OpenTouch]
    wholes: int  # whole scans since the tare
    searched: bool = False  # anew, whatever is tracked: once, it costs four scans' steps

    @property
    def _unexplained_scans(self) -> int:
        return round(self.unexplained_s / self.measured.span_s)

    @property
    def _due(self) -> bool:
        """Ever more seldom while nothing explains them: at 1, 2, 4, 8 ... scans."""
        return not self._unexplained_scans & (self._unexplained_scans - 1)

    def innovation(self, hypotheses: Hypotheses, view: BoardView, covariance: Array) -> Innovation:
        """Of a view of the scan; covariance (K, K): of its y."""
        skin, known, wire = self.skin, self.skin.grid_information, self.skin.faults.now.wire
        same = known is not None and np.array_equal(known.live, view.live) and known.wire == wire
        if known is None or not same or self.wholes - known.wholes >= LINE_SCANS:
            each = hypotheses.grid.information(Whitening.of(covariance))
            known = skin.grid_information = GridInformation(each, self.wholes, view.live, wire)
        candidates = tuple(candidate.begun(self.measured) for candidate in self.left_open)
        ids = skin.touches.ids
        places = tuple(ids.index(each.id) if each.id in ids else -1 for each in self.left_open)
        fields = replace(self.measured, live=view.live).fields
        wide = skin.touches.now.wide
        return Innovation(*fields, view.y, covariance, known.each, candidates, places, wide).leaving(n.FOR_FAULTS)

    def answer(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """The likeliest one."""
        if not self.skin.tables.predicted:
            return self._of_measured(hypotheses, innovation)
        if self.unexplained_s > n.LOST_S:
            return self._of_lost(hypotheses, innovation)
        return self._of_touched(hypotheses, innovation)

    def _of_touched(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        if not len(self.skin.touches):
            return self._of_untouched(hypotheses, innovation)
        tracked = self.skin.touches.expected(self.measured)
        manoeuvring = self.skin.touches.expected(self.measured, manoeuvring=True)
        if self.skin.touches.lost:
            return _judged_by_itself(hypotheses, innovation, tracked, manoeuvring)
        for answer in self._first(hypotheses, innovation, tracked):
            if answer.explained:
                return answer
        return hypotheses.ask(innovation, tracked, manoeuvring)

    def _first(self, hypotheses: Hypotheses, innovation: Innovation, tracked: Priors) -> Iterator[ScoredAnswer]:
        """What is asked before all else."""
        if self.unexplained_s > n.CHANGING_S:  # a track of then may explain that nothing touches, as one of no force
            yield hypotheses.untouched(innovation)
        if not self.measured.whole:
            return
        if self.unexplained_s > 0 and self._due and not self.searched:
            self.searched = True  # they may be others than those that are tracked
            yield self._from_nothing(hypotheses, innovation)
        if innovation.wide:  # they stay as they are, and their response is as wrong as it should be
            yield hypotheses.fitted(innovation, tracked, most_steps=n.STEPS_WARM, wide=False)

    def _of_untouched(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Where nothing touched: nothing does, or what presses again where foam remembers more than it may, or all."""
        quiet = hypotheses.untouched(innovation)
        memory = self.skin.drift.beyond_memory(self.predicted, quiet.weighted_residual, quiet.white)
        if memory is not None and self.measured.whole and self.skin.faults.now.wire is None:
            pressed = hypotheses.fitted(innovation, [anywhere(memory.x, memory.y, 0.0, innovation.span_s)], (-1,))
            if pressed.explained:
                return pressed
        return quiet if quiet.quiet else hypotheses.ask(innovation, (), ())

    def recounted(self, hypotheses: Hypotheses, innovation: Innovation, answer: ScoredAnswer) -> ScoredAnswer:
        """An answer, or more touches, or fewer, with steps of its own: a bad one has spent those of the scan."""
        if not self._recount_due(answer):
            return self._begun_recounted(hypotheses, innovation, answer) if self.measured.scan.part else answer
        separate, own = self.measured.scan.separate, self._with_own_steps(innovation)
        recount = SplitMergeTest(hypotheses, separate, self.skin.touches.recount_gain)
        other = found = recount(own, answer)
        while other is not None and not own.spent:
            other = recount(own, other)
            found = other or found
        if found is None or found.fit is None:
            return answer
        if found.count < answer.count and self.skin.touches.meeting(self.measured):
            return answer  # they stood apart a moment ago: that they are several is known
        return self._associated(own, found)

    def _begun_recounted(self, hypotheses: Hypotheses, innovation: Innovation, answer: ScoredAnswer) -> ScoredAnswer:
        """Of a part: an answer, or a likelier one of more discs where all touches have just begun, one odd or broad."""
        fit, lately_s = answer.fit, 1.5 * self.measured.span_s
        if fit is None or not answer.explained:
            return answer
        odd = any(map(is_broad, fit.states)) or max(map(oddness, fit.shapes)) > n.ODD_OUTLINE
        if not odd or any(prior.since_s < -lately_s or prior.until_s < np.inf for prior in fit.priors):
            return answer
        own, begun = self._with_own_steps(innovation), begun_as(fit, innovation.span_s)  # what parts told counts once
        found = hypotheses.several(own, min(prior.since_s for prior in begun), answer.count + 1)
        if found is not None and found.nearly_holds:
            priors = started(found.fit, begun_as(found.fit, innovation.span_s))
            found = likeliest([found, hypotheses.fitted(own, priors, found.association)])
        if found is None or not found.explained:
            return answer
        if found.score <= hypotheses.fitted(own, begun, (-1,) * len(begun)).score + n.RECOUNT_GAIN:
            return answer
        return self._associated(innovation, replace(found, over=answer.over + found.score - answer.score))

    def _with_own_steps(self, innovation: Innovation) -> Innovation:
        """To be recounted: a response that explains everything would hide how many there are."""
        return replace(innovation, budget=StepBudget.of(1.0, self.measured.scan.separate), keeps=0.0, wide=False)

    def _associated(self, own: Innovation, found: ScoredAnswer) -> ScoredAnswer:
        """An answer whose touches are others than those that stood, or stand where one of them does."""
        assert found.fit is not None
        association = self.skin.touches.associated(found.fit, found.association)
        known = sum(place >= 0 for place in association) - sum(place >= 0 for place in found.association)
        return replace(found, association=association, score=found.score - own.touch_log_prior * known, recounted=True)

    def _recount_due(self, answer: ScoredAnswer) -> bool:
        fit, whole, separate = answer.fit, self.measured.whole, self.measured.scan.separate
        if not whole or fit is None or any(prior.until_s < np.inf for prior in fit.priors):
            return False
        roughly = answer.cause != AS_IT_IS or not answer.explained or (answer.wide and -1 in answer.association)
        if not (answer.explained or self._due):  # asked then, it would count as asked
            return False
        return self.skin.touches.claim_recount() or roughly or separate

    def _of_measured(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Of a skin whose touches no response tells surely. While nothing explains scans, all else is asked seldom."""
        map_known = self.skin.tables.tells
        often = self.unexplained_s <= n.CHANGING_S or not self._unexplained_scans % n.LOST_SCANS
        if not often:
            innovation.budget.left = 0.0
        elif map_known and len(self.skin.touches):
            return self._of_touched(hypotheses, innovation)
        found = hypotheses.of_unmodelled(innovation, self.skin.refused.now.column, often and not map_known)
        if found.quiet or not (often and map_known):
            return found
        return self._of_touched(hypotheses, innovation)

    def _of_lost(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """While nothing has explained the skin for long: a search now and then, from nothing."""
        self.skin.remember(self.skin.touches.forget(self.measured.oldest_s))
        found = hypotheses.glance(innovation)
        if found.quiet or not self.measured.whole or self._unexplained_scans % n.LOST_SCANS:
            return found
        return self._from_nothing(hypotheses, innovation)

    def _from_nothing(self, hypotheses: Hypotheses, innovation: Innovation) -> ScoredAnswer:
        """Whatever touches, with the steps of a scan that stands by itself."""
        return hypotheses.ask(replace(innovation, budget=StepBudget.of(1.0, separate=True), keeps=0.0), (), ())


def _judged_by_itself(
    hypotheses: Hypotheses, innovation: Innovation, tracked: Priors, manoeuvring: Priors
) -> ScoredAnswer:
    """After a gap nothing vouches for the tracks: they count as new touches, and compete with others and with none."""
    anew = hypotheses.ask(innovation.leaving(0.5), (), ())
    before = hypotheses.ask(innovation, tracked, manoeuvring)
    known = sum(place >= 0 for place in before.association)
    vouched = replace(before, score=before.score + innovation.touch_log_prior * known)
    return max((anew, vouched), key=lambda answer: (answer.holds, answer.score))
