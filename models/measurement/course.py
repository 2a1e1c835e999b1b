"""What touches of known states do to a scan whose values were measured one after the other, and the slopes of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.measurement import numbers as n
from models.measurement.arrays import Array
from models.measurement.response import TouchModel
from models.measurement.touch import ACTION, LOG_RADIUS, RATE, SHAPES, STATES, VX, VY, TouchPrior, X, Y


def _steps(parts: int) -> Array:
    """[s] from so many parts of a scan before an instant to as many after it."""
    most = round(parts * n.COURSE_S / n.SUDDEN_S)
    return float(n.SUDDEN_S) * np.arange(-most, most + 1.0)


SUDDEN_STEPS = _steps(1)
TURN_STEPS = _steps(2)  # the part after that in which it was seen is within them
SUDDEN_REACH_S = float(SUDDEN_STEPS[-1] + n.SUDDEN_S)
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


def places_of(kinks: Sequence[Kinks], first: int = 0) -> list[slice]:
    """Where each of them is among all that is solved for, from place `first` on."""
    ends = first + np.cumsum([len(each) for each in kinks], dtype=int)
    return [slice(end - len(each), end) for each, end in zip(kinks, ends, strict=True)]


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
        among_all = places_of(kinks)
        for touch, (state, prior) in enumerate(zip(states, priors, strict=True)):
            moved = self._moved(state, prior)
            acts = self._acts(state, prior)
            strength = acts * self._actions(state)
            mean += strength * moved[0]
            for own, among in zip(kinks, among_all, strict=True):
                if own.touch == touch:
                    bent[among] = own.profiles * moved[own.bends]
                    if own.bends == STRENGTH and kinked is not None:
                        strength = strength + kinked[among] @ own.profiles
            sloped = slopes[STATES * touch : STATES * (touch + 1)]
            sloped[[X, Y, LOG_RADIUS, VX, VY]] = strength * moved[1:]
            sloped[ACTION] = acts * moved[0]
            sloped[RATE] = sloped[ACTION] * self._times_s
            if shaped:
                shapes[SHAPES * touch : SHAPES * (touch + 1)] = directions[touch] * strength
        return TouchColumns(mean, slopes.T, shapes.T, bent.T)

    def kinks(self, states: Array, priors: Sequence[TouchPrior]) -> list[Kinks]:
        """What changes within the scan may be beside straight lines: slides that begin or end within it as quadratic
        courses; how strongly a touch acts as any course, straight from step to step.
        """
        found = list[Kinks]()
        for touch, (changes, moves) in enumerate(self.bends(states, priors)):
            state, prior = states[touch], priors[touch]
            strengths = self._strengths(state, prior, changes)
            found += [Kinks(touch, STRENGTH, strengths)] if len(strengths) else []
            if moves:
                middle_s, half_s = self._acting(prior)
                way = np.hypot(state[VX], state[VY]) * half_s
                strength = self._acts(state, prior) * self._actions(state)
                bent = strength * (n.KINK * way) * (((self._times_s - middle_s) / half_s) ** 2 - 1 / 3)
                found += [Kinks(touch, axis + 1, bent[None]) for axis in (X, Y)]
        return found

    def at(self, profiles: Array, time_s: float) -> Array:
        """(n,) of profiles (n, K) at an instant, straight between the values that were measured about it."""
        order = np.argsort(self._times_s)
        return np.array([np.interp(time_s, self._times_s[order], profile[order]) for profile in profiles])

    def jitter(self, states: Array, priors: Sequence[TouchPrior]) -> Array:
        """(K,) standard deviation of each value by how a touch changes within the steps of its course."""
        variance = np.zeros(len(self._times_s))
        for state, prior in zip(states, priors, strict=True):
            if instants := self._within(prior.since_s, prior.until_s, prior.turns_s):
                strength = np.maximum(self._actions(state), 0.0)
                away = np.abs(self._times_s - np.array(instants)[:, None])
                near = (away < SUDDEN_REACH_S).any(axis=0)
                share = np.where(near, n.SUDDEN_JITTER, n.COURSE_JITTER * self._acts(state, prior))
                variance += (share * strength * self._response(state[X], state[Y], state[LOG_RADIUS])) ** 2
        return np.sqrt(variance)

    def bends(self, states: Array, priors: Sequence[TouchPrior]) -> list[tuple[bool, bool]]:
        """Of each touch whether its action changes, and whether it moves, by enough to do so unevenly."""
        rise = np.abs(states[:, RATE]) * self.span_s / 2
        way = np.hypot(states[:, VX], states[:, VY]) * [self._acting(prior)[1] for prior in priors]
        return list(zip(rise > n.CHANGES * np.abs(states[:, ACTION]), way > n.HALF_PIXEL / 2, strict=True))

    def _within(self, *instants_s: float) -> list[float]:
        """Those that are within the scan, or so near that a change at once then is seen in it."""
        return [t for t in instants_s if abs(t) < self.span_s / 2 + SUDDEN_REACH_S]

    def _actions(self, state: Array) -> Array:
        """(K,) as if it always acted."""
        return np.asarray(state[ACTION] + state[RATE] * self._times_s)

    def _acts(self, state: Array, prior: TouchPrior) -> Array:
        """(K,) 1 where the touch acts, else 0."""
        acts = self._actions(state) > 0
        acts &= (self._times_s >= prior.since_s) & (self._times_s < prior.until_s)
        return np.asarray(acts, float)

    def _acting(self, prior: TouchPrior) -> tuple[float, float]:
        """Middle and half of the time within the scan in which a touch acts."""
        half_s = self.span_s / 2
        first_s, last_s = max(-half_s, min(prior.since_s, half_s)), min(half_s, max(prior.until_s, -half_s))
        return (first_s + last_s) / 2, max((last_s - first_s) / 2, n.AT_ONCE_S)

    def _moved(self, state: Array, prior: TouchPrior) -> Array:
        """(6, K) response where the touch is when each value is measured, its slopes to x, y, log radius, and those to
        the velocity.
        """
        middle_s, half_s = self._acting(prior)
        x, y, log_radius = state[X] + state[VX] * middle_s, state[Y] + state[VY] * middle_s, state[LOG_RADIUS]
        way = 2 * half_s * np.hypot(state[VX], state[VY])
        middle = self._response.with_slopes(x, y, log_radius)
        if way <= max(n.HALF_PIXEL, n.BENDS_BY * np.exp(log_radius)):
            going = middle[1:3] * self._times_s
            middle[0] += (state[[VX, VY]] @ middle[1:3]) * (self._times_s - middle_s)
            return np.concatenate([middle, going])
        first = self._response.with_slopes(x - state[VX] * half_s, y - state[VY] * half_s, log_radius)
        last = self._response.with_slopes(x + state[VX] * half_s, y + state[VY] * half_s, log_radius)
        u = (self._times_s - middle_s) / half_s
        before, at, after = (u**2 - u) / 2, 1 - u**2, (u**2 + u) / 2  # Lagrange's
        going = (middle_s - half_s) * before * first[1:3] + middle_s * at * middle[1:3]
        going += (middle_s + half_s) * after * last[1:3]
        return np.concatenate([before * first + at * middle + after * last, going])

    def _strengths(self, state: Array, prior: TouchPrior, changes: bool) -> Array:
        """(n, K): hats of how strongly a touch acts. Those of a touch that begins, ends or changes at once are finer
        about that instant.
        """
        instants = self._within(prior.since_s, prior.until_s)
        rise = abs(state[RATE]) * self.span_s / 2
        most = abs(state[ACTION]) + rise
        hats = [np.empty((0, len(self._times_s)))]
        if instants:
            centres = np.add.outer(instants, SUDDEN_STEPS).ravel()
            hats.append(n.SUDDEN_SD * most * self._hats(centres, n.SUDDEN_S))
        for turns_s in self._within(prior.turns_s):
            hats.append(n.SUDDEN_SD * most * self._hats(turns_s + TURN_STEPS, n.SUDDEN_S))
            after = self._times_s >= turns_s
            hats.append(n.SUDDEN_SD * most * (~after if prior.grows else after)[None])
        if instants or changes:
            may = most if instants else 2 * rise
            steps = max(1, round(self.span_s / n.COURSE_S))
            knots = np.linspace(-self.span_s / 2, self.span_s / 2, steps + 1)
            hats.append(n.COURSE_SD * may * self._acts(state, prior) * self._hats(knots, self.span_s / steps))
        found = np.concatenate(hats)
        return found[found.any(axis=1)]

    def _hats(self, centres_s: Array, half_s: float) -> Array:
        """(n, K)"""
        return np.asarray(np.maximum(0.0, 1 - np.abs(self._times_s - centres_s[:, None]) / half_s))
