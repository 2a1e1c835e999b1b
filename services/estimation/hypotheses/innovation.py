"""One scan as it is observed and as it is asked about, and an answer: what explains it, scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from models.measurement.arrays import Array, Indices, Mask, Single
from models.measurement.fit import FoundTouches
from models.measurement.touch import ACTION, PLACE, RATE, VELOCITY, TouchPrior, anywhere
from models.measurement.whitening import Whitening
from services.estimation.values import numbers as n
from services.estimation.values.scan import NANOSECOND, Scan

Priors = Sequence[TouchPrior]

ONSETS = (0.1, 0.3, 0.5, 0.7, 0.85, 0.95)  # shares of a scan after which a disc is looked for that began within it
AS_IT_IS, DRIFT, MEMORY, BURST, NOISE = "", "drift", "memory", "burst", "noise"
LOG_PRIORS = {
    AS_IT_IS: 0.0,
    MEMORY: float(n.LOG_PRIOR_MEMORY),
    DRIFT: float(n.LOG_PRIOR_DRIFT),
    BURST: float(n.LOG_PRIOR_BURST),
    NOISE: float(n.LOG_PRIOR_NOISE),
}


@dataclass
class StepBudget:
    """Solver steps, times touches, that one scan may cost: handed along with all that is asked about it."""

    left: float

    @classmethod
    def of(cls, new: float, separate: bool) -> StepBudget:
        """new: share of its values: the fewer, the sooner the next comes. separate: none follows on it."""
        steps = n.MOST_STEPS * max(float(n.LEAST_BUDGET), new)
        return cls(steps * n.SEPARATE if separate else steps)


@dataclass(frozen=True)
class Observation:
    """One scan as it was observed: log |Z|, which measurements count, and when each was taken."""

    scan: Scan
    log_z: Array  # (K,) 0 where a measurement does not count
    live: Mask  # (K,)
    whole: bool  # it shares no value with the last one that was whole
    budget: StepBudget

    @property
    def fields(self) -> tuple[Scan, Array, Mask, bool, StepBudget]:
        """What makes an observation, and the first of what makes more of it."""
        return self.scan, self.log_z, self.live, self.whole, self.budget

    @property
    def span_s(self) -> float:
        return self.scan.duration_s

    @property
    def middle_s(self) -> float:
        return self.scan.at_ns * NANOSECOND - self.scan.duration_s / 2

    @property
    def sample_s(self) -> float:
        """For when what is said of it stands."""
        return self.scan.sample_ns * NANOSECOND

    @property
    def oldest_s(self) -> float:
        return self.middle_s - self.span_s / 2

    @property
    def end_s(self) -> float:
        return self.middle_s + self.span_s / 2

    @property
    def times_s(self) -> Array:
        """(K,) from the middle of the scan."""
        return self.span_s / 2 - self.scan.ages_s

    @cached_property
    def order(self) -> Indices:
        """(K,) rank in time, 0 the oldest."""
        return np.argsort(np.argsort(-self.scan.ages_s, kind="stable"), kind="stable")


@dataclass(frozen=True)
class Innovation(Observation):
    """y over the prediction without touches, its covariance S, and what is known of touches that there may be."""

    y: Array  # (K,) log |Z| over the prediction; 0 where a measurement does not count
    covariance: Array  # (K, K)
    information: Single  # (A,) of each disc of the grid, roughly
    candidates: tuple[TouchPrior, ...] = ()  # touches that nearly explained the scan before, or this one
    places: tuple[int, ...] = ()  # of each the tracked one that it continues; -1: it is new
    wide: bool = False  # touches that stand were explained by a response that is wrong by more than it should be
    keeps: float = 0.0  # steps that are left to who asks next

    @property
    def spent(self) -> bool:
        return self.budget.left <= self.keeps

    @property
    def touch_log_prior(self) -> float:
        """Of a touch that begins [nat]. In a whole scan evidence alone says how many: a part leaves more open."""
        return n.LOG_PRIOR_TOUCH + (n.WIDE_START if self.whole else 0.0)

    @cached_property
    def instants(self) -> Array:
        """(n,) midway between values: something may begin or end then. What the last few alone say, the next tell."""
        times_s = np.sort(self.times_s)
        return np.asarray(times_s[times_s <= (ONSETS[-1] - 0.5) * self.span_s] - 0.5 * self.span_s / len(times_s))

    def leaving(self, share: float) -> Innovation:
        """The same, which leaves so much of its steps to the next."""
        return replace(self, keeps=self.keeps + share * max(0.0, self.budget.left - self.keeps))

    @cached_property
    def white(self) -> Whitening:
        return Whitening.of(self.covariance)

    @property
    def nothing(self) -> ScoredAnswer:
        """That nothing touches, not scored: any touch is likelier."""
        return ScoredAnswer(AS_IT_IS, None, (), np.inf, np.inf, -np.inf, self.white, self.white.solve(self.y), self.y)


@dataclass(frozen=True)
class ScoredAnswer:
    """One hypothesis, scored."""

    cause: str
    fit: FoundTouches | None  # None: nothing touches
    association: tuple[int, ...]  # for each touch of the fit the standing one that it continues; -1: new
    chi2: float
    next_touch_z2: float  # of the best further disc
    score: float  # log evidence and prior
    white: Whitening
    weighted_residual: Array  # (K,) S^-1 of the residual
    residual: Array  # (K,)
    recounted: bool = False  # its touches are others than those that stood
    near: bool = False  # a new touch lies on another one: such two are one
    wide: bool = False  # by a response that is wrong by more than it should be
    over: float = np.inf  # by how much it is likelier than that nothing touches, where nothing did before [nat]

    @property
    def explained(self) -> bool:
        return self.chi2 < n.GOOD and self.next_touch_z2 < n.FALSE_ALARM_Z2 and not self.near

    @property
    def count(self) -> int:
        return 0 if self.fit is None else len(self.fit)

    @property
    def quiet(self) -> bool:
        return self.chi2 < n.QUIET and self.next_touch_z2 < n.FALSE_ALARM_Z2 * max(1.0, self.chi2)

    @property
    def holds(self) -> bool:
        """Whether it explains its scan, with touches or without."""
        return self.quiet if self.fit is None else self.explained

    @property
    def nearly_holds(self) -> bool:
        """Whether it does, or its touches explain the scan roughly: their places hold."""
        return self.holds or (self.fit is not None and self.chi2 < n.MOST)

    def information(self, column: Array) -> float:
        """Of what else may add to the scan by this column (K,): 1 / variance of its size."""
        return float(self.informations(column[:, None])[0])

    def informations(self, columns: Array) -> Array:
        """(n,) of each of these columns (K, n) alone."""
        if self.fit is not None:
            return self.fit.informations(columns)
        return np.asarray(np.sum(self.white(columns) ** 2, axis=0))


def started(fit: FoundTouches | None, priors: Priors | None = None) -> list[TouchPrior]:
    """The touches of a fit, to be searched from where it ended. priors: other ones for them than the fit's."""
    if fit is None:
        return []
    priors = fit.priors if priors is None else priors
    return [replace(prior, start=state.copy(), found=True) for prior, state in zip(priors, fit.states, strict=True)]


def begun_at(state: Array, span_s: float, since_s: float = -np.inf, until_s: float = np.inf) -> TouchPrior:
    """A touch that may be anywhere, searched from a state (7,)."""
    x, y = state[PLACE]
    free = anywhere(float(x), float(y), float(state[ACTION]), span_s)
    return replace(free, start=state, since_s=since_s, until_s=until_s)


def begun_as(fit: FoundTouches | None, span_s: float) -> tuple[TouchPrior, ...]:
    """The touches of a fit, each of them anywhere."""
    found = () if fit is None else zip(fit.states, fit.priors, strict=True)
    return tuple(begun_at(state, span_s, prior.since_s, prior.until_s) for state, prior in found)


def likeliest(answers: Sequence[ScoredAnswer]) -> ScoredAnswer:
    """Of those that explain the scan, if any does."""
    explained = [answer for answer in answers if answer.explained]
    separate = [answer for answer in answers if not answer.near]
    return max(explained or separate or answers, key=lambda answer: answer.score)


@dataclass(frozen=True)
class OpenTouch:
    """A touch that nearly explained the last scan, or did so and is not sure."""

    state: Annotated[Array, "states"]
    since_s: float  # host's clock
    id: int = 0  # of the one that it continues; 0: none

    def begun(self, measured: Observation) -> TouchPrior:
        """Anywhere in the next scan, searched from where it was at the end of that one: how it goes on nobody knows."""
        state, half_s = self.state.copy(), measured.span_s / 2
        state[PLACE] += half_s * state[VELOCITY]
        state[ACTION] += half_s * state[RATE]
        state[RATE:] = 0.0
        return begun_at(state, measured.span_s, self.since_s - measured.middle_s)
