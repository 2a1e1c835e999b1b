"""Touches fitted to one scan by Gauss-Newton in the whitened space of everything that is no touch.

    y = log(1 + m(states) + D shapes + K kinks) + e,        e ~ N(0, S + (misfit |m|)^2 M)

Shapes and kinks are linear with Gaussian priors, so they are marginalised by being solved for. Evidence is Laplace's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from models.measurement import numbers as n
from models.measurement.arrays import Array
from models.measurement.course import STRENGTH, Kinks, TouchColumns, TouchCourse, places_of
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
from models.measurement.whitening import Whitening

LEAST_MEAN = -0.9  # relative change: nothing takes all of an impedance away
SIZE_CHANGED = 2.5  # times the squared change, or its inverse, beyond which its misfit is taken anew
MOST_DAMPING = 1e4


@dataclass(frozen=True)
class OwnDirections:
    """The touches' own directions, (9, K) each, about their states (T, 7)."""

    states: Array
    directions: list[Array]

    def near(self, states: Array) -> bool:
        """Whether those of other states are the same."""
        if states.shape != self.states.shape:
            return False
        away = np.abs(states - self.states)
        return not ((away[:, PLACE] > n.HALF_PIXEL).any() or (away[:, LOG_RADIUS] > n.TURNS_LOG).any())


@dataclass(frozen=True)
class FittedScan:
    """One scan as a fit sees it."""

    y: Array  # (K,) log of |Z| over what is predicted without touches; 0 where it does not count
    covariance: Array  # (K, K) of y but for touches
    course: TouchCourse
    misfit: Array  # (K, K) of trace 1
    live: int  # measurements that count
    before: FoundTouches | None = None  # of a moment ago, whose whitening and directions are as good as its own
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
    white: Whitening  # of the scan's covariance and the misfit of touches whose squared change is size2
    size2: float
    weighted_residual: Array  # (K,) S^-1 of the residual
    left: Array  # (K,) residual
    design: Array  # (K, N) whitened slopes of all that was solved for
    solved: Array  # (N, N) its posterior covariance
    steps: int
    own: OwnDirections

    def __len__(self) -> int:
        return len(self.priors)

    def informations(self, responses: Array) -> Array:
        """(n,) of one further touch of each response (K, n), touches fitted: 1 / variance of its strength."""
        columns = self.white(responses)
        along = self.design.T @ columns
        whole = np.sum(columns**2, axis=0)
        return np.asarray(np.maximum(whole - np.sum(along * (self.solved @ along), axis=0), n.LEAST_TOLD * whole))


@dataclass
class _Linearisation:
    """About some states, shapes and kinks."""

    states: Array
    rest: Array  # shapes and kinks
    columns: TouchColumns
    left: Array  # (K,) residual
    sloped: Array  # (K, N) slopes of log |Z|
    residual: Array  # whitened
    design: Array  # whitened
    off: Array  # (N,) from the priors' means
    precision: Array  # (N,) of the priors

    @cached_property
    def objective(self) -> float:
        return float(self.residual @ self.residual + self.precision @ self.off**2)

    @cached_property
    def slope(self) -> Array:
        """(N,) of the objective, downhill."""
        return np.asarray(self.design.T @ self.residual - self.precision * self.off)

    @cached_property
    def _measured(self) -> Array:
        """(N, N) normal equations of the measurements alone."""
        return np.asarray(self.design.T @ self.design)

    def damped(self, damping: float) -> Array:
        """(N, N) normal equations, the measurements' diagonal raised as Levenberg does."""
        normal = self._measured.copy()
        np.fill_diagonal(normal, normal.diagonal() * (1 + damping) + self.precision)
        return normal

    def step(self, damping: float) -> Array:
        """(N,) not finite where measurements of any magnitude leave no normal equations."""
        _, step, failed = lapack.dposv(self.damped(damping), self.slope, lower=1)
        return np.full_like(self.slope, np.nan) if failed else np.asarray(step)


class TouchFitter:
    """Gauss and Newton's steps, damped as Levenberg's, to the maximum a posteriori of some touches; at it, Laplace's
    approximation.
    """

    def __init__(self, scene: FittedScan, priors: Sequence[TouchPrior], misfit: float = n.MISFIT) -> None:
        self._scene, self._priors, self._misfit = scene, tuple(priors), misfit
        self._shaped = not all(is_disc(prior) for prior in self._priors)
        shaped = self._priors if self._shaped else ()
        means = [*(prior.mean for prior in self._priors), *(prior.shape for prior in shaped)]
        sds = [*(prior.sd for prior in self._priors), *(prior.shape_sd for prior in shaped)]
        self._mean, self._precision = np.concatenate(means), np.concatenate(sds) ** -2.0
        self._states = STATES * len(self._priors)
        self._shapes = len(self._mean) - self._states
        known = all(prior.found or (prior.sd[PLACE] < n.MOST_WAY).all() for prior in self._priors)
        self._tells_after = 0 if known else n.TELLS_AFTER
        self.steps = 0

    def fit(self, most_steps: int) -> FoundTouches:
        """Raises ValueError where a covariance is none."""
        states = within_limits(np.stack([prior.start for prior in self._priors]))
        self._kinks = list[Kinks]()
        rest = self._renew(states, self._mean[self._states :])
        columns = self._columns(states, rest)
        self._whiten(states, columns)
        point = self._descend(self._linearised(states, rest, columns), most_steps)
        changed, moved = not _same_misfit(_size2(point.columns), self._size2), self._moved(point.states)
        rest = self._renew(point.states, point.rest) if moved else point.rest
        if changed:
            self._whiten(point.states, point.columns)
        if moved or changed:
            point = self._descend(self._linearised(point.states, rest, self._columns(point.states, rest)), most_steps)
        if _size2(point.columns) < 1 / SIZE_CHANGED * self._size2:  # larger touches' misfit explains anything
            self._whiten(point.states, point.columns)
            point = self._linearised(point.states, point.rest, point.columns)
        return self._posterior(point)

    def _columns(self, states: Array, rest: Array) -> TouchColumns:
        directions = self._own.directions if self._shaped else []
        return self._scene.course.columns(states, self._priors, directions, self._kinks, rest[self._shapes :])

    def _renew(self, states: Array, rest: Array) -> Array:
        """Take the touches' own directions anew, and how their courses may bend. Returns shapes and kinks as far as
        they are the same as in rest (N,), the others at their means.
        """
        scene, course, before = self._scene, self._scene.course, self._kinks
        known = None if scene.before is None else scene.before.own
        self._bends = course.bends(states, self._priors)
        if known is None or not known.near(states) or (self._shaped and not known.directions):
            known = OwnDirections(states, course.directions(states) if self._shaped else [])
        self._own = known
        self._kinks = course.kinks(states, self._priors)
        bent = dict[tuple[int, int, int], Array]()
        for kinks, among in zip(before, places_of(before, self._shapes), strict=True):
            bent[kinks.touch, kinks.bends, len(kinks)] = rest[among]
        kinked = [bent.get((k.touch, k.bends, len(k)), np.zeros(len(k))) for k in self._kinks]
        self._precisions = np.concatenate([self._precision, *map(np.ones_like, kinked)])
        return np.concatenate([rest[: self._shapes], *kinked])

    def _moved(self, states: Array) -> bool:
        """Whether their directions are others by now, or a course bends that was straight."""
        bends = np.array(self._scene.course.bends(states, self._priors)) & ~np.array(self._bends)
        return bool(bends.any()) or not self._own.near(states)

    def _descend(self, point: _Linearisation, most_steps: int) -> _Linearisation:
        """Levenberg and Marquardt's steps until they gain nothing, or what is left to go is linear."""
        damping = float(n.DAMPING)
        for _ in range(most_steps):
            step = point.step(damping)
            if not np.isfinite(step).all():
                break  # measurements of any magnitude: nothing explains them
            if self._is_linear(point.states, linear := point.step(0.0)) or self._hopeless(point, linear):
                break
            self.steps += 1
            tried = self._stepped(point, step)
            gained = point.objective - tried.objective
            if gained > 0:
                point, damping = tried, max(damping / 3, 1e-5)
            else:
                damping = 10 * max(damping, n.DAMPING)
            if abs(gained) < max(n.DONE, n.DONE_SHARE * point.objective) or damping > MOST_DAMPING:
                break
        return point

    def _hopeless(self, point: _Linearisation, step: Array) -> bool:
        """Whether the linear optimum explains nothing either. Of touches whose place is hardly known the first steps do
        not tell where they end.
        """
        if self.steps < self._tells_after:
            return False
        return point.objective - float(point.slope @ step) > n.HOPELESS * self._scene.live

    def _whiten(self, states: Array, columns: TouchColumns) -> None:
        size2, scene = max(_size2(columns), n.TINY), self._scene
        if (before := scene.before) is not None and _same_misfit(size2, before.size2):
            self._white, self._size2 = before.white, before.size2
            return
        covariance = scene.covariance + self._misfit**2 * size2 * scene.misfit
        covariance[np.diag_indices_from(covariance)] += scene.course.jitter(states, self._priors) ** 2
        self._white, self._size2 = Whitening.of(covariance), size2

    def _linearised(self, states: Array, rest: Array, columns: TouchColumns) -> _Linearisation:
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
        off = np.concatenate([states.ravel(), rest])
        off[: len(self._mean)] -= self._mean
        return _Linearisation(states, rest, columns, left, sloped, residual, design, off, self._precisions)

    def _stepped(self, point: _Linearisation, step: Array) -> _Linearisation:
        """Each touch goes only so far that its disc stays near where it was."""
        own = step[: self._states].reshape(-1, STATES)
        for state, each in zip(point.states, own, strict=True):
            most = max(n.STEP_SHARE * float(np.exp(state[LOG_RADIUS])), n.LEAST_STEP)
            way = float(np.hypot(each[X], each[Y]))
            each *= min(1.0, most / max(way, n.TINY), n.STEP_LOG / max(abs(each[LOG_RADIUS]), n.TINY))
        states, rest = within_limits(point.states + own), point.rest + step[own.size :]
        return self._linearised(states, rest, self._columns(states, rest))

    def _is_linear(self, states: Array, step: Array) -> bool:
        """Whether a step is so small that slopes hold: nothing new would be seen where it ends."""
        half_s = self._scene.course.span_s / 2
        step = step[: self._states].reshape(-1, STATES)
        moved = np.abs(step)
        radius, acts = np.exp(states[:, LOG_RADIUS]), np.abs(states[:, ACTION])
        way = np.hypot(moved[:, X], moved[:, Y]) + half_s * np.hypot(moved[:, VX], moved[:, VY])
        if (way > n.LINEAR * radius).any() or (moved[:, LOG_RADIUS] > n.LINEAR).any():
            return False
        if (moved[:, ACTION] + half_s * moved[:, RATE] > n.LINEAR * acts).any():
            return False
        return bool((within_limits(states + step) == states + step).all())

    def _posterior(self, point: _Linearisation) -> FoundTouches:
        normal = Whitening.of(point.damped(0.0))
        solved = normal.w.T @ normal.w
        step = solved @ point.slope
        occam = -normal.log_density - 0.5 * float(np.log(self._precisions).sum())
        count = self._states
        best = point.residual - point.design @ step  # what the linear optimum would leave
        states, rest, left, residual, objective = point.states, point.rest, point.left, point.residual, point.objective
        if self._is_linear(states, step):
            states, rest = states + step[:count].reshape(-1, STATES), rest + step[count:]
            left, residual = left - point.sloped @ step, best
            objective -= float(point.slope @ step)
        to_sample = self._to_sample(len(rest))
        then = states + (to_sample[:, count:] @ rest).reshape(-1, STATES)
        then[:, ACTION] = np.minimum(then[:, ACTION], MOST_ACTS)
        if self._shaped:
            outline, unsure = rest[: self._shapes], np.diag(solved)[count : len(self._mean)]
        else:
            outline = np.concatenate([prior.shape for prior in self._priors])
            unsure = np.concatenate([prior.shape_sd for prior in self._priors]) ** 2
        return FoundTouches(
            priors=self._priors,
            states=then,
            covariance=to_sample @ solved @ to_sample.T,
            shapes=outline.reshape(-1, SHAPES),
            shape_variance=unsure.reshape(-1, SHAPES),
            chi2=float(residual @ residual) / max(self._scene.live, 1),
            evidence=self._white.log_density - 0.5 * objective - occam,
            white=self._white,
            size2=self._size2,
            weighted_residual=self._white.w.T @ best,
            left=left,
            design=point.design,
            solved=solved,
            steps=self.steps,
            own=self._own,
        )

    def _to_sample(self, rest: int) -> Array:
        """(7 T, N) from all that was solved for to the states at the sample: kinks add to a touch's action then."""
        to_sample = np.eye(self._states, self._states + rest)
        for kinks, among in zip(self._kinks, places_of(self._kinks, len(self._mean)), strict=True):
            if kinks.bends == STRENGTH and self._priors[kinks.touch].until_s == np.inf:
                at_sample = self._scene.course.at(kinks.profiles, self._scene.sample_s)
                to_sample[STATES * kinks.touch + ACTION, among] = at_sample
        return to_sample


def _size2(columns: TouchColumns) -> float:
    return float(columns.mean @ columns.mean)


def _same_misfit(size2: float, other: float) -> bool:
    """Whether the misfit of touches of these squared changes is nearly the same."""
    return 1 / SIZE_CHANGED < size2 / other < SIZE_CHANGED
