"""What touches of known states do to a scan whose values were measured one after the other, and the slopes of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.measurement.numbers import (
    BENDS_BY,
    COURSE_JITTER,
    COURSE_S,
    COURSE_SD,
    KINK,
    MOVES,
    SUDDEN_JITTER,
    SUDDEN_S,
    SUDDEN_SD,
)
from models.measurement.responses.response import TouchModel
from models.measurement.touch import ACTION, AT_ONCE_S, LOG_RADIUS, RATE, SHAPES, STATES, VX, VY, TouchPrior, X, Y

Array = NDArray[np.float64]

SUDDEN_STEPS: Array = float(SUDDEN_S) * np.arange(-2.0, 3.0)  # s
TURN_STEPS: Array = float(SUDDEN_S) * np.arange(-4.0, 5.0)  # s: the part after that in which it was seen is within them
SUDDEN_REACH_S = float(SUDDEN_STEPS[-1] + SUDDEN_S)
CHANGES = 0.1  # of its strength within a scan, from which on a touch's change may bend
STRENGTH = 0  # what of a touch a kink bends: how strongly it acts, else X + 1 or Y + 1


@dataclass(frozen=True)
class Kinks:
    """What changes of a touch within the scan beside a straight line, each of variance 1."""

    touch: int
    bends: int
    profiles: Array  # (n, K)

    def __len__(self) -> int:
        return len(self.profiles)


@dataclass(frozen=True)
class TouchColumns:
    """Of T touches at some states: relative change of |Z|, not of its logarithm."""

    mean: Array  # (K,) of plain discs
    slopes: Array  # (K, 7 T) of the change, kinks included, to the states
    shapes: Array  # (K, 9 T) of the touches' own directions; (K, 0) where nobody asked
    kinks: Array  # (K, n)


class TouchCourse:
    """Of one scan. times_s (K,): when each value was measured, from its middle on; span_s: how long it took."""

    def __init__(self, response: TouchModel, times_s: Array, span_s: float) -> None:
        self._response, self._times_s, self.span_s = response, times_s, span_s

    def directions(self, states: Array) -> list[Array]:
        """(9, K) each touch's own directions, of unit action."""
        return [self._response.directions(state[X], state[Y], state[LOG_RADIUS]) for state in states]

    def columns(
        self,
        states: Array,
        priors: Sequence[TouchPrior],
        directions: Sequence[Array] = (),
        kinks: Sequence[Kinks] = (),
        kinked: Array | None = None,
    ) -> TouchColumns:
        """states (T, 7). directions: the touches' own, of states near these; none: nobody asks for them. kinked (n,):
        by how much each kink is taken to bend, 0 where it is not given.
        """
        count, k, shaped = len(priors), len(self._times_s), len(directions) > 0
        mean, slopes = np.zeros(k), np.empty((STATES * count, k))
        shapes, bent = np.empty((SHAPES * count if shaped else 0, k)), np.empty((sum(map(len, kinks)), k))
        for n, (state, prior) in enumerate(zip(states, priors, strict=True)):
            moved = self._moved(state, prior)
            acts = self._acts(state, prior)
            strength = acts * (state[ACTION] + state[RATE] * self._times_s)
            mean += strength * moved[0]
            at = 0
            for own in kinks:
                among = slice(at, at + len(own))
                at = among.stop
                if own.touch == n:
                    bent[among] = own.profiles * moved[own.bends]
                    if own.bends == STRENGTH and kinked is not None:
                        strength = strength + kinked[among] @ own.profiles
            sloped = slopes[STATES * n : STATES * (n + 1)]
            sloped[[X, Y, LOG_RADIUS, VX, VY]] = strength * moved[1:]
            sloped[ACTION] = acts * moved[0]
            sloped[RATE] = sloped[ACTION] * self._times_s
            if shaped:
                shapes[SHAPES * n : SHAPES * (n + 1)] = directions[n] * strength
        return TouchColumns(mean, slopes.T, shapes.T, bent.T)

    def kinks(self, states: Array, priors: Sequence[TouchPrior]) -> list[Kinks]:
        """What changes within the scan may be beside straight lines: slides that begin or end within it as quadratic
        courses; how strongly a touch acts as any course, straight from step to step.
        """
        found = list[Kinks]()
        for n, (state, prior) in enumerate(zip(states, priors, strict=True)):
            strengths = self._strengths(state, prior)
            found += [Kinks(n, STRENGTH, strengths)] if len(strengths) else []
            found += self._slides(n, state, prior)
        return found

    def at(self, profiles: Array, time_s: float) -> Array:
        """(n,) of profiles (n, K) at an instant, straight between the values that were measured about it."""
        order = np.argsort(self._times_s)
        times_s = self._times_s[order]
        after = min(int(np.searchsorted(times_s, time_s)), len(times_s) - 1)
        before = max(after - 1, 0)
        apart_s = times_s[after] - times_s[before]
        share = min(max((time_s - times_s[before]) / apart_s, 0.0), 1.0) if apart_s > 0 else 0.0
        return np.asarray((1 - share) * profiles[:, order[before]] + share * profiles[:, order[after]])

    def jitter(self, states: Array, priors: Sequence[TouchPrior]) -> Array:
        """(K,) standard deviation of each value by how a touch changes within the steps of its course."""
        variance = np.zeros(len(self._times_s))
        for state, prior in zip(states, priors, strict=True):
            if instants := [*self._instants(prior), *self._turns(prior)]:
                strength = np.maximum(state[ACTION] + state[RATE] * self._times_s, 0.0)
                near = self._near(instants)
                share = np.where(near, SUDDEN_JITTER, COURSE_JITTER * self._acts(state, prior))
                variance += (share * strength * self._response(state[X], state[Y], state[LOG_RADIUS])) ** 2
        return np.sqrt(variance)

    def _near(self, instants: Sequence[float]) -> NDArray[np.bool_]:
        """(K,) whether a value was measured while a touch began or ended at once."""
        away = np.abs(self._times_s - np.array(instants)[:, None])
        return np.asarray((away < SUDDEN_REACH_S).any(axis=0))

    def _instants(self, prior: TouchPrior) -> list[float]:
        """At which a touch begins or ends within the scan."""
        return [t for t in (prior.since_s, prior.until_s) if abs(t) < self.span_s / 2 + SUDDEN_REACH_S]

    def _turns(self, prior: TouchPrior) -> list[float]:
        """About which it may change at once, within the scan."""
        return [prior.turns_s] if abs(prior.turns_s) < self.span_s / 2 + SUDDEN_REACH_S else []

    def _acts(self, state: Array, prior: TouchPrior) -> Array:
        """(K,) 1 where the touch acts, else 0."""
        acts = state[ACTION] + state[RATE] * self._times_s > 0
        acts &= (self._times_s >= prior.since_s) & (self._times_s < prior.until_s)
        return np.asarray(acts, float)

    def _acting(self, prior: TouchPrior) -> tuple[float, float]:
        """Middle and half of the time within the scan in which a touch acts."""
        half_s = self.span_s / 2
        first_s, last_s = max(-half_s, min(prior.since_s, half_s)), min(half_s, max(prior.until_s, -half_s))
        return (first_s + last_s) / 2, max((last_s - first_s) / 2, AT_ONCE_S)

    def _moved(self, state: Array, prior: TouchPrior) -> Array:
        """(6, K) response where the touch is when each value is measured, its slopes to x, y, log radius, and those to
        the velocity.
        """
        middle_s, half_s = self._acting(prior)
        x, y, log_radius = state[X] + state[VX] * middle_s, state[Y] + state[VY] * middle_s, state[LOG_RADIUS]
        way = 2 * half_s * np.hypot(state[VX], state[VY])
        moved = np.empty((6, len(self._times_s)))
        middle = self._response.with_slopes(x, y, log_radius)
        if way <= max(MOVES, BENDS_BY * np.exp(log_radius)):
            moved[:4] = middle
            moved[4:] = middle[1:3] * self._times_s
            moved[0] += (state[[VX, VY]] @ middle[1:3]) * (self._times_s - middle_s)
            return moved
        first = self._response.with_slopes(x - state[VX] * half_s, y - state[VY] * half_s, log_radius)
        last = self._response.with_slopes(x + state[VX] * half_s, y + state[VY] * half_s, log_radius)
        u = (self._times_s - middle_s) / half_s
        before, at, after = (u**2 - u) / 2, 1 - u**2, (u**2 + u) / 2  # Lagrange's
        moved[:4] = before * first + at * middle + after * last
        moved[4:] = (middle_s - half_s) * before * first[1:3] + middle_s * at * middle[1:3]
        moved[4:] += (middle_s + half_s) * after * last[1:3]
        return moved

    def _strengths(self, state: Array, prior: TouchPrior) -> Array:
        """(n, K): hats of how strongly a touch acts. Those of a touch that begins, ends or changes at once are finer
        about that instant.
        """
        instants = self._instants(prior)
        ((changes, _),) = self.bends(state[None], [prior])
        rise = abs(state[RATE]) * self.span_s / 2
        most = abs(state[ACTION]) + rise
        may = most if instants else 2 * rise
        hats = list[Array]()
        if instants:
            centres = np.add.outer(instants, SUDDEN_STEPS).ravel()
            hats.append(SUDDEN_SD * most * self._hats(centres, SUDDEN_S))
        for turns_s in self._turns(prior):
            hats.append(SUDDEN_SD * most * self._hats(turns_s + TURN_STEPS, SUDDEN_S))
            after = self._times_s >= turns_s
            hats.append(SUDDEN_SD * most * (~after if prior.grows else after)[None])
        if instants or changes:
            steps = max(1, round(self.span_s / COURSE_S))
            knots = np.linspace(-self.span_s / 2, self.span_s / 2, steps + 1)
            hats.append(COURSE_SD * may * self._acts(state, prior) * self._hats(knots, self.span_s / steps))
        found = np.concatenate(hats) if hats else np.empty((0, len(self._times_s)))
        return found[found.any(axis=1)]

    def _hats(self, centres_s: Array, half_s: float) -> Array:
        """(n, K)"""
        return np.asarray(np.maximum(0.0, 1 - np.abs(self._times_s - centres_s[:, None]) / half_s))

    def bends(self, states: Array, priors: Sequence[TouchPrior]) -> list[tuple[bool, bool]]:
        """Of each touch whether its action changes, and whether it moves, by enough to do so unevenly."""
        rise = np.abs(states[:, RATE]) * self.span_s / 2
        way = np.hypot(states[:, VX], states[:, VY]) * [self._acting(prior)[1] for prior in priors]
        return list(zip(rise > CHANGES * np.abs(states[:, ACTION]), way > MOVES / 2, strict=True))

    def _slides(self, touch: int, state: Array, prior: TouchPrior) -> list[Kinks]:
        ((_, moves),) = self.bends(state[None], [prior])
        if not moves:
            return []
        middle_s, half_s = self._acting(prior)
        way = np.hypot(state[VX], state[VY]) * half_s
        strength = self._acts(state, prior) * (state[ACTION] + state[RATE] * self._times_s)
        bent = strength * (KINK * way) * (((self._times_s - middle_s) / half_s) ** 2 - 1 / 3)
        return [Kinks(touch, axis + 1, bent[None]) for axis in (X, Y)]
