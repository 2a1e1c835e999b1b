"""One touch fitted to one frame: place, size, drop and kind, each with its posterior uncertainty (numpy and scipy).

The frame is d = f(theta) + e, with theta of `touch_parameters`, f of `touch_response` and e normal of a covariance that
the caller knows (`response_error`): noise, drift, and what no model gets right. Gauss-Newton steps, damped
(Levenberg-Marquardt) and kept only where they raise the posterior, lead from the network's answer to the likeliest
theta. There the posterior is taken as normal (Laplace), which gives each kind's evidence, and so what shape it is
(MacKay, "Information Theory, Inference, and Learning Algorithms", chapters 27 and 28).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.special import erf

from models.response_error import CORNERED, FrameErrors, seen_error, widening
from models.shapes import KINDS, Array, Shape
from models.touch_parameters import FREE, HIGH, LOW, MEAN, PERIOD, SD, shape_of, turn_between
from models.touch_posterior import UNLIKELY_NOW, KindFit, TouchPosterior, posterior_of
from models.touch_response import TouchGrid, TouchResponse, effective_drop

STARTS = {"triangle": 4, "rectangle": 6, "square": 4, "L": 8}  # rotations looked at in one period
TRIED = {"triangle": 2, "rectangle": 3, "square": 2, "L": 4}  # of them, evenly apart, are fitted to the end
ROUNDER = {"circle": 1.0, "hertz": 1.1, "triangle": 1.55, "rectangle": 1.3, "square": 1.25, "L": 1.4}
"""Circumscribed radius of each kind over that of the circle of its area."""

MOST = np.array([0.2, 0.2, 0.4, 0.8, 0.5, 0.4])  # of one step
STEP = np.array([0.02, 0.02, 0.03, 0.0, 0.05, 0.04])  # for derivatives of coverage; place: of the radius
DONE = 0.05  # where a step promises less, in nats times two, it is not taken
STEPS = 12
UNLIKELY = 12.0  # nats behind the likeliest kind: not fitted further
NO_MORE = 1.0  # where a step promised less and kept nothing, the cells' own error is what is left
NEAR = 0.04  # in every parameter: the same optimum
ERROR_SCALES = (1.0, 0.5, 0.25)
"""Of the response's error over what is assumed, each as likely before: what it is of a touch is not known, and a kind
that leaves much less of the frame than was assumed is the likelier for it.
"""
BEND_STEP, ROOM = 0.12, 1.2  # of the radius: for its second derivatives, and the cells that they take
SAME_TURN = 0.08  # of a kind's period: rotations no further apart are of one optimum


class TouchFit:
    """Fits of single touches on one skin. scales: see ERROR_SCALES; where only candidates are wanted, 1 is enough."""

    def __init__(self, response: TouchResponse, scales: Sequence[float] = ERROR_SCALES) -> None:
        self.response, self.scales = response, scales

    def __call__(
        self,
        d: Array,
        errors: FrameErrors,
        start: Shape,
        kinds: Sequence[str] = KINDS,
        radius: float | None = None,
        before: Mapping[str, Array] | None = None,
    ) -> TouchPosterior:
        """d (K,), as `PreReconstructor.difference` gives it. start: about where and how large.
        radius: of the indenter, where it is known; model units. before: theta of each kind that may be it, from an
        earlier frame of the same touch: other kinds and starts are not tried.

        Raises ValueError where the covariance is none.
        """
        found: list[KindFit] = []
        for kind in sorted(before or kinds, key=lambda k: FREE[k]):
            assumed = FrameErrors(errors.noise, CORNERED[kind] ** 2 * errors.model)
            frame = _Whitened(self.response, d, assumed, self.scales)
            best = max((fit.as_assumed for fit in found), default=-np.inf)
            starts = [before[kind]] if before else self._starts(frame, kind, start, radius)
            optima: list[KindFit] = []
            for theta in starts:
                fit = frame.fit(kind, theta, radius, best, [other.theta for other in optima])
                optima += [fit] if fit else []
            found += over_rotations(optima)
        found.sort(key=lambda fit: -fit.evidence)
        weight = np.exp([fit.evidence - found[0].evidence for fit in found])
        return posterior_of(tuple(found), weight / weight.sum())

    def _starts(self, frame: _Whitened, kind: str, start: Shape, radius: float | None) -> list[Array]:
        """The likeliest rotation, place and area being the start's, and those that divide the period with it: its
        neighbours lead to the same optimum, and the right one may look unlikely until size and drop fit it.
        """
        size = radius or float(np.sqrt(start.area / np.pi)) * ROUNDER[kind]
        drop = float(np.clip(start.drop * (1.2 if kind == "hertz" else 1.0), 0.03, 0.9))
        x, y = start.centroid
        theta = np.array([x, y, np.log(size), np.log(drop / (1 - drop)), 0.0, MEAN[5]])[: FREE[kind]]
        if kind not in PERIOD:
            return [theta]
        turned = []
        for rotation in PERIOD[kind] * np.arange(STARTS[kind]) / STARTS[kind]:
            theta = theta.copy()
            theta[4] = rotation
            theta[:2] += (x, y) - shape_of(kind, theta).centroid  # an L's centroid is not its circle's centre
            turned.append(theta)
        best = int(np.argmin([frame.misfit(kind, theta) for theta in turned]))
        return [turned[(best + k * STARTS[kind] // TRIED[kind]) % STARTS[kind]] for k in range(TRIED[kind])]


def bent(response: TouchResponse, posterior: TouchPosterior) -> TouchPosterior:
    """A fit with the bend of each kind that may be followed."""
    fits = (
        replace(fit, bend=bend(response, fit.kind, fit.theta))
        if posterior.probability[fit.kind] > UNLIKELY_NOW
        else fit
        for fit in posterior.fits
    )
    return replace(posterior, fits=tuple(fits))


def bend(response: TouchResponse, kind: str, theta: Array) -> Array:
    """(K, 3) half the second derivatives of the response to x x, x y and y y of a touch's place."""
    shape = shape_of(kind, theta)
    grid = response.grid(shape.x, shape.y, ROOM * shape.radius)
    h = BEND_STEP * shape.radius

    def at(x: int, y: int) -> Array:
        moved = shape_of(kind, theta + h * np.array([x, y, *[0] * (len(theta) - 2)]))
        return response(grid, effective_drop(grid.coverage(moved), moved.drop, kind))[0]

    here, right, left, up, down = at(0, 0), at(1, 0), at(-1, 0), at(0, 1), at(0, -1)
    along, across = right + left - 2 * here, up + down - 2 * here
    both = at(1, 1) + at(-1, -1) - 2 * here - along - across
    return np.stack([along, both, across], axis=1) / (2 * h**2)


def over_rotations(optima: list[KindFit]) -> list[KindFit]:
    """The likeliest of one kind's optima, with the evidence of all rotations: each optimum's Gaussian, as far as the
    next optimum. A Gaussian alone would count rotations that are not there, more than a period of them where a small
    touch says nothing of its rotation, and a square would be likelier than the circle that explains as much.
    """
    optima = sorted(optima, key=lambda fit: -fit.evidence)
    if not optima or optima[0].kind not in PERIOD:
        return optima[:1]
    evidence, period = [], PERIOD[optima[0].kind]
    distinct: list[KindFit] = []
    for fit in optima:
        if all(abs(turn_between(fit.kind, fit.theta, other.theta)) > SAME_TURN * period for other in distinct):
            distinct.append(fit)
    for fit in distinct:
        turns = [turn_between(fit.kind, fit.theta, other.theta) for other in distinct if other is not fit]
        ahead = min((turn % period for turn in turns), default=period) / 2
        behind = min((-turn % period for turn in turns), default=period) / 2
        wide = float(np.sqrt(2 * fit.covariance[4, 4]))
        evidence.append(fit.evidence + float(np.log(0.5 * (erf(ahead / wide) + erf(behind / wide)))))
    return [replace(distinct[0], evidence=float(np.logaddexp.reduce(evidence)))]


def _apart(kind: str, theta: Array, other: Array) -> float:
    """The largest difference of two parameters."""
    off = np.abs(theta - other)
    if kind in PERIOD:
        off[4] = abs(turn_between(kind, theta, other))
    return float(off.max())


class _Whitened:
    """One frame, whitened."""

    def __init__(self, response: TouchResponse, d: Array, errors: FrameErrors, scales: Sequence[float]) -> None:
        try:
            self._root: Array = cholesky(errors.noise + errors.model, lower=True)
            self._roots = [cholesky(errors.noise + s**2 * errors.model, lower=True) for s in scales if s != 1]
        except LinAlgError as why:
            raise ValueError(f"a covariance that is none ({why})") from why
        self._response, self._seen, self._model = response, self._white(d), errors.model
        self._volume = float(np.log(self._root.diagonal()).sum())
        self._noise = float((self._white(self._white(errors.noise).T).diagonal()).sum())  # energy it leaves
        self._grid: TouchGrid | None = None

    def _white(self, values: Array) -> Array:
        return np.asarray(solve_triangular(self._root, values, lower=True, check_finite=False))

    def _cells(self, shape: Shape) -> TouchGrid:
        if self._grid is None or not self._grid.holds(shape) or self._grid.side * self._grid.cells > 3.4 * shape.radius:
            self._grid = self._response.grid(shape.x, shape.y, 1.15 * shape.radius)
        return self._grid

    def misfit(self, kind: str, theta: Array) -> float:
        shape = shape_of(kind, theta)
        grid = self._cells(shape)
        left = self._seen - self._white(self._response(grid, effective_drop(grid.coverage(shape), shape.drop, kind))[0])
        return float(left @ left)

    def _linear(self, kind: str, theta: Array) -> tuple[Array, Array]:
        """(K,) what is left of the frame, and (K, n) the derivative of the response, whitened."""
        shape = shape_of(kind, theta)
        grid, drop = self._cells(shape), shape.drop
        share = grid.coverage(shape)
        now = effective_drop(share, drop, kind)
        slope = np.zeros((len(share), len(theta)))
        slope[:, 3] = (effective_drop(share, drop + 1e-4, kind) - now) * 1e4 * drop * (1 - drop)
        for k in (0, 1, 2, *range(4, len(theta))):
            step = np.zeros(len(theta))
            step[k] = STEP[k] * (shape.radius if k < 2 else 1.0)
            ahead, behind = (
                effective_drop(grid.coverage(shape_of(kind, theta + sign * step)), drop, kind) for sign in (1, -1)
            )
            slope[:, k] = (ahead - behind) / (2 * step[k])
        moved = np.flatnonzero(np.abs(slope).max(axis=1))
        d, by_cell = self._response(grid, now, moved)
        return self._seen - self._white(d), self._white(by_cell @ slope[moved])

    def fit(
        self, kind: str, theta: Array, radius: float | None, best: float, known: Sequence[Array] = ()
    ) -> KindFit | None:
        """The likeliest touch of a kind near theta; None where it is so far behind the evidence `best` that it need
        not be known, or where it comes to one of the optima that are `known`.
        """
        prior = _Prior.of(kind, theta, radius)
        climbed = self._climbed(kind, theta, prior, best, known)
        if climbed is None:
            return None
        theta, left, slope = climbed
        as_assumed, over_scales = self._evidence(theta, left, slope, prior)
        misfit = float(left @ left)
        covariance, gain = self._covariance(kind, theta, slope, prior, misfit, radius is not None)
        steep, flat = self._root @ slope, np.zeros((len(slope), 3))
        return KindFit(kind, theta, covariance, misfit, over_scales, as_assumed, steep, flat, gain, self._noise)

    def _climbed(
        self, kind: str, theta: Array, prior: _Prior, best: float, known: Sequence[Array]
    ) -> tuple[Array, Array, Array] | None:
        """The likeliest theta, with what is left of the frame there and the derivative; None as `fit` says."""
        count = len(theta)
        left, slope = self._linear(kind, theta)
        cost, damping = float(left @ left) + prior.penalty(theta), 1e-3
        for step_number in range(STEPS):
            hessian, uphill = prior.hessian(slope), prior.uphill(slope, left, theta)
            promised = float(uphill @ np.linalg.solve(hessian, uphill))  # by a whole step, if the response were linear
            if promised < DONE:
                break
            if step_number >= 3 and -0.5 * (cost - promised) - self._volume < best - 4 * UNLIKELY:
                return None
            if any(_apart(kind, theta, other) < NEAR for other in known):
                return None
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), uphill)
            step *= min(1.0, float((MOST[:count] / np.maximum(np.abs(step), 1e-9)).min()))
            there = np.clip(theta + step, LOW[:count], HIGH[:count])
            if self.misfit(kind, there) + prior.penalty(there) < cost:
                theta, damping = there, damping * 0.3
                left, slope = self._linear(kind, theta)
                cost = float(left @ left) + prior.penalty(theta)
            elif damping > 1e2 or promised < NO_MORE:
                break
            else:
                damping *= 8
        return theta, left, slope

    def _evidence(self, theta: Array, left: Array, slope: Array, prior: _Prior) -> tuple[float, float]:
        """Log evidence by Laplace's method: with the response's error as assumed, and over the sizes it may have."""
        cost = float(left @ left) + prior.penalty(theta)
        as_assumed = -0.5 * cost - 0.5 * prior.logdet(prior.hessian(slope)) - prior.occam - self._volume
        each = [as_assumed]
        for root in self._roots:
            again, steep = (solve_triangular(root, self._root @ values, lower=True) for values in (left, slope))
            hessian, uphill = prior.hessian(steep), prior.uphill(steep, again, theta)
            least = float(again @ again) + prior.penalty(theta) - float(uphill @ np.linalg.solve(hessian, uphill))
            volume = float(np.log(root.diagonal()).sum())
            each.append(-0.5 * least - 0.5 * prior.logdet(hessian) - prior.occam - volume)
        return as_assumed, float(np.logaddexp.reduce(each)) - float(np.log(len(each)))

    def _covariance(
        self, kind: str, theta: Array, slope: Array, prior: _Prior, misfit: float, size_known: bool
    ) -> tuple[Array, Array]:
        """(n, n) of theta, made wider by what the response is wrong by, as the misfit tells, and where the skin's
        outline is near; and (n, K) the gain of theta to the frame.
        """
        covariance = np.linalg.inv(prior.hessian(slope))
        gain = covariance @ solve_triangular(self._root.T, slope, lower=False, check_finite=False).T
        aside, shape = gain @ self._model @ gain.T, shape_of(kind, theta)
        wider = widening(shape, self._response.room(shape), len(theta), size_known)
        covariance += seen_error(misfit, self._noise) * wider.factor * aside * wider.factor[:, None] - aside
        covariance += np.outer(wider.edge, wider.edge)
        return np.asarray(covariance), np.asarray(gain)


@dataclass(frozen=True)
class _Prior:
    """Of a kind's theta: normal, with a mean and an information (n,) that is huge where a value is held."""

    mean: Array
    information: Array
    held: NDArray[np.bool_]
    occam: float  # log of the free ones' standard deviations, summed

    @staticmethod
    def of(kind: str, theta: Array, radius: float | None) -> _Prior:
        """radius: a known size stays as it is."""
        count = len(theta)
        mean, sd = MEAN[:count].copy(), SD[:count].copy()
        if count > 4:  # any rotation of the kind's period is as likely
            mean[4], sd[4] = theta[4], PERIOD[kind] / np.sqrt(2 * np.pi)
        held = np.arange(count) == 2 if radius else np.zeros(count, dtype=bool)
        information = np.where(held, 1e12, 1 / sd**2)
        information[4:5] = 0.0
        if radius:
            mean[2] = np.log(radius)
        return _Prior(mean, information, held, float(np.log(sd[~held]).sum()))

    def penalty(self, theta: Array) -> float:
        return float((self.information * (theta - self.mean) ** 2).sum())

    def hessian(self, slope: Array) -> Array:
        return np.asarray(slope.T @ slope + np.diag(self.information))

    def uphill(self, slope: Array, left: Array, theta: Array) -> Array:
        return np.asarray(slope.T @ left - self.information * (theta - self.mean))

    def logdet(self, hessian: Array) -> float:
        """Of what is free."""
        return float(np.linalg.slogdet(hessian[np.ix_(~self.held, ~self.held)])[1])
