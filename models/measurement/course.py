"""What touches of known states do to a scan whose values were measured one after the other, and the slopes of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.measurement.numbers import BENDS_BY, KINK, MOVES, SUDDEN_S, SUDDEN_SD
from models.measurement.response import TouchModel
from models.measurement.touch import ACTION, LOG_RADIUS, RATE, SHAPES, STATES, VX, VY, TouchPrior, X, Y

Array = NDArray[np.float64]

RADIUS_SLOPE = 3  # of TouchModel.with_slopes
SUDDEN_STEPS = (-2, -1, 0, 1, 2)
CHANGES = 0.1  # of its strength within a scan, from which on a touch's change may bend


@dataclass(frozen=True)
class TouchColumns:
    """Of T touches at some states: relative change of |Z|, not of its logarithm."""

    mean: Array  # (K,) of plain discs
    slopes: Array  # (K, 7 T) of it to the states
    shapes: Array  # (K, 9 T) of the touches' own directions; (K, 0) where nobody asked


class TouchCourse:
    """Of one scan. times_s (K,): when each value was measured, from its middle on; span_s: how long it took."""

    def __init__(self, response: TouchModel, times_s: Array, span_s: float) -> None:
        self._response, self._times_s, self.span_s = response, times_s, span_s
        u = 2 * times_s / span_s
        self._lagrange = np.stack([(u**2 - u) / 2, 1 - u**2, (u**2 + u) / 2])
        self._bends = u**2 - 1 / 3, u**3 - 0.6 * u

    def directions(self, states: Array) -> list[Array]:
        """(9, K) each touch's own directions, of unit action."""
        return [self._response.directions(state[X], state[Y], state[LOG_RADIUS]) for state in states]

    def columns(self, states: Array, priors: Sequence[TouchPrior], directions: Sequence[Array] = ()) -> TouchColumns:
        """states (T, 7). directions: the touches' own, of states near these; none: nobody asks for them."""
        count, k, shaped = len(priors), len(self._times_s), len(directions) > 0
        mean, slopes = np.zeros(k), np.empty((k, STATES * count))
        shapes = np.zeros((k, SHAPES * count if shaped else 0))
        for n, (state, prior) in enumerate(zip(states, priors, strict=True)):
            moved = self._moved(state)
            acts = self._acts(state, prior)
            strength = acts * (state[ACTION] + state[RATE] * self._times_s)
            mean += strength * moved[0]
            own = slopes[:, STATES * n : STATES * (n + 1)]
            own[:, X], own[:, Y] = strength * moved[1], strength * moved[2]
            own[:, LOG_RADIUS] = strength * moved[RADIUS_SLOPE]
            own[:, ACTION] = acts * moved[0]
            own[:, RATE] = acts * moved[0] * self._times_s
            own[:, VX], own[:, VY] = strength * moved[4], strength * moved[5]
            if shaped:
                shapes[:, SHAPES * n : SHAPES * (n + 1)] = (directions[n] * strength).T
        return TouchColumns(mean, slopes, shapes)

    def kinks(self, states: Array, priors: Sequence[TouchPrior]) -> Array:
        """(K, n) what changes within the scan may be beside straight lines, each of variance 1: ramps and slides that
        begin or end within it, as quadratic and cubic courses, and how a touch that began or ended at once did so.
        """
        found = list[Array]()
        for state, prior in zip(states, priors, strict=True):
            found += self._bent(state, prior)
            found += self._sudden(state, prior)
        return np.array(found).T if found else np.zeros((len(self._times_s), 0))

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

    def _sudden(self, state: Array, prior: TouchPrior) -> list[Array]:
        """About the instant at which a touch begins or ends at once: any course for some milliseconds."""
        instants = [t for t in (prior.since_s, prior.until_s) if abs(t) < self.span_s]
        if not instants:
            return []
        most = abs(state[ACTION]) + abs(state[RATE]) * self.span_s / 2
        column = SUDDEN_SD * most * self._response(state[X], state[Y], state[LOG_RADIUS])
        centres = [instant + step * SUDDEN_S for instant in instants for step in SUDDEN_STEPS]
        hats = [np.maximum(0.0, 1 - np.abs(self._times_s - centre) / SUDDEN_S) for centre in centres]
        return [column * hat for hat in hats if hat.any()]

    def bends(self, states: Array) -> list[tuple[bool, bool]]:
        """Of each touch whether its action changes, and whether it moves, by enough to do so unevenly."""
        rise = np.abs(states[:, RATE]) * self.span_s / 2
        way = np.hypot(states[:, VX], states[:, VY]) * self.span_s / 2
        return list(zip(rise > CHANGES * np.abs(states[:, ACTION]), way > MOVES / 2, strict=True))

    def _bent(self, state: Array, prior: TouchPrior) -> list[Array]:
        found = list[Array]()
        square, cube = self._bends
        rise = abs(state[RATE]) * self.span_s / 2
        way = np.hypot(state[VX], state[VY]) * self.span_s / 2
        ((changes, moves),) = self.bends(state[None])
        if not (changes or moves):
            return found
        moved, acts = self._moved(state), self._acts(state, prior)
        if changes:
            bent = KINK * rise * acts * moved[0]
            found += [bent * square, bent * cube]
        if moves:
            strength = acts * (state[ACTION] + state[RATE] * self._times_s)
            found += [strength * (KINK * way) * moved[axis] * square for axis in (1, 2)]
        return found
