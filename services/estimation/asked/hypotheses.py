"""What may explain a scan, in order, all scored in one table of log evidence: nothing new; a touch that ended, moved or
began; faster drift; a disturbance; a response that is wrong by more. Each owns something wider than the filter's own
walk, so that none of them can be locked out. The likeliest of those that explain the scan is taken.

The order is a budget in solver steps, never in time: a replay decides as the session did.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from models.measurement.course import SUDDEN_STEPS, TURN_STEPS, TouchCourse
from models.measurement.covariance.noise import BURST_BLOCK, NoiseModel, in_blocks
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import LEAST_MEAN, FittedScan, KnownWhitening, TouchFitter, Turned
from models.measurement.numbers import LEAST_ACTION, MISFIT_WIDE
from models.measurement.responses.tables import SkinTables
from models.measurement.touch import (
    ACTION,
    AT_ONCE_S,
    LOG_RADIUS,
    PLACE,
    RATE,
    TouchPrior,
    acting_steadily,
    anywhere,
    plain,
)
from services.estimation.asked.left_over import LeftOver, fresh
from services.estimation.asked.question import (
    AS_IT_IS,
    BURST,
    COSTS,
    DRIFT,
    MEMORY,
    NOISE,
    Priors,
    Question,
    ScoredAnswer,
    likeliest,
    started,
    started_from,
)
from services.estimation.filter import SkinFilter
from services.estimation.overlap import apart, neighbours
from services.estimation.values import numbers as n

Array = NDArray[np.float64]

ON_ELECTRODE = ((0.03, 0.0), (0.03, 0.1), (0.03, -0.1))  # inside its edge and along it, where a search begins
SMALL_RADIUS = 0.1  # where it begins
RAMPS_S = (AT_ONCE_S, float(SUDDEN_STEPS[-1]), 2 * float(SUDDEN_STEPS[-1]))  # of a touch that ends within a scan
CAUSE_STEPS = 1  # that touches which are known need beside another cause
WIDER = (MEMORY, DRIFT, BURST, NOISE)


@dataclass(frozen=True)
class AChange:
    """How strongly one of the touches that stand acts, changed at once. at_s: -inf: before the scan; inf: one that was
    said to have ended goes on. left: what of it is left; 0: it ended.
    """

    touch: int
    at_s: float
    left: float


@dataclass(frozen=True)
class Releases:
    """Of one touch, at once, at each of several instants of a scan."""

    ends_s: Array  # (n,) from the middle of the scan; the first is its begin
    ramp_s: float  # for which it goes
    beside: Array  # (K,) relative change while it lasts, by all touches
    missing: Array  # (K, n) of that, after each

    def instant(self, at: int) -> float:
        """Of an end; -inf: before the scan."""
        return -np.inf if at == 0 and self.ramp_s == AT_ONCE_S else float(self.ends_s[at])


def _releases(
    course: TouchCourse, question: Question, prior: TouchPrior, own: Array, others: Array
) -> Iterator[Releases]:
    """own, others (K,): relative change by this touch as it stands, and by the other ones."""
    ends_s = np.concatenate([[-0.5 * question.span_s], question.instants])
    if prior.until_s < np.inf:
        own = course.columns(prior.start[None], [replace(prior, until_s=np.inf)]).mean
        ends_s = np.append(ends_s, np.inf)
    beside = others + own
    for ramp_s in RAMPS_S:
        acts = np.clip(0.5 + (ends_s - question.times_s[:, None]) / ramp_s, 0.0, 1.0)
        yield Releases(ends_s, ramp_s, beside, own[:, None] * (acts - 1))


class Hypotheses:
    """Of one skin."""

    def __init__(self, tables: SkinTables, noise: NoiseModel, drift: SkinFilter) -> None:
        self.grid, self.response, self.left_over = tables.grid, tables.response, LeftOver(tables.grid, tables.wrong)
        self._tables, self._noise, self._drift = tables, noise, drift
        self._slopes: Array | None = None
        # Touches that nothing explains for certain must not be taken for noise.
        self._wider = WIDER if tables.predicted else (MEMORY, DRIFT, BURST)
        self.adrift = 1.0  # times the faster drift: grows while nothing explains the skin
        self.wide = False  # the touches that stand were explained by a response that is wrong by more than it should be

    def through(self, slopes: Array) -> Hypotheses:
        """The same of a skin that is seen through a fault of the wires; slopes (K, K)."""
        seen = copy(self)
        seen._tables, seen.grid = self._tables.through(slopes), self.grid.through(slopes)
        seen.response = seen._tables.response
        seen.left_over = LeftOver(seen.grid, seen._tables.wrong)
        seen._slopes = slopes
        return seen

    def faster_drift(self) -> Array:
        """(K, K)"""
        faster = self._drift.faster(self.adrift)
        return faster if self._slopes is None else np.asarray(self._slopes @ faster @ self._slopes.T)

    # --- nothing touches ---

    def untouched(self, question: Question, cause: str = AS_IT_IS, more: Array | None = None) -> ScoredAnswer:
        """The answer that nothing touches; more (K, K): what a cause adds to the covariance."""
        white = question.white if more is None else Whitening.of(question.covariance + more)
        residual = white(question.y)
        pulled = white.w.T @ residual
        z2 = max(self.left_over.best(question, pulled, white)[0], fresh(question, pulled, white))
        score = white.log_density - 0.5 * float(residual @ residual) + COSTS[cause]
        chi2 = float(residual @ residual) / max(int(question.live.sum()), 1)
        if not self._tables.predicted:
            z2 = max(z2, float(n.FALSE_ALARM_Z2 / n.QUIET) * chi2)
        return ScoredAnswer(cause, None, (), chi2, z2, score, white, pulled, question.y)

    def _untouched(self, question: Question, causes: Sequence[str]) -> list[ScoredAnswer]:
        """The same, also by each of the causes that this skin has, where foam may remember as much."""
        added = [(cause, self._more(question, cause, question.y)) for cause in causes]
        found = [self.untouched(question, cause, more) for cause, more in added if more is not None]
        return [self.untouched(question), *(answer for answer in found if self._may_be(answer))]

    def _may_be(self, answer: ScoredAnswer) -> bool:
        """Whether foam may remember what an answer says that it does."""
        return answer.cause != MEMORY or self._drift.may_remember(answer.pulled)

    # --- something does ---

    def glance(self, question: Question) -> ScoredAnswer:
        """The likeliest answer that nothing touches, without a search."""
        return likeliest(self._untouched(question, self._wider))

    def untold(self, question: Question, pressed: Array, wider: bool) -> ScoredAnswer:
        """The same of a skin whose touches no response tells: else something touches. pressed (K,): change by what did
        so lately, of which foam may remember a share. wider: whether causes are asked that own more than the filter.
        """
        found = self.glance(question) if wider else self.untouched(question)
        if found.quiet or not pressed.any():
            return found
        column, white = np.where(question.live, pressed, 0.0), question.white
        along = white(column)
        share = float(along @ white(question.y)) / max(float(along @ along), LEAST_ACTION)
        again = self.untouched(replace(question, y=question.y - share * column))
        return again if again.quiet and abs(share) < n.MEMORY_MOST else found

    def slowly(self, question: Question) -> ScoredAnswer | None:
        """Touches that came while nothing was seen to touch, strong enough to be none of the field's own unevenness."""
        nothing = self.untouched(question)
        if nothing.left_z2 < n.FALSE_ALARM_Z2:
            return None
        found = self._from_nothing(question)
        best = likeliest(found) if found else nothing
        if best.fit is None or not best.explained or best.score < nothing.score + n.ANOTHER:
            return None
        return best if float(best.fit.states[:, ACTION].sum()) > n.START_SEEN else None

    def ask(self, question: Question, standing: Priors, loose: Priors) -> ScoredAnswer:
        """The likeliest answer. standing, loose: what is known of the touches that there were, as they were and where
        they may have begun to move or to change.
        """
        if standing:
            answers = self._of_standing(question, standing, loose)
        else:
            answers = [*self._untouched(question, self._wider), *self._from_nothing(question)]
        if not _settled(question, answers):
            answers += self._of_anything(question, standing, answers)
        best = likeliest(answers)
        if standing:
            return best
        return replace(best, over=best.score - max(answer.score for answer in answers if answer.fit is None))

    def narrow(self, question: Question, standing: Priors) -> ScoredAnswer:
        """The answer that touches stay as they are, by a response that is wrong by no more than it should be."""
        return self.fitted(question, standing, tuple(range(len(standing))), n.STEPS_WARM, wide=False)

    def goes_on(self, question: Question, standing: Priors, known: KnownWhitening, turned: Turned) -> ScoredAnswer:
        """The answer that touches stay as they are; known, turned: of a moment ago, when they did."""
        everyone = tuple(range(len(standing)))
        return self.fitted(question, standing, everyone, n.STEPS_HELD, known=known, turned=turned)

    def at(self, question: Question, x: float, y: float) -> ScoredAnswer:
        """The answer that something touches there."""
        return self.fitted(question, [anywhere(x, y, 0.0, question.span_s)], (-1,), n.STEPS_COLD)

    def on_electrode(self, question: Question, place: Array, second: Array) -> ScoredAnswer:
        """The likeliest small touch on an electrode. place (2,): its middle; second (K, n): what a touch does there
        by the square of its action.
        """
        out = place / max(float(np.hypot(*place)), LEAST_ACTION)
        found: ScoredAnswer | None = None
        for inside, along in ON_ELECTRODE:
            x, y = place - inside * out + along * np.array([-out[1], out[0]])
            prior = anywhere(float(x), float(y), 0.0, question.span_s)
            prior.start[LOG_RADIUS] = np.log(SMALL_RADIUS)
            action = 0.0 if found is None or found.fit is None else float(found.fit.states[0, ACTION])
            more = action**2 * second
            wider = replace(question, covariance=question.covariance + more @ more.T)
            answer = self.fitted(wider, [prior], (-1,), n.STEPS_COLD)
            if found is None or answer.score > found.score:
                found = answer
        assert found is not None
        return found

    def without(self, question: Question, standing: Priors, place: int) -> ScoredAnswer:
        """The answer that one of the touches is none: there is nothing, or it is drift, or what foam remembers."""
        kept = tuple(k for k in range(len(standing)) if k != place)
        if not kept:
            return likeliest(self._untouched(question, (DRIFT, MEMORY)))
        priors = [standing[k] for k in kept]
        answers = [self.fitted(question, priors, kept, n.STEPS_WARM)]
        for cause in (DRIFT, MEMORY):
            answers += self.with_cause(question, priors, kept, cause, question.y, n.STEPS_WARM)
        return likeliest(answers)

    def _from_nothing(self, question: Question) -> list[ScoredAnswer]:
        """Touches where none were: first those that the scan before left open, as a search has no steps for all."""
        found, count = list[ScoredAnswer](), len(question.candidates)
        for begun in (question.candidates, self._begun_otherwise(question, question.candidates)) if count else ():
            if begun is not None and not _settled(question, found):
                found.append(self.fitted(question, begun, (-1,) * count, n.STEPS_WARM))
        settled = question.spent or (count == 1 and _settled(question, found))
        return found if settled else [*found, *self.search(question)]

    def _of_standing(self, question: Question, standing: Priors, loose: Priors) -> list[ScoredAnswer]:
        answers = list[ScoredAnswer]()
        for further in self._of_changes(question, standing, loose):
            answers += further
            if _settled(question, answers):
                return answers
        return answers + self._beside_standing(question, standing, loose, answers)

    def _of_changes(self, question: Question, standing: Priors, loose: Priors) -> Iterator[list[ScoredAnswer]]:
        """The same touches, one way after the other: as they were, gone, begun, changed or ended at once, moved."""
        everyone = tuple(range(len(standing)))
        unchanged = self.fitted(question, standing, everyone, n.STEPS_WARM)
        yield [unchanged]
        yield [self.untouched(question)]  # costs no step
        if -1 in question.places:
            yield self._continued(question, loose)
        if (begun := self._begun_otherwise(question, standing)) is not None:
            yield [self.fitted(question, begun, everyone, n.STEPS_COLD)]
        end, turn = self._changes(question, standing, unchanged)
        late = end is None or end.at_s > _turns_s(question) + TURN_STEPS[0]
        ways = (self._released, end), (self._turned, turn)
        for how, change in reversed(ways) if late else ways:
            yield how(question, standing, change)
        yield [self.fitted(question, loose, everyone, n.STEPS_COLD)]

    def _beside_standing(
        self, question: Question, standing: Priors, loose: Priors, before: Sequence[ScoredAnswer]
    ) -> list[ScoredAnswer]:
        """Further touches beside those that stand, or a disturbance; before: the answers without."""
        everyone = tuple(range(len(standing)))
        expected = self.fitted(question, standing, everyone, 0)
        causes = CAUSE_STEPS * len(self._wider) * len(loose)  # a search must not spend theirs
        found = self.search(replace(question, keeps=question.keeps + causes), expected)
        left = likeliest([*before, *found]).left
        for cause in self._affordable(question):
            found += self.with_cause(question, loose, everyone, cause, left)
        return found

    def _continued(self, question: Question, loose: Priors) -> list[ScoredAnswer]:
        """What nearly explained the part before, a step further: those that stand, and the new ones beside them; or
        foam remembers more of what went.
        """
        priors, kept = list(loose), list(range(len(loose)))
        for candidate, place in zip(question.candidates, question.places, strict=True):
            if place < 0:
                priors.append(candidate)
                kept.append(-1)
            else:
                priors[place] = replace(priors[place], start=candidate.start)
        found = self.fitted(question, priors, tuple(kept), n.STEPS_COLD)
        everyone = tuple(range(len(loose)))
        return [found, *self.with_cause(question, loose, everyone, MEMORY, question.y, n.STEPS_WARM)]

    def _of_anything(self, question: Question, standing: Priors, before: Sequence[ScoredAnswer]) -> list[ScoredAnswer]:
        """Where what was known does not help: touches from nothing, beside a disturbance, by a wrong response."""
        found = self._from_nothing(question) if standing else []
        if _settled(question, found):
            return found
        touched = [answer for answer in [*before, *found] if answer.fit is not None]
        if not touched:
            return found
        best = likeliest(touched)
        assert best.fit is not None
        again = started_from(best.fit)
        for cause in self._affordable(question):
            found += self.with_cause(question, again, best.kept, cause, best.left)
        found.append(self.fitted(question, again, best.kept, n.STEPS_COLD, wide=True))
        return found

    def _affordable(self, question: Question) -> Iterator[str]:
        """The wider causes, as long as there are steps for them."""
        return takewhile(lambda _: not question.spent, self._wider)

    def with_cause(
        self,
        question: Question,
        priors: Priors,
        kept: tuple[int, ...],
        cause: str,
        left: Array,
        most_steps: float = n.STEPS_COLD,
    ) -> list[ScoredAnswer]:
        """Empty where this skin has no such cause, or foam no such memory."""
        more = self._more(question, cause, left)
        if more is None:
            return []
        wider = replace(question, covariance=question.covariance + more)
        answer = self.fitted(wider, priors, kept, most_steps, cause)
        return [answer] if self._may_be(answer) else []

    def _more(self, question: Question, cause: str, left: Array) -> Array | None:
        """(K, K) what a cause adds to the covariance; left (K,): the residual that it is to explain."""
        if cause == DRIFT:
            return self.faster_drift()
        if cause == MEMORY:
            return self._drift.more_memory()
        if cause == BURST:
            lines = self._noise.disturbing(question.part)
            return in_blocks(lines, question.order, n.BURST) if lines.shape[1] else None
        return self._grown(question, left)

    def _grown(self, question: Question, left: Array) -> Array | None:
        """Each block of measurements with a noise of its own."""
        block = question.order // BURST_BLOCK
        count = np.bincount(block)
        expected = np.bincount(block, np.diag(question.covariance)) / count
        excess = np.maximum(np.bincount(block, left**2) / count - expected, 0.0)
        excess[excess < 2 * expected] = 0.0
        if not excess.any() or excess.max() > n.MOST_NOISE**2:  # under more nothing would be seen
            return None
        return np.diag(excess[block])

    # --- fits ---

    def fitted(
        self,
        question: Question,
        priors: Priors,
        kept: tuple[int, ...],
        most_steps: float,
        cause: str = AS_IT_IS,
        wide: bool | None = None,
        known: KnownWhitening | None = None,
        turned: Turned | None = None,
    ) -> ScoredAnswer:
        wide = self.wide if wide is None else wide
        course = TouchCourse(self.response, question.times_s, question.span_s)
        live = int(question.live.sum())
        misfit = max(float(MISFIT_WIDE), 2 * self._tables.wrong) if wide else self._tables.wrong
        covariance = question.covariance if self._tables.map is None else question.covariance + self._tables.map.error
        scene = FittedScan(question.y, covariance, course, self._tables.misfit, live, known, turned, question.said_s)
        may = max(0.0, question.budget.left - question.keeps) / len(priors)
        fit = TouchFitter(scene, priors, misfit).fit(min(int(most_steps), int(may)))
        question.budget.left -= (fit.steps + 1) * len(fit)
        z2 = self.left_over.best(question, fit.pulled, fit.white, fit)[0]
        cost = n.COST_WIDE if wide and not self.wide else COSTS[cause]
        score = fit.evidence + cost + question.touch_log_prior * sum(place < 0 for place in kept)
        near = question.by_evidence and not apart(fit.states, kept)
        return ScoredAnswer(
            cause, fit, kept, fit.chi2, z2, score, fit.white, fit.pulled, fit.left, near=near, wide=wide
        )

    def search(
        self, question: Question, before: ScoredAnswer | None = None, outlined: Priors | None = None
    ) -> list[ScoredAnswer]:
        """Further touches than those of an answer, one after the other: plain discs find them, their own outlines and
        evidence decide. outlined: the touches of that answer, free to be no discs; None: as it has them.
        """
        found, discs = list[ScoredAnswer](), _unsearched(question) if before is None else before
        priors = started_from(discs.fit) if outlined is None else list(outlined)
        while (new := self._next_disc(question, discs)) is not None:
            priors, kept = [*priors, new], (*discs.kept, -1)
            # The next parts tell one outline from two discs.
            if discs.fit is None and question.part and new.since_s > 0:
                found.append(self.fitted(question, priors, kept, n.STEPS_COLD))
                if found[0].explained:
                    break
            more = self.fitted(question, [*started_from(discs.fit), plain(new)], kept, n.STEPS_COLD)
            if more.score < discs.score + question.least_gain:
                break
            discs = more
            found += self._outlined(question, priors, discs)
            if discs.explained and not question.by_evidence:
                break
        return found

    def _next_disc(self, question: Question, discs: ScoredAnswer) -> TouchPrior | None:
        """The likeliest one in what others leave; None where it would not be seen, or may not be looked for."""
        if discs.count >= n.MOST_TOUCHES or question.spent:
            return None
        z2, disc, action, since_s = self.left_over.best(question, discs.pulled, discs.white, discs.fit, question.onsets)
        if z2 < question.least_z2:
            return None
        x, y = self.grid.discs[disc, PLACE]
        return replace(anywhere(x, y, action, question.span_s), since_s=since_s)

    def _outlined(self, question: Question, priors: Priors, discs: ScoredAnswer) -> list[ScoredAnswer]:
        """Touches that were found as discs with outlines of their own. By evidence each may be a disc, or odder than
        outlines go.
        """
        kept = discs.kept
        outlined = self.fitted(question, started(priors, discs.fit), kept, n.STEPS_COLD)
        assert outlined.fit is not None
        found = [outlined]
        if question.by_evidence:
            found[0] = replace(outlined, score=max(outlined.score, discs.score))
        found += self._wide(question, outlined)
        if (pair := neighbours(outlined.fit.states, kept)) is not None:
            found += self.merged(question, outlined, *pair)
        return found

    def _wide(self, question: Question, answer: ScoredAnswer) -> list[ScoredAnswer]:
        """The same touches by a response that is wrong by more, where that is asked and theirs leaves something."""
        if not question.by_evidence or answer.chi2 <= n.GOOD:
            return []
        return [self.fitted(question, started_from(answer.fit), answer.kept, n.STEPS_COLD, wide=True)]

    def merged(self, question: Question, answer: ScoredAnswer, a: int, b: int) -> list[ScoredAnswer]:
        """One outlined touch for two discs."""
        assert answer.fit is not None
        states = answer.fit.states
        acts = np.maximum(states[[a, b], ACTION], LEAST_ACTION)
        x, y = acts @ states[[a, b], PLACE] / acts.sum()
        one = anywhere(float(x), float(y), float(acts.sum()), question.span_s)
        one.start[LOG_RADIUS] = 0.5 * np.logaddexp(2 * states[a, LOG_RADIUS], 2 * states[b, LOG_RADIUS])
        priors = started_from(answer.fit)
        priors[a] = replace(one, since_s=min(priors[a].since_s, priors[b].since_s))
        del priors[b]
        kept = tuple(place for k, place in enumerate(answer.kept) if k != b)
        one_less = self.fitted(question, priors, kept, n.STEPS_COLD)
        return [one_less, *self._wide(question, one_less)]

    def _begun_otherwise(self, question: Question, standing: Priors) -> list[TouchPrior] | None:
        """A touch that began within these values did so at another instant than the first of them told; None where
        none did. The instant is the likeliest, whatever the action.
        """
        first_s = -0.5 * question.span_s
        young = [k for k, prior in enumerate(standing) if prior.since_s > first_s and prior.until_s == np.inf]
        if not young:
            return None
        course = TouchCourse(self.response, question.times_s, question.span_s)
        priors = list(standing)
        instants = question.instants
        for k in young:
            everyone = np.stack([prior.start for prior in priors])
            lasting = replace(priors[k], since_s=-np.inf)
            steady = lasting.start.copy()
            steady[RATE:] = 0.0
            others = [prior for other, prior in enumerate(priors) if other != k]
            beside = course.columns(np.delete(everyone, k, axis=0), others).mean if others else 0.0
            own = course.columns(steady[None], [lasting]).mean
            columns = own[:, None] * (question.times_s[:, None] >= instants)
            seen = question.white(np.where(question.live, np.expm1(question.y) - beside, 0.0))
            whitened = question.white(columns)
            along = np.maximum(whitened.T @ seen, 0.0)
            at = int((along**2 / np.maximum(np.sum(whitened**2, axis=0), 1e-12)).argmax())
            priors[k] = replace(priors[k], since_s=float(instants[at]))
        return priors

    def _turned(self, question: Question, standing: Priors, turn: AChange | None) -> list[ScoredAnswer]:
        """How strongly they act changed at once: one of them in mid-scan, or any at its end, as they go or are pressed
        harder.
        """
        priors = list(standing)
        for k, prior in enumerate(standing):
            # Until then it acts as it did, since a scan before this one: else two that begin would look like one.
            if prior.until_s < np.inf or prior.since_s >= -1.5 * question.span_s:
                continue
            if turn is None:
                steady = acting_steadily(prior, float(prior.start[ACTION]), question.span_s)
                priors[k] = replace(steady, turns_s=_turns_s(question))
            elif turn.touch == k:
                most = max(1.0, turn.left) * float(prior.start[ACTION])
                steady = acting_steadily(prior, most, question.span_s)
                priors[k] = replace(steady, turns_s=turn.at_s, grows=turn.left > 1)
        if all(now is before for now, before in zip(priors, standing, strict=True)):
            return []
        return [self.fitted(question, priors, tuple(range(len(priors))), n.STEPS_COLD)]

    def _released(self, question: Question, standing: Priors, end: AChange | None) -> list[ScoredAnswer]:
        """One of the touches ended at once within the scan, or before it; empty where none did."""
        if end is None:
            return []
        priors, kept = list(standing), list(range(len(standing)))
        if end.at_s > -np.inf:
            went = priors[end.touch]
            if end.at_s < np.inf:
                went = acting_steadily(went, float(went.start[ACTION]), question.span_s)
            priors[end.touch] = replace(went, until_s=end.at_s)
        else:
            del priors[end.touch], kept[end.touch]
        if priors:
            return [self.fitted(question, priors, tuple(kept), n.STEPS_COLD)]
        return [self.untouched(question)]

    def _changes(
        self, question: Question, standing: Priors, answer: ScoredAnswer
    ) -> tuple[AChange | None, AChange | None]:
        """The end of one of the touches that leaves least of a scan, and the other change of one that leaves less than
        half as much; None where none leaves half of what they leave as they are. One that has ended did so at another
        instant than the first values after it told, or not at all.
        """
        course = TouchCourse(self.response, question.times_s, question.span_s)
        each = [course.columns(prior.start[None], [prior]).mean for prior in standing]
        whole = np.sum(each, axis=0)
        end, turn = None, None
        least = turned = 0.5 * self._unlike(question, answer, whole[:, None])[0]
        for k, prior in enumerate(standing):
            for tried in _releases(course, question, prior, each[k], whole - each[k]):
                chi2 = self._unlike(question, answer, tried.beside[:, None] + tried.missing)
                at = int(chi2.argmin())
                if chi2[at] < least:
                    end, least = AChange(k, tried.instant(at), 0.0), float(chi2[at])
                if prior.until_s < np.inf:
                    continue
                share = self._share(question, answer, tried.beside, tried.missing)
                chi2 = self._unlike(question, answer, tried.beside[:, None] + share * tried.missing)
                at = int(chi2.argmin())
                if chi2[at] < min(turned, 0.5 * least, 0.5 * chi2[0]):  # by more than one that changed before the scan
                    turn, turned = AChange(k, float(tried.ends_s[at]), 1 - float(share[at])), float(chi2[at])
        return end, turn if turned < 0.5 * least or end is None else None

    def _share(self, question: Question, answer: ScoredAnswer, change: Array, gone: Array) -> Array:
        """(n,) of what would go (K, n) beside a change (K,), by which the residual is least."""
        change = np.maximum(change, LEAST_MEAN)
        counts = np.where(question.live, 1 / (1 + change), 0.0)
        left = answer.white(np.where(question.live, question.y - np.log1p(change), 0.0))
        columns = answer.white(gone * counts[:, None])
        return np.asarray((left @ columns) / np.maximum(np.sum(columns**2, axis=0), 1e-12))

    def _unlike(self, question: Question, answer: ScoredAnswer, changes: Array) -> Array:
        """(n,) squared sigmas of what changes (K, n) leave of a scan, by the covariance of an answer."""
        left = np.where(question.live, question.y, 0.0)[:, None] - np.log1p(np.maximum(changes, LEAST_MEAN))
        left[~question.live] = 0.0
        return np.asarray(np.sum(answer.white(left) ** 2, axis=0))


def _unsearched(question: Question) -> ScoredAnswer:
    """That nothing touches, not scored: any touch is likelier."""
    white, y = question.white, question.y
    return ScoredAnswer(AS_IT_IS, None, (), np.inf, np.inf, -np.inf, white, white.solve(y), y)


def _turns_s(question: Question) -> float:
    """About which touches may change at once: what does so earlier the scan or the part before has shown."""
    return 0.5 * question.span_s + float(SUDDEN_STEPS[0])


def _settled(question: Question, answers: Sequence[ScoredAnswer]) -> bool:
    return question.spent or any(answer.explained for answer in answers)
