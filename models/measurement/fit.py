"""TouchTracks fitted to one scan by Gauss-Newton in the whitened space of everything that is no touch.

    y = log(1 + m(states) + D shapes + K kinks) + e,        e ~ N(0, S + (misfit |m|)^2 M)

Shapes and kinks are linear with Gaussian priors, so they are marginalised by being solved for. Evidence is Laplace's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from models.measurement.course import STRENGTH, Kinks, TouchColumns, TouchCourse
from models.measurement.covariance.whitening import Whitening, diagonal_of, factor
from models.measurement.numbers import (
    DAMPING,
    DONE,
    DONE_SHARE,
    LEAST_ACTION,
    LEAST_STEP,
    LINEAR,
    MISFIT,
    STEP_LOG,
    STEP_SHARE,
    TURNS,
    TURNS_LOG,
)
from models.measurement.touch import (
    ACTION,
    LOG_RADIUS,
    MOST_ACTS,
    PLACE,
    RATE,
    SHAPES,
    STATES,
    VX,
    VY,
    TouchPrior,
    X,
    Y,
    is_disc,
    within_limits,
)

Array = NDArray[np.float64]

LEAST_MEAN = -0.9  # relative change: nothing takes all of an impedance away
SIZE_CHANGED = (0.4, 2.5)  # of the squared change, beyond which its misfit is taken anew
MOST_DAMPING = 1e4


@dataclass(frozen=True)
class KnownWhitening:
    """Of a scan's covariance and the misfit of touches whose squared change is size2."""

    white: Whitening
    size2: float


@dataclass(frozen=True)
class Turned:
    """The touches' own directions, (9, K) each, about their states (T, 7)."""

    states: Array
    directions: list[Array]

    def near(self, states: Array) -> bool:
        """Whether those of other states are the same."""
        if states.shape != self.states.shape:
            return False
        away = np.abs(states - self.states)
        return not ((away[:, PLACE] > TURNS).any() or (away[:, LOG_RADIUS] > TURNS_LOG).any())


@dataclass(frozen=True)
class FittedScan:
    """One scan as a fit sees it."""

    y: Array  # (K,) log of |Z| over what is predicted without touches; 0 where it does not count
    covariance: Array  # (K, K) of y but for touches
    course: TouchCourse
    misfit: Array  # (K, K) of trace 1
    live: int  # measurements that count
    known: KnownWhitening | None = None  # of a moment ago, as good as this covariance's own
    turned: Turned | None = None  # of a moment ago
    sample_s: float = 0.0  # for when what is found is said, from the middle of the scan on


@dataclass(frozen=True)
class FoundTouches:
    """Posterior of T touches. Action + rate * sample_s is how strongly one acts at sample_s, kinks included."""

    priors: tuple[TouchPrior, ...]
    states: Array  # (T, 7)
    covariance: Array  # (7 T, 7 T) shapes and kinks marginalised
    shapes: Array  # (T, 9)
    shape_variance: Array  # (T, 9)
    chi2: float  # squared whitened residual a measurement
    evidence: float  # log
    white: Whitening
    weighted_residual: Array  # (K,) S^-1 of the residual
    left: Array  # (K,) residual
    design: Array  # (K, N) whitened slopes of all that was solved for
    solved: Array  # (N, N) its posterior covariance
    steps: int
    known: KnownWhitening
    turned: Turned

    def __len__(self) -> int:
        return len(self.priors)

    def information(self, response: Array) -> float:
        """Of a further touch of this response (K,), touches fitted: 1 / variance of its strength."""
        return float(self.informations(response[:, None])[0])

    def informations(self, responses: Array) -> Array:
        """(n,) of each of these responses (K, n) alone."""
        columns = self.white(responses)
        along = self.design.T @ columns
        whole = np.sum(columns**2, axis=0)
        return np.asarray(np.maximum(whole - np.sum(along * (self.solved @ along), axis=0), 0.02 * whole))


@dataclass
class _Point:
    """One linearisation."""

    states: Array
    rest: Array  # shapes and kinks
    columns: TouchColumns
    left: Array  # (K,) residual
    sloped: Array  # (K, N) slopes of log |Z|
    residual: Array  # whitened
    design: Array  # whitened
    objective: float


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one linearisation."""

    measured: Array  # (N, N) of the measurements alone
    precision: Array  # (N,) of the priors
    slope: Array  # (N,) of the objective, downhill

    def damped(self, damping: float) -> Array:
        """(N, N) with the priors, the measurements' diagonal raised as Levenberg does."""
        normal = self.measured.copy()
        diagonal = diagonal_of(normal)
        diagonal *= 1 + damping
        diagonal += self.precision
        return normal

    def step(self, damping: float) -> Array:
        """(N,) not finite where measurements of any magnitude leave no normal equations."""
        _, step, failed = lapack.dposv(self.damped(damping), self.slope, lower=1)
        return np.full_like(self.slope, np.nan) if failed else np.asarray(step)


@dataclass(frozen=True)
class _Linear:
    """A linearisation solved: its posterior, and the step to its optimum."""

    solved: Array  # (N, N)
    log_det: float
    precision: Array  # (N,) of the priors
    step: Array  # (N,)
    gains: float  # of the objective, by that step


class TouchFitter:
    """Gauss and Newton's steps, damped as Levenberg's, to the maximum a posteriori of some touches; at it, Laplace's
    approximation.
    """

    def __init__(self, scene: FittedScan, priors: Sequence[TouchPrior], misfit: float = MISFIT) -> None:
        self._scene, self._priors, self._misfit = scene, tuple(priors), misfit
        self._count = len(self._priors)
        self._mean = np.concatenate([prior.mean for prior in self._priors])
        self._precision = np.concatenate([prior.sd for prior in self._priors]) ** -2.0
        self._shaped = not all(is_disc(prior) for prior in self._priors)
        shaped = self._priors if self._shaped else ()
        self._shape_mean = np.concatenate([np.zeros(0), *(prior.shape for prior in shaped)])
        self._shape_precision = np.concatenate([np.zeros(0), *(prior.shape_sd**-2.0 for prior in shaped)])
        self.steps = 0

    def fit(self, most_steps: int) -> FoundTouches:
        """Raises ValueError where a covariance is none."""
        states = within_limits(np.stack([prior.start for prior in self._priors]))
        self._kinks = list[Kinks]()
        rest = self._turn(states, self._shape_mean)
        columns = self._columns(states)
        self._whiten(states, columns)
        states, columns = self._first_actions(states, columns)
        point = self._descend(self._point(states, rest, columns), most_steps)
        changed, moved = _changed(self._size2(point.columns), self._known), self._moved(point.states)
        rest = self._turn(point.states, point.rest) if moved else point.rest
        if changed:
            self._whiten(point.states, point.columns)
        if moved or changed:
            point = self._descend(self._point(point.states, rest, self._columns(point.states, rest)), most_steps)
        if self._size2(point.columns) < SIZE_CHANGED[0] * self._known.size2:  # larger touches' misfit explains anything
            self._whiten(point.states, point.columns)
            point = self._point(point.states, point.rest, point.columns)
        return self._posterior(point)

    def _columns(self, states: Array, rest: Array | None = None) -> TouchColumns:
        kinked = None if rest is None else rest[len(self._shape_mean) :]
        directions = self._turned.directions if self._shaped else []
        return self._scene.course.columns(states, self._priors, directions, self._kinks, kinked)

    def _turn(self, states: Array, rest: Array) -> Array:
        """Take the touches' own directions anew, and how their courses may bend. Returns shapes and kinks as far as
        they are the same as in rest (N,), the others at their means.
        """
        course, known, before = self._scene.course, self._scene.turned, self._kinks
        self._bends = course.bends(states, self._priors)
        if known is None or not known.near(states) or (self._shaped and not known.directions):
            known = Turned(states, course.directions(states) if self._shaped else [])
        self._turned = known
        self._kinks = course.kinks(states, self._priors)
        shapes = len(self._shape_mean)
        bent = dict[tuple[int, int, int], Array]()
        for kinks, among in zip(before, _each(before, shapes), strict=True):
            bent[kinks.touch, kinks.bends, len(kinks)] = rest[among]
        kinked = [bent.get((k.touch, k.bends, len(k)), np.zeros(len(k))) for k in self._kinks]
        made = np.concatenate([rest[:shapes], *kinked])
        self._precisions = np.concatenate([self._precision, self._shape_precision, np.ones(len(made) - shapes)])
        return made

    def _moved(self, states: Array) -> bool:
        """Whether their directions are others by now, or a course bends that was straight."""
        if not self._turned.near(states):
            return True
        both = zip(self._scene.course.bends(states, self._priors), self._bends, strict=True)
        return any((changes and not changed) or (moves and not moved) for (changes, moves), (changed, moved) in both)

    def _descend(self, point: _Point, most_steps: int) -> _Point:
        """Levenberg and Marquardt's steps until they gain nothing, or what is left to go is linear."""
        damping = float(DAMPING)
        for _ in range(most_steps):
            normal = self._normal(point)
            step = normal.step(damping)
            if not np.isfinite(step).all():
                break  # measurements of any magnitude: nothing explains them
            if self._is_linear(point.states, normal.step(0.0)):
                break
            self.steps += 1
            tried = self._stepped(point, step)
            gained = point.objective - tried.objective
            if gained > 0:
                point, damping = tried, max(damping / 10, 1e-5)
            else:
                damping = max(damping * 20, 1e-2)
            if abs(gained) < max(DONE, DONE_SHARE * point.objective) or damping > MOST_DAMPING:
                break
        return point

    def _whiten(self, states: Array, columns: TouchColumns) -> None:
        size2, scene = max(self._size2(columns), 1e-12), self._scene
        known = scene.known
        if known is not None and not _changed(size2, known):
            self._known = known
            return
        covariance = scene.covariance + self._misfit**2 * size2 * scene.misfit
        diagonal = diagonal_of(covariance)
        diagonal += scene.course.jitter(states, self._priors) ** 2
        self._known = KnownWhitening(Whitening.of(covariance), size2)

    @property
    def _white(self) -> Whitening:
        return self._known.white

    def _size2(self, columns: TouchColumns) -> float:
        return float(columns.mean @ columns.mean)

    def _first_actions(self, states: Array, columns: TouchColumns) -> tuple[Array, TouchColumns]:
        """TouchTracks whose action nobody knows yet begin with the likeliest."""
        unknown = [n for n in range(self._count) if states[n, ACTION] == 0]
        if not unknown:
            return states, columns
        states = states.copy()
        states[unknown, ACTION] = LEAST_ACTION
        columns = self._columns(states)
        at = [STATES * n + ACTION for n in unknown]
        response = self._white(columns.slopes[:, at])
        known = columns.mean - columns.slopes[:, at].sum(axis=1) * LEAST_ACTION
        seen = self._white(np.expm1(self._scene.y) - known)
        found = np.linalg.lstsq(response, seen, rcond=None)[0]
        states[unknown, ACTION] = np.maximum(found, LEAST_ACTION)
        columns = self._columns(states)
        self._whiten(states, columns)
        return states, columns

    def _point(self, states: Array, rest: Array, columns: TouchColumns) -> _Point:
        y, states_of = self._scene.y, columns.slopes.shape[1]
        both = np.empty((len(y), 1 + states_of + len(rest)))  # the residual, and the slopes of log |Z|
        left, sloped = both[:, 0], both[:, 1:]
        sloped[:, :states_of] = columns.slopes
        sloped[:, states_of:] = np.hstack([columns.shapes, columns.kinks])
        change = np.maximum(columns.mean + sloped[:, states_of:] @ rest, LEAST_MEAN)
        live = y != 0
        left[:] = np.where(live, y - np.log1p(change), 0.0)
        sloped *= np.where(live, 1 / (1 + change), 0.0)[:, None]
        whitened = self._white(both)
        residual, design = whitened[:, 0], whitened[:, 1:]
        off = self._off(states, rest)
        objective = float(residual @ residual + self._precisions @ off**2)
        return _Point(states, rest, columns, left, sloped, residual, design, objective)

    def _off(self, states: Array, rest: Array) -> Array:
        """From the priors' means."""
        off = np.concatenate([states.ravel() - self._mean, rest])
        off[self._mean.size : self._mean.size + self._shape_mean.size] -= self._shape_mean
        return off

    def _normal(self, point: _Point) -> _Normal:
        slope = point.design.T @ point.residual - self._precisions * self._off(point.states, point.rest)
        return _Normal(point.design.T @ point.design, self._precisions, slope)

    def _stepped(self, point: _Point, step: Array) -> _Point:
        self._limit(point.states, step)
        n = STATES * self._count
        states = within_limits(point.states + step[:n].reshape(-1, STATES))
        rest = point.rest + step[n:]
        return self._point(states, rest, self._columns(states, rest))

    def _is_linear(self, states: Array, step: Array) -> bool:
        """Whether a step is so small that slopes hold: nothing new would be seen where it ends."""
        n, half_s = STATES * self._count, self._scene.course.span_s / 2
        moved = np.abs(step[:n].reshape(-1, STATES))
        radius, acts = np.exp(states[:, LOG_RADIUS]), np.abs(states[:, ACTION])
        way = np.hypot(moved[:, X], moved[:, Y]) + half_s * np.hypot(moved[:, VX], moved[:, VY])
        if (way > LINEAR * radius).any() or (moved[:, LOG_RADIUS] > LINEAR).any():
            return False
        if (moved[:, ACTION] + half_s * moved[:, RATE] > LINEAR * acts).any():
            return False
        there = states + step[:n].reshape(-1, STATES)
        return bool((within_limits(there) == there).all())

    def _limit(self, states: Array, step: Array) -> None:
        """Shorten each touch's step so that its disc stays near where it was."""
        for n, state in enumerate(states):
            own = step[STATES * n : STATES * (n + 1)]
            way, most = float(np.hypot(own[X], own[Y])), max(STEP_SHARE * float(np.exp(state[LOG_RADIUS])), LEAST_STEP)
            own *= min(1.0, most / max(way, 1e-9), STEP_LOG / max(abs(own[LOG_RADIUS]), 1e-9))

    def _solve(self, point: _Point) -> _Linear:
        normal = self._normal(point)
        w, log_density = factor(normal.damped(0.0))
        solved = w.T @ w
        step = solved @ normal.slope
        return _Linear(solved, -2 * log_density, normal.precision, step, float(normal.slope @ step))

    def _posterior(self, point: _Point) -> FoundTouches:
        linear = self._solve(point)
        occam = 0.5 * (linear.log_det - float(np.log(linear.precision).sum()))
        n, shapes = STATES * self._count, len(self._shape_mean)
        best = point.residual - point.design @ linear.step  # what the linear optimum would leave
        states, rest, left, residual, objective = point.states, point.rest, point.left, point.residual, point.objective
        if self._is_linear(states, linear.step):
            states, rest = states + linear.step[:n].reshape(-1, STATES), rest + linear.step[n:]
            left, residual, objective = left - point.sloped @ linear.step, best, objective - linear.gains
        said = self._said(n, len(rest))
        then = states + (said[:, n:] @ rest).reshape(-1, STATES)
        then[:, ACTION] = np.minimum(then[:, ACTION], MOST_ACTS)
        if self._shaped:
            outline, unsure = rest[:shapes], np.diag(linear.solved)[n : n + shapes]
        else:
            outline = np.concatenate([prior.shape for prior in self._priors])
            unsure = np.concatenate([prior.shape_sd for prior in self._priors]) ** 2
        return FoundTouches(
            priors=self._priors,
            states=then,
            covariance=said @ linear.solved @ said.T,
            shapes=outline.reshape(self._count, SHAPES),
            shape_variance=unsure.reshape(self._count, SHAPES),
            chi2=float(residual @ residual) / max(self._scene.live, 1),
            evidence=self._white.log_density - 0.5 * objective - occam,
            white=self._white,
            weighted_residual=self._white.w.T @ best,
            left=left,
            design=point.design,
            solved=linear.solved,
            steps=self.steps,
            known=self._known,
            turned=self._turned,
        )

    def _said(self, states: int, rest: int) -> Array:
        """(7 T, N) from all that was solved for to the states that are said: kinks add to a touch's action then."""
        said = np.eye(states, states + rest)
        for kinks, among in zip(self._kinks, _each(self._kinks, states + len(self._shape_mean)), strict=True):
            if kinks.bends == STRENGTH and self._priors[kinks.touch].until_s == np.inf:
                said[STATES * kinks.touch + ACTION, among] = self._scene.course.at(kinks.profiles, self._scene.sample_s)
        return said


def _each(kinks: Sequence[Kinks], first: int) -> list[slice]:
    """Where each of them is among all that is solved for, from place `first` on."""
    ends = first + np.cumsum([len(each) for each in kinks], dtype=int)
    return [slice(end - len(each), end) for each, end in zip(kinks, ends, strict=True)]


def _changed(size2: float, known: KnownWhitening) -> bool:
    """Whether the misfit of touches of this squared change is another."""
    return not SIZE_CHANGED[0] < size2 / known.size2 < SIZE_CHANGED[1]
