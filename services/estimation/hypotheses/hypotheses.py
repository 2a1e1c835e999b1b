"""What may explain a scan, in order, all scored in one table of log evidence: nothing new; a touch that ended, moved or
began; faster drift; a disturbance; a response that is wrong by more. The likeliest of those that explain it is taken.
Each owns something wider than the filter's own walk, so that none can be locked out. How many are asked is a budget in
solver steps, never in time: a replay decides as the session did.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import combinations, takewhile

import numpy as np

from models.measurement.arrays import Array
from models.measurement.course import SUDDEN_STEPS, TURN_STEPS, TouchCourse
from models.measurement.fit import LEAST_MEAN, FittedScan, FoundTouches, TouchFitter
from models.measurement.noise import BURST_BLOCK, NoiseModel, in_blocks
from models.measurement.numbers import AT_ONCE_S, LEAST_ACTION, MISFIT_WIDE
from models.measurement.tables import SkinTables
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, TouchPrior, acting_steadily, anywhere, plain
from models.measurement.whitening import Whitening
from services.estimation.faults.wires import WireFault
from services.estimation.filter import SkinFilter
from services.estimation.hypotheses.detector import Detection, TouchDetector, newest_z2
from services.estimation.hypotheses.innovation import (
    AS_IT_IS,
    BURST,
    DRIFT,
    LOG_PRIORS,
    MEMORY,
    NOISE,
    ONSETS,
    Innovation,
    Priors,
    ScoredAnswer,
    begun_as,
    likeliest,
    started,
)
from services.estimation.overlap import apart, neighbours
from services.estimation.values import numbers as n

INSIDE, SMALL_RADIUS = 0.03, 0.1  # of an electrode's edge, and of a touch on it, where a search begins [unit]
RAMPS_S = (AT_ONCE_S, float(SUDDEN_STEPS[-1]), 2 * float(SUDDEN_STEPS[-1]))  # of a touch that ends within a scan
CAUSE_STEPS = 1  # that touches which are known need beside another cause
WIDER = (MEMORY, DRIFT, BURST, NOISE)


@dataclass(frozen=True)
class StrengthStep:
    """Tracked touches act otherwise at once. at_s: -inf: before the scan; inf: one that was taken for ended goes on.
    share: of their action after that; 0: they ended.
    """

    touches: tuple[int, ...]
    at_s: float
    share: float
    chi2: float  # that it leaves, in all


def _least(steps: Sequence[StrengthStep], below: float) -> StrengthStep | None:
    """Of those that leave less than that the one that leaves least, where each further touch must halve it."""
    enough = [step for step in steps if step.chi2 < below]
    return min(enough, key=lambda step: step.chi2 * 2 ** len(step.touches), default=None)


def _together(tracked: Priors) -> Iterator[tuple[int, ...]]:
    """Which touches may change at once: each, and of those that have not ended all, or all but one, as by one hand."""
    lasting = [k for k, prior in enumerate(tracked) if prior.until_s == np.inf]
    yield from ((k,) for k in range(len(tracked)))
    for count in range(max(2, len(lasting) - 1), len(lasting) + 1):
        yield from combinations(lasting, count)


def _releases(
    course: TouchCourse, innovation: Innovation, prior: TouchPrior, own: Array, others: Array
) -> Iterator[tuple[Array, Array, Array]]:
    """Of a touch that ends at once, for each of some ramps: (n,) instants; (K,) relative change by all touches before;
    (K, n) what of it is missing after each. own, others (K,): by this touch as it goes on, and by the other ones.
    """
    ends_s = np.concatenate([[-0.5 * innovation.span_s], innovation.instants])
    if prior.until_s < np.inf:
        own = course.columns(prior.start[None], [replace(prior, until_s=np.inf)]).mean
        ends_s = np.append(ends_s, np.inf)
    for ramp_s in RAMPS_S:
        acts = np.clip(0.5 + (ends_s - innovation.times_s[:, None]) / ramp_s, 0.0, 1.0)
        at_s = np.append(-np.inf, ends_s[1:]) if ramp_s == AT_ONCE_S else ends_s  # nothing tells it from one before
        yield at_s, others + own, own[:, None] * (acts - 1)


class Hypotheses:
    """What may explain a scan of one skin, each fitted and scored by its log evidence and log prior."""

    def __init__(self, tables: SkinTables, noise: NoiseModel, drift: SkinFilter) -> None:
        self._noise, self._drift = noise, drift
        self._set_tables(tables)
        self._slopes: Array | None = None
        self._through_wire: tuple[WireFault, Hypotheses] | None = None  # through a fault of the wires
        # Touches that nothing explains for certain must not be taken for noise.
        self._wider = WIDER if tables.predicted else (MEMORY, DRIFT, BURST)

    def _set_tables(self, tables: SkinTables) -> None:
        self._tables, self.grid, self.response = tables, tables.grid, tables.response
        self.detector = TouchDetector(tables.grid, tables.wrong)

    def through(self, wire: WireFault | None, slopes: Array | None) -> Hypotheses:
        """The same of a skin that is seen through a fault of the wires; slopes (K, K): as that begins."""
        if wire is None or slopes is None:
            self._through_wire = None
            return self
        if self._through_wire is not None and self._through_wire[0] == wire:
            return self._through_wire[1]
        seen = copy(self)
        seen._set_tables(self._tables.through(slopes))
        seen._slopes = slopes
        self._through_wire = wire, seen
        return seen

    @property
    def _misfit_wide(self) -> float:
        """Share of a touch's change that a response gets wrong which is wrong by more than it should be."""
        return max(float(MISFIT_WIDE), 2 * self._tables.wrong)

    def inflated_drift(self) -> Array:
        """(K, K)"""
        faster = self._drift.inflated_process_noise(self._drift.now.process_noise_scale)
        return faster if self._slopes is None else np.asarray(self._slopes @ faster @ self._slopes.T)

    # --- nothing touches ---

    def untouched(self, innovation: Innovation, cause: str = AS_IT_IS, more: Array | None = None) -> ScoredAnswer:
        """The answer that nothing touches; more (K, K): what a cause adds to the covariance."""
        white = innovation.white if more is None else Whitening.of(innovation.covariance + more)
        whitened = white(innovation.y)
        energy = float(whitened @ whitened)
        score = white.log_density - 0.5 * energy + LOG_PRIORS[cause]
        chi2 = energy / max(int(innovation.live.sum()), 1)
        answer = ScoredAnswer(cause, None, (), chi2, np.inf, score, white, white.w.T @ whitened, innovation.y)
        z2 = max(self.detector.best(innovation, answer).z2, newest_z2(innovation, white, answer.weighted_residual))
        if not self._tables.predicted:
            z2 = max(z2, float(n.FALSE_ALARM_Z2 / n.QUIET) * chi2)
        return replace(answer, next_touch_z2=z2)

    def _untouched(self, innovation: Innovation, causes: Sequence[str]) -> list[ScoredAnswer]:
        """The same, also by each of the causes that this skin has, where foam may remember as much."""
        added = [(cause, self._more(innovation, cause, innovation.y)) for cause in causes]
        found = [self.untouched(innovation, cause, more) for cause, more in added if more is not None]
        return [self.untouched(innovation), *(answer for answer in found if self._may_be(answer))]

    def _may_be(self, answer: ScoredAnswer) -> bool:
        """Whether foam may remember what an answer says that it does."""
        return answer.cause != MEMORY or self._drift.may_remember(answer.weighted_residual)

    # --- something does ---

    def glance(self, innovation: Innovation) -> ScoredAnswer:
        """The likeliest answer that nothing touches, without a search."""
        return likeliest(self._untouched(innovation, self._wider))

    def of_unmodelled(self, innovation: Innovation, pressed: Array, wider: bool) -> ScoredAnswer:
        """The same of a skin whose touches no response tells: else something touches. pressed (K,): change by what did
        so lately, of which foam may remember a share. wider: whether causes are asked that own more than the filter.
        """
        found = self.glance(innovation) if wider else self.untouched(innovation)
        if found.quiet or not pressed.any():
            return found
        column, white = np.where(innovation.live, pressed, 0.0), innovation.white
        along = white(column)
        share = float(along @ white(innovation.y)) / max(float(along @ along), LEAST_ACTION)
        again = self.untouched(replace(innovation, y=innovation.y - share * column))
        return again if again.quiet and abs(share) < n.MEMORY_MOST else found

    def slow_onset(self, innovation: Innovation) -> ScoredAnswer | None:
        """Touches that came while nothing was seen to touch, strong enough to be none of the field's own unevenness."""
        nothing = self.untouched(innovation)
        if nothing.next_touch_z2 < n.FALSE_ALARM_Z2:
            return None
        found = self._from_nothing(innovation)
        best = likeliest(found) if found else nothing
        if best.fit is None or not best.explained or best.score < nothing.score + n.ANOTHER:
            return None
        return best if float(best.fit.states[:, ACTION].sum()) > n.START_SEEN else None

    def ask(self, innovation: Innovation, tracked: Priors, manoeuvring: Priors) -> ScoredAnswer:
        """The likeliest answer. tracked, manoeuvring: priors of tracks, as they go on or move and change anew."""
        if tracked:
            answers = self._of_tracked(innovation, tracked, manoeuvring)
        else:
            answers = [*self._untouched(innovation, self._wider), *self._from_nothing(innovation)]
        if not _settled(innovation, answers):
            answers += self._of_anything(innovation, tracked, answers)
        best = likeliest(answers)
        if tracked:
            return best
        return replace(best, over=best.score - max(answer.score for answer in answers if answer.fit is None))

    def of_fewer(
        self, innovation: Innovation, answer: ScoredAnswer, doubted: Sequence[int], or_all: bool
    ) -> ScoredAnswer:
        """The likeliest of an answer's touches: without a doubted one, or any new one, or all: a fault may look so."""
        priors, places = started(answer.fit), answer.association
        new = [k for k, place in enumerate(places) if place < 0]
        found, wide = list[ScoredAnswer](), answer.wide or None
        for without in (tuple(new), *((k,) for k in doubted if len(new) > 1), *([()] if or_all else [])):
            stay = [k for k in range(len(priors)) if k not in without]
            association = tuple(places[k] for k in stay)
            fewer = [priors[k] for k in stay]
            found.append(self.fitted(innovation, fewer, association, wide=wide) if stay else self.untouched(innovation))
        nothing = max((each.score for each in found if each.fit is None), default=-np.inf)
        best = likeliest(found)
        return replace(best, over=best.score - nothing, recounted=answer.recounted)

    def on_electrode(self, innovation: Innovation, place: Array, second: Array) -> ScoredAnswer:
        """The likeliest small touch at a place (2,). second (K, n): what one does there by the square of its action."""
        out = place / max(float(np.hypot(*place)), LEAST_ACTION)
        found = list[ScoredAnswer]()
        action = 0.0  # of the likeliest so far
        for along in (0.0, SMALL_RADIUS, -SMALL_RADIUS):
            x, y = place - INSIDE * out + along * np.array([-out[1], out[0]])
            prior = anywhere(float(x), float(y), 0.0, innovation.span_s)
            prior.start[LOG_RADIUS] = np.log(SMALL_RADIUS)
            more = action**2 * second
            wider = replace(innovation, covariance=innovation.covariance + more @ more.T)
            found.append(self.fitted(wider, [prior], (-1,)))
            best = max(found, key=lambda answer: answer.score)
            action = 0.0 if best.fit is None else float(best.fit.states[0, ACTION])
        return best

    def without(self, innovation: Innovation, tracked: Priors, place: int) -> ScoredAnswer:
        """The answer that one of the touches is none: there is nothing, or it is drift, or what foam remembers."""
        association = tuple(k for k in range(len(tracked)) if k != place)
        if not association:
            return likeliest(self._untouched(innovation, (DRIFT, MEMORY)))
        priors = [tracked[k] for k in association]
        more = [self._more(innovation, cause, innovation.y) for cause in (DRIFT, MEMORY)]
        widest = replace(innovation, covariance=innovation.covariance + sum(each for each in more if each is not None))
        found = self.fitted(widest, priors, association, n.STEPS_WARM)
        if not found.quiet:  # what all causes together do not explain, none of them does
            return found
        answers = [self.fitted(innovation, priors, association, n.STEPS_WARM)]
        for cause in (DRIFT, MEMORY):
            answers += self.with_cause(innovation, priors, association, cause, innovation.y, n.STEPS_WARM)
        return likeliest(answers)

    def _from_nothing(self, innovation: Innovation) -> list[ScoredAnswer]:
        """Touches where none were: first those that the scan before left open, as a search has no steps for all."""
        found, count = list[ScoredAnswer](), len(innovation.candidates)
        if count:
            found.append(self.fitted(innovation, innovation.candidates, (-1,) * count, n.STEPS_WARM))
        again = count > 1 and innovation.scan.separate  # a search may find fewer, and no later scan is asked
        settled = innovation.spent or (not again and _settled(innovation, found))
        return found if settled else [*found, *self.search(innovation)]

    def _of_tracked(self, innovation: Innovation, tracked: Priors, manoeuvring: Priors) -> list[ScoredAnswer]:
        answers = list[ScoredAnswer]()
        for further in self._of_changes(innovation, tracked, manoeuvring):
            answers += further
            if _settled(innovation, answers):
                return answers
        return answers + self._beside_tracked(innovation, tracked, manoeuvring, answers)

    def _of_changes(self, innovation: Innovation, tracked: Priors, manoeuvring: Priors) -> Iterator[list[ScoredAnswer]]:
        """The same touches, one way after the other: as they were, gone, begun, changed or ended at once, moved."""
        if -1 in innovation.places:
            yield [self._continued(innovation, manoeuvring)]
        unchanged = self.fitted(innovation, tracked, most_steps=n.STEPS_WARM)
        yield [unchanged]
        yield [self.untouched(innovation)]  # costs no step
        since_s = min(prior.since_s for prior in tracked)
        if innovation.scan.part and since_s >= -1.5 * innovation.span_s:  # all have just begun, and may be others
            several = self.several(innovation, since_s, max(2, len(tracked)))
            yield [] if several is None else [several]
        if -1 in innovation.places:  # foam remembers more of what went
            yield self.with_cause(innovation, manoeuvring, None, MEMORY, innovation.y, n.STEPS_WARM)
        end, turn = self._changes(innovation, tracked, unchanged)
        late = end is None or end.at_s > _turns_s(innovation) + TURN_STEPS[0]
        ways = (self._released, end), (self._turned, turn)
        if late and innovation.whole:  # no part follows that tells them apart
            yield [answer for how, change in ways for answer in how(innovation, tracked, change)]
        else:
            for how, change in reversed(ways) if late else ways:
                yield how(innovation, tracked, change)
        yield [self.fitted(innovation, manoeuvring)]

    def _beside_tracked(
        self, innovation: Innovation, tracked: Priors, manoeuvring: Priors, before: Sequence[ScoredAnswer]
    ) -> list[ScoredAnswer]:
        """Further touches beside the tracked ones, or a disturbance; before: the answers without."""
        expected = self.fitted(innovation, tracked, most_steps=0)
        causes = CAUSE_STEPS * len(self._wider) * len(manoeuvring)  # a search must not spend theirs
        found = self.search(replace(innovation, keeps=innovation.keeps + causes), expected)
        residual = likeliest([*before, *found]).residual
        for cause in self._affordable(innovation):
            found += self.with_cause(innovation, manoeuvring, None, cause, residual)
        return found

    def _continued(self, innovation: Innovation, manoeuvring: Priors) -> ScoredAnswer:
        """What nearly explained the part before, a step further."""
        priors, association = list(manoeuvring), list(range(len(manoeuvring)))
        for candidate, place in zip(innovation.candidates, innovation.places, strict=True):
            if place < 0:
                priors.append(candidate)
                association.append(-1)
            else:
                priors[place] = replace(priors[place], start=candidate.start)
        return self.fitted(innovation, priors, tuple(association))

    def _of_anything(
        self, innovation: Innovation, tracked: Priors, before: Sequence[ScoredAnswer]
    ) -> list[ScoredAnswer]:
        """Where what was known does not help: touches from nothing, beside a disturbance, by a wrong response."""
        found = self._from_nothing(innovation) if tracked else []
        touched = [answer for answer in [*before, *found] if answer.fit is not None]
        if not touched or _settled(innovation, found):
            return found
        best = likeliest(touched)
        again = started(best.fit)
        for cause in self._affordable(innovation):
            found += self.with_cause(innovation, again, best.association, cause, best.residual)
        return [*found, self.fitted(innovation, again, best.association, wide=True)]

    def _affordable(self, innovation: Innovation) -> Iterator[str]:
        """The wider causes, as long as there are steps for them."""
        return takewhile(lambda _: not innovation.spent, self._wider)

    def with_cause(
        self,
        innovation: Innovation,
        priors: Priors,
        association: tuple[int, ...] | None,
        cause: str,
        residual: Array,
        most_steps: float = n.STEPS_COLD,
    ) -> list[ScoredAnswer]:
        """Empty where this skin has no such cause, or foam no such memory."""
        more = self._more(innovation, cause, residual)
        if more is None:
            return []
        wider = replace(innovation, covariance=innovation.covariance + more)
        answer = self.fitted(wider, priors, association, most_steps, cause)
        return [answer] if self._may_be(answer) else []

    def _more(self, innovation: Innovation, cause: str, residual: Array) -> Array | None:
        """(K, K) what a cause adds to the covariance; residual (K,): what it is to explain."""
        if cause == DRIFT:
            return self.inflated_drift()
        if cause == MEMORY:
            return self._drift.more_memory()
        if cause == BURST:
            lines = self._noise.lines.columns(innovation.scan.part)
            return in_blocks(lines, innovation.order, n.BURST) if lines.shape[1] else None
        block = innovation.order // BURST_BLOCK  # each block of measurements with a noise of its own
        count = np.bincount(block)
        expected = np.bincount(block, np.diag(innovation.covariance)) / count
        excess = np.maximum(np.bincount(block, residual**2) / count - expected, 0.0)
        excess[excess < 2 * expected] = 0.0
        if not excess.any() or excess.max() > n.MOST_NOISE**2:  # under more nothing would be seen
            return None
        return np.diag(excess[block])

    # --- fits ---

    def fitted(
        self,
        innovation: Innovation,
        priors: Priors,
        association: tuple[int, ...] | None = None,
        most_steps: float = n.STEPS_COLD,
        cause: str = AS_IT_IS,
        wide: bool | None = None,
        before: FoundTouches | None = None,
    ) -> ScoredAnswer:
        """association: None: priors are those of the tracks. before: a fit of a moment ago, as good as its own."""
        association = tuple(range(len(priors))) if association is None else association
        wide = innovation.wide if wide is None else wide
        course = TouchCourse(self.response, innovation.times_s, innovation.span_s)
        live, tables = int(innovation.live.sum()), self._tables
        misfit = self._misfit_wide if wide else tables.wrong
        covariance = innovation.covariance if tables.map is None else innovation.covariance + tables.map.error
        sample_s = innovation.sample_s - innovation.middle_s
        scene = FittedScan(innovation.y, covariance, course, tables.misfit, live, before, sample_s)
        affordable = max(0.0, innovation.budget.left - innovation.keeps) / len(priors)
        fit = TouchFitter(scene, priors, misfit).fit(min(int(most_steps), int(affordable)))
        innovation.budget.left -= (fit.steps + 1) * len(fit)
        cost = n.LOG_PRIOR_WIDE if wide and not innovation.wide else LOG_PRIORS[cause]
        score = fit.evidence + cost + innovation.touch_log_prior * sum(place < 0 for place in association)
        near = innovation.whole and not apart(fit.states, association)
        of_fit = fit.chi2, np.inf, score, fit.white, fit.weighted_residual, fit.left
        answer = ScoredAnswer(cause, fit, association, *of_fit, near=near, wide=wide)
        return replace(answer, next_touch_z2=self.detector.best(innovation, answer).z2)

    def search(
        self, innovation: Innovation, before: ScoredAnswer | None = None, outlined: Priors | None = None
    ) -> list[ScoredAnswer]:
        """Further touches than those of an answer, one after the other: plain discs find them, their own outlines and
        evidence decide. outlined: the touches of that answer, free to be no discs; None: as it has them.
        """
        found, discs = list[ScoredAnswer](), innovation.nothing if before is None else before
        priors = started(discs.fit) if outlined is None else list(outlined)
        least = 0.0 if innovation.whole else float(n.ANOTHER)
        while (new := self._next_disc(innovation, discs)) is not None:
            if discs.fit is None and innovation.scan.part and new.since_s > 0:
                found += self._begun_within(innovation, new)
                if found[-1].explained:
                    break
            priors, association = [*priors, new], (*discs.association, -1)
            more = self.fitted(innovation, [*started(discs.fit), plain(new)], association)
            if more.score < discs.score + least:
                break
            if discs.fit is None:
                priors, more = self._or_several(innovation, new, more)
            discs = more
            found += self._outlined(innovation, priors, discs)
        return found

    def _begun_within(self, innovation: Innovation, new: TouchPrior) -> list[ScoredAnswer]:
        """What began within a part: several discs, else one of any outline. The next parts tell one from the others."""
        several = self.several(innovation, new.since_s)
        if several is not None and several.explained:
            return [several]
        return [*([] if several is None else [several]), self.fitted(innovation, [new], (-1,))]

    def _or_several(
        self, innovation: Innovation, one: TouchPrior, answer: ScoredAnswer
    ) -> tuple[list[TouchPrior], ScoredAnswer]:
        """Several discs, where they are likelier than the answer of one alone."""
        several = self.several(innovation, one.since_s) if answer.chi2 > n.MOST else None
        if several is None or several.score <= answer.score:
            return [one], answer
        return list(begun_as(several.fit, innovation.span_s)), several

    def several(self, innovation: Innovation, since_s: float, least: int = 1) -> ScoredAnswer | None:
        """So many discs at once, or the likelier more, which began at an instant that is known roughly: one alone may
        lie between them. None where one is enough.
        """
        found: ScoredAnswer | None = None
        for discs in self.detector.several(innovation, since_s, least):
            priors = [plain(self._begun(innovation, each)) for each in discs]
            more = self.fitted(innovation, priors, (-1,) * len(priors))
            if found is not None and more.score < found.score:
                break
            found = more
            if innovation.whole or _settled(innovation, [found]):  # the search of a whole scan goes on from them
                break
        return found

    def _next_disc(self, innovation: Innovation, discs: ScoredAnswer) -> TouchPrior | None:
        """The likeliest one in what others leave; None where it would not be seen, or may not be looked for."""
        if discs.count >= n.MOST_TOUCHES or innovation.spent or (discs.explained and not innovation.whole):
            return None
        # None where all values are of one instant.
        found = self.detector.best(innovation, discs, ONSETS if np.ptp(innovation.times_s) > 0 else ())
        if found.z2 < (n.ANOTHER_Z2 if innovation.whole else n.FALSE_ALARM_Z2):
            return None
        return self._begun(innovation, found)

    def _begun(self, innovation: Innovation, found: Detection) -> TouchPrior:
        x, y = self.grid.discs[found.disc, PLACE]
        return replace(anywhere(x, y, found.action, innovation.span_s), since_s=found.since_s)

    def _outlined(self, innovation: Innovation, priors: Priors, discs: ScoredAnswer) -> list[ScoredAnswer]:
        """Touches that were found as discs, with their own outlines. In a whole scan each may be a disc, or odder."""
        association = discs.association
        outlined = self.fitted(innovation, started(discs.fit, priors), association)
        assert outlined.fit is not None
        best = max(outlined.score, discs.score) if innovation.whole else outlined.score
        found = [replace(outlined, score=best), *self._wide(innovation, outlined)]
        if not outlined.explained:  # its steps may not have led there
            found.append(discs)
        if (pair := neighbours(outlined.fit.states, association)) is not None:
            found += self.merged(innovation, outlined, *pair)
        return found

    def _wide(self, innovation: Innovation, answer: ScoredAnswer) -> list[ScoredAnswer]:
        """The same touches by a response that is wrong by more, where theirs leaves something that it may explain."""
        wider = (self._misfit_wide / self._tables.wrong) ** 2
        if not (innovation.whole and n.GOOD < answer.chi2 < wider * n.GOOD):
            return []
        return [self.fitted(innovation, started(answer.fit), answer.association, wide=True)]

    def merged(self, innovation: Innovation, answer: ScoredAnswer, a: int, b: int) -> list[ScoredAnswer]:
        """One outlined touch for two discs."""
        assert answer.fit is not None
        states = answer.fit.states
        acts = np.maximum(states[[a, b], ACTION], LEAST_ACTION)
        x, y = acts @ states[[a, b], PLACE] / acts.sum()
        one = anywhere(float(x), float(y), float(acts.sum()), innovation.span_s)
        one.start[LOG_RADIUS] = 0.5 * np.logaddexp(2 * states[a, LOG_RADIUS], 2 * states[b, LOG_RADIUS])
        priors = started(answer.fit)
        priors[a] = replace(one, since_s=min(priors[a].since_s, priors[b].since_s))
        del priors[b]
        association = tuple(place for k, place in enumerate(answer.association) if k != b)
        one_less = self.fitted(innovation, priors, association)
        return [one_less, *self._wide(innovation, one_less)]

    def _turned(self, innovation: Innovation, tracked: Priors, turn: StrengthStep | None) -> list[ScoredAnswer]:
        """Strengths changed at once: some in mid-scan, or any at its end, as they go or are pressed harder."""
        priors = list(tracked)
        for k, prior in enumerate(tracked):
            # Until then it acts as it did, since a scan before this one: else two that begin would look like one.
            if prior.until_s < np.inf or prior.since_s >= -1.5 * innovation.span_s:
                continue
            if turn is None:
                steady = acting_steadily(prior, float(prior.start[ACTION]), innovation.span_s)
                priors[k] = replace(steady, turns_s=_turns_s(innovation))
            elif k in turn.touches:
                most = max(1.0, turn.share) * float(prior.start[ACTION])
                steady = acting_steadily(prior, most, innovation.span_s)
                priors[k] = replace(steady, turns_s=turn.at_s, grows=turn.share > 1)
        if all(now is before for now, before in zip(priors, tracked, strict=True)):
            return []
        return [self.fitted(innovation, priors)]

    def _released(self, innovation: Innovation, tracked: Priors, end: StrengthStep | None) -> list[ScoredAnswer]:
        """Touches ended at once within the scan, or before it; empty where none did."""
        if end is None:
            return []
        if end.at_s == -np.inf:
            association = tuple(k for k in range(len(tracked)) if k not in end.touches)
            priors = [tracked[k] for k in association]
            return [self.fitted(innovation, priors, association) if priors else self.untouched(innovation)]
        priors = list(tracked)
        for k in end.touches:
            if end.at_s < np.inf:
                priors[k] = acting_steadily(priors[k], float(priors[k].start[ACTION]), innovation.span_s)
            priors[k] = replace(priors[k], until_s=end.at_s)
        return [self.fitted(innovation, priors)]

    def _changes(
        self, innovation: Innovation, tracked: Priors, answer: ScoredAnswer
    ) -> tuple[StrengthStep | None, StrengthStep | None]:
        """The end of one of the touches, or of several, that leaves least of a scan, and the other change that leaves
        less than half as much; None where none leaves half of what they leave as they are. One that has ended did so at
        another instant than the first values after it told, or not at all.
        """
        course = TouchCourse(self.response, innovation.times_s, innovation.span_s)
        each = [course.columns(prior.start[None], [prior]).mean for prior in tracked]
        total = np.sum(each, axis=0)
        ends, turns = list[StrengthStep](), list[StrengthStep]()
        for touches in _together(tracked):
            prior, own = tracked[touches[0]], np.sum([each[k] for k in touches], axis=0)
            for at_s, before, missing in _releases(course, innovation, prior, own, total - own):
                chi2 = self._unlike(innovation, answer, before[:, None] + missing)
                at = int(chi2.argmin())
                ends.append(StrengthStep(touches, float(at_s[at]), 0.0, float(chi2[at])))
                if prior.until_s < np.inf:
                    continue
                share = self._share(innovation, answer, before, missing)
                chi2 = self._unlike(innovation, answer, before[:, None] + share * missing)
                at = int(chi2.argmin())
                if chi2[at] < 0.5 * chi2[0]:  # by more than one that changed before the scan
                    turns.append(StrengthStep(touches, float(at_s[at]), 1 - float(share[at]), float(chi2[at])))
        half = 0.5 * float(self._unlike(innovation, answer, total[:, None])[0])
        end = _least(ends, half)
        return end, _least(turns, 0.5 * (half if end is None else end.chi2))

    def _share(self, innovation: Innovation, answer: ScoredAnswer, change: Array, missing: Array) -> Array:
        """(n,) of what may be missing (K, n) of a change (K,), with which the residual is least."""
        change = np.maximum(change, LEAST_MEAN)
        counts = np.where(innovation.live, 1 / (1 + change), 0.0)
        residual = answer.white(np.where(innovation.live, innovation.y - np.log1p(change), 0.0))
        columns = answer.white(missing * counts[:, None])
        return np.asarray((residual @ columns) / np.maximum(np.sum(columns**2, axis=0), n.TINY))

    def _unlike(self, innovation: Innovation, answer: ScoredAnswer, changes: Array) -> Array:
        """(n,) squared sigmas of what changes (K, n) leave of a scan, by the covariance of an answer."""
        residual = np.where(innovation.live, innovation.y, 0.0)[:, None] - np.log1p(np.maximum(changes, LEAST_MEAN))
        residual[~innovation.live] = 0.0
        return np.asarray(np.sum(answer.white(residual) ** 2, axis=0))


def _turns_s(innovation: Innovation) -> float:
    """About which touches may change at once: what does so earlier the scan or the part before has shown."""
    return 0.5 * innovation.span_s + float(SUDDEN_STEPS[0])


def _settled(innovation: Innovation, answers: Sequence[ScoredAnswer]) -> bool:
    return innovation.spent or any(answer.explained for answer in answers)
