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
from models.measurement.response import TouchModel
from models.measurement.touch import ACTION, LOG_RADIUS, RATE, SHAPES, STATES, VX, VY, TouchPrior, X, Y

Array = NDArray[np.float64]

RADIUS_SLOPE = 3  # of TouchModel.with_slopes
SUDDEN_STEPS = (-2, -1, 0, 1, 2)
SUDDEN_REACH_S = float(SUDDEN_S) * (SUDDEN_STEPS[-1] + 1)
CHANGES = 0.1  # of its strength within a scan, from which on a touch's change may bend
STRENGTH = 0  # what of a touch a kink bends: how strongly it acts, else X + 1 or Y + 1


@dataclass(frozen=True)
class Kink:
    """What changes of a touch within the scan beside a straight line, of variance 1."""

    touch: int
    bends: int
    profile: Array  # (K,)


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
        u = 2 * times_s / span_s
        self._lagrange = np.stack([(u**2 - u) / 2, 1 - u**2, (u**2 + u) / 2])
        self._bend = u**2 - 1 / 3

    def directions(self, states: Array) -> list[Array]:
        """(9, K) each touch's own directions, of unit action."""
        return [self._response.directions(state[X], state[Y], state[LOG_RADIUS]) for state in states]

    def columns(
        self,
        states: Array,
        priors: Sequence[TouchPrior],
        directions: Sequence[Array] = (),
        kinks: Sequence[Kink] = (),
        kinked: Array | None = None,
    ) -> TouchColumns:
        """states (T, 7). directions: the touches' own, of states near these; none: nobody asks for them. kinked (n,):
        by how much each kink is taken to bend, 0 where it is not given.
        """
        count, k, shaped = len(priors), len(self._times_s), len(directions) > 0
        mean, slopes = np.zeros(k), np.empty((k, STATES * count))
        shapes, bent = np.zeros((k, SHAPES * count if shaped else 0)), np.zeros((k, len(kinks)))
        for n, (state, prior) in enumerate(zip(states, priors, strict=True)):
            moved = self._moved(state)
            acts = self._acts(state, prior)
            strength = acts * (state[ACTION] + state[RATE] * self._times_s)
            mean += strength * moved[0]
            for j, kink in enumerate(kinks):
                if kink.touch == n:
                    bent[:, j] = kink.profile * moved[kink.bends]
                    if kink.bends == STRENGTH and kinked is not None:
                        strength = strength + kinked[j] * kink.profile
            own = slopes[:, STATES * n : STATES * (n + 1)]
            own[:, X], own[:, Y] = strength * moved[1], strength * moved[2]
            own[:, LOG_RADIUS] = strength * moved[RADIUS_SLOPE]
            own[:, ACTION] = acts * moved[0]
            own[:, RATE] = acts * moved[0] * self._times_s
            own[:, VX], own[:, VY] = strength * moved[4], strength * moved[5]
            if shaped:
                shapes[:, SHAPES * n : SHAPES * (n + 1)] = (directions[n] * strength).T
        return TouchColumns(mean, slopes, shapes, bent)

    def kinks(self, states: Array, priors: Sequence[TouchPrior]) -> list[Kink]:
        """What changes within the scan may be beside straight lines: slides that begin or end within it as quadratic
        courses; how strongly a touch acts as any course, straight from step to step.
        """
        found = list[Kink]()
        for n, (state, prior) in enumerate(zip(states, priors, strict=True)):
            found += [Kink(n, STRENGTH, profile) for profile in self._strengths(state, prior)]
            found += self._slides(n, state, prior)
        return found

    def at(self, profile: Array, time_s: float) -> float:
        """A profile (K,) at an instant."""
        order = np.argsort(self._times_s)
        return float(np.interp(time_s, self._times_s[order], profile[order]))

    def jitter(self, states: Array, priors: Sequence[TouchPrior]) -> Array:
        """(K,) standard deviation of each value by how a touch changes within the steps of its course."""
        variance = np.zeros(len(self._times_s))
        for state, prior in zip(states, priors, strict=True):
            if instants := self._instants(prior):
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

    def _acts(self, state: Array, prior: TouchPrior) -> Array:
        """(K,) 1 where the touch acts, else 0."""
        acts = state[ACTION] + state[RATE] * self._times_s > 0
        acts &= (self._times_s >= prior.since_s) & (self._times_s < prior.until_s)
        return np.asarray(acts, float)

    def _moved(self, state: Array) -> Array:
        """(6, K) response where the touch is when each value is measured, its slopes to x, y, log radius, and those to
        the velocity.
        """
        x, y, log_radius = state[X], state[Y], state[LOG_RADIUS]
        moves = np.hypot(state[VX], state[VY]) * self.span_s > max(MOVES, BENDS_BY * np.exp(log_radius))
        middle = self._response.with_slopes(x, y, log_radius)
        if not moves:
            return np.vstack([middle, middle[1:3] * self._times_s])
        half_s = self.span_s / 2
        first = self._response.with_slopes(x - state[VX] * half_s, y - state[VY] * half_s, log_radius)
        last = self._response.with_slopes(x + state[VX] * half_s, y + state[VY] * half_s, log_radius)
        before, at, after = self._lagrange
        moved = before * first + at * middle + after * last
        velocity = half_s * (after * last[1:3] - before * first[1:3])
        return np.vstack([moved, velocity])

    def _strengths(self, state: Array, prior: TouchPrior) -> list[Array]:
        """(K,) each: hats of how strongly a touch acts. Those of a touch that begins or ends at once are finer about
        that instant.
        """
        instants = self._instants(prior)
        ((changes, _),) = self.bends(state[None])
        rise = abs(state[RATE]) * self.span_s / 2
        most = abs(state[ACTION]) + rise
        may = most if instants else 2 * rise
        centres = [instant + step * SUDDEN_S for instant in instants for step in SUDDEN_STEPS]
        hats = [SUDDEN_SD * most * self._hat(centre, SUDDEN_S) for centre in centres]
        if instants or changes:
            size = COURSE_SD * may * self._acts(state, prior)
            steps = max(1, round(self.span_s / COURSE_S))
            knots = np.linspace(-self.span_s / 2, self.span_s / 2, steps + 1)
            hats += [size * self._hat(knot, self.span_s / steps) for knot in knots]
        return [hat for hat in hats if hat.any()]

    def _hat(self, centre_s: float, half_s: float) -> Array:
        return np.asarray(np.maximum(0.0, 1 - np.abs(self._times_s - centre_s) / half_s))

    def bends(self, states: Array) -> list[tuple[bool, bool]]:
        """Of each touch whether its action changes, and whether it moves, by enough to do so unevenly."""
        rise = np.abs(states[:, RATE]) * self.span_s / 2
        way = np.hypot(states[:, VX], states[:, VY]) * self.span_s / 2
        return list(zip(rise > CHANGES * np.abs(states[:, ACTION]), way > MOVES / 2, strict=True))

    def _slides(self, touch: int, state: Array, prior: TouchPrior) -> list[Kink]:
        ((_, moves),) = self.bends(state[None])
        if not moves:
            return []
        way = np.hypot(state[VX], state[VY]) * self.span_s / 2
        strength = self._acts(state, prior) * (state[ACTION] + state[RATE] * self._times_s)
        return [Kink(touch, axis + 1, strength * (KINK * way) * self._bend) for axis in (X, Y)]
