"""One touch fitted to one frame: place, size, drop and kind, each with its posterior uncertainty (numpy and scipy).

A touch has parameters theta = (x, y, log radius, logit drop, rotation, log aspect), as many as its kind needs.
The frame is d = f(theta) + e, with f of `touch_response` and e normal of a covariance that the caller knows: noise,
drift, and what no model gets right. Gauss-Newton steps, damped (Levenberg-Marquardt) and kept only where they raise the
posterior, lead from the network's answer to the likeliest theta. There the posterior is taken as normal (Laplace),
which gives each kind's evidence, and so what shape it is (MacKay, "Information Theory, Inference, and Learning
Algorithms", chapters 27 and 28).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.special import erf

from models.shapes import CLASSES, KINDS, Array, Shape
from models.touch_response import TouchGrid, TouchResponse, effective_drop

FREE = {"circle": 4, "hertz": 4, "triangle": 5, "rectangle": 6, "square": 5, "L": 5}  # parameters of each kind
PERIOD = {"triangle": 2 * np.pi / 3, "rectangle": np.pi, "square": np.pi / 2, "L": 2 * np.pi}
STARTS = {"triangle": 4, "rectangle": 6, "square": 4, "L": 8}  # rotations looked at in one period
TRIED = {"triangle": 2, "rectangle": 3, "square": 2, "L": 4}  # of them, evenly apart, are fitted to the end
ROUNDER = {"circle": 1.0, "hertz": 1.1, "triangle": 1.55, "rectangle": 1.3, "square": 1.25, "L": 1.4}
"""Circumscribed radius of each kind over that of the circle of its area."""

# Prior of theta, normal: the ranges of models.scenes.TRAINING, wider. Rotation: any of the kind's period.
MEAN = np.array([0.0, 0.0, np.log(0.27), -0.9, 0.0, np.log(1.9)])
SD = np.array([0.6, 0.6, 0.45, 0.9, 1.0, 0.25])
LOW = np.array([-1.0, -1.0, np.log(0.05), -5.0, -np.inf, 0.0])
HIGH = np.array([1.0, 1.0, np.log(0.95), 3.5, np.inf, np.log(4.0)])
MOST = np.array([0.2, 0.2, 0.4, 0.8, 0.5, 0.4])  # of one step
STEP = np.array([0.02, 0.02, 0.03, 0.0, 0.05, 0.04])  # for derivatives of coverage; place: of the radius
DONE = 0.05  # where a step promises less, in nats times two, it is not taken
STEPS = 12
FLOOR = 5e-6  # of |Z|: two meshes differ by as much where a touch does least
MISFIT = 3.5e-3  # of |d|: what the response is wrong by, over the directions that touches make
MISFIT_ODDS = 0.55  # and it grows with the drop's odds: a drop of a half has all of it, one of a tenth a third
MISFIT_EACH = 0.2  # of that: in each measurement by itself
CORNERED = {"circle": 1.0, "hertz": 1.0, "square": 1.3, "L": 1.7, "triangle": 2.8, "rectangle": 2.8}
"""What the response of each kind is wrong by, over a circle's: the cells do not resolve the field at corners."""
WIDER = {"circle": 1.15, "hertz": 1.15, "square": 1.2, "L": 1.25, "triangle": 1.45, "rectangle": 1.5}
WIDER_INTEGRAL = 1.15
"""Standard deviations (of drop and area for each kind) over those of the normal posterior: drop and size of a small
touch trade off along a bent valley. Found on 300 touches; bench/accuracy/refined.py checks them on others.
"""
PLACE_SURER, BY_THE_EDGE, SIZE_LESS_SURE = 0.48, 0.08, 1.35
"""Standard deviations of a place, and of drop and size, by the response's error over what that error is taken for; and
how far from the skin's outline a place's begins: by the edge the tables are coarse. Found on 150 touches; checked on
others as above.
"""
LEFT = 0.8  # whitened energy that such an error leaves of a frame without noise, typically
MOST_LEFT = 25.0  # that such an error leaves at most, where the touch is one of these kinds
SURE_OF_IT = 0.15  # of LEFT: how much the assumed size of the error counts beside the one that is seen
MISFIT_POWER = 0.4  # of the Gram matrix's eigenvalues: that error looks almost as touches do
MOST_FOLLOWED = np.array([0.3, 0.3, 0.25, 0.6, 0.2, 0.3])  # of one step along a change; place: of the radius
UNFOLLOWED = 0.01  # of a change's energy: what one step may leave of it
CURVED = 0.15  # of one step: standard deviation of what it is off by
UNLIKELY = 12.0  # nats behind the likeliest kind: not fitted further
NO_MORE = 1.0  # where a step promised less and kept nothing, the cells' own error is what is left
NEAR = 0.04  # in every parameter: the same optimum
SAME_TURN = 0.08  # of a kind's period: rotations no further apart are of one optimum


@dataclass(frozen=True)
class KindFit:
    """The likeliest touch of one kind. covariance: of theta; misfit: whitened energy it leaves, about K where it fits;
    evidence: log, nats. slope (K, n): of the response to theta; gain (n, K): of theta to the frame.
    """

    kind: str
    theta: Array
    covariance: Array
    misfit: float
    evidence: float
    slope: Array
    gain: Array
    noise: float  # energy that noise leaves of a frame, on the mean

    @property
    def fits_frame(self) -> bool:
        """Whether this touch explains the frame."""
        return bool(self.misfit < self.noise + 4 * (2 * self.noise) ** 0.5 + MOST_LEFT)

    @property
    def shape(self) -> Shape:
        return shape_of(self.kind, self.theta)

    def drawn(self, rng: np.random.Generator, n: int) -> list[Shape]:
        """Shapes from the posterior."""
        theta = rng.multivariate_normal(self.theta, self.covariance, n, method="cholesky")
        count = len(self.theta)
        return [shape_of(self.kind, row) for row in np.clip(theta, LOW[:count], HIGH[:count])]


@dataclass(frozen=True)
class TouchPosterior:
    """What a frame says of one touch. Standard deviations are of the posterior over all kinds that were fitted."""

    fits: tuple[KindFit, ...]  # likeliest first
    probability: dict[str, float]  # of each of shapes.KINDS that was fitted
    position: Array  # (2,) centroid, model units
    position_covariance: Array  # (2, 2)
    drop: tuple[float, float]  # peak, S: mean and standard deviation
    integral: tuple[float, float]  # S times square model units
    area: tuple[float, float]  # square model units
    between_kinds: tuple[float, float]  # how far the kinds differ in drop and in area: relative standard deviations
    measurements: int

    @property
    def fits_frame(self) -> bool:
        """Whether the likeliest touch explains the frame: else it is none of these kinds, or more than one."""
        return self.fits[0].fits_frame

    def followed(self, change: Array, sigma: Array) -> TouchPosterior | None:
        """The same touch after the frame has changed by `change` (K,), whose standard deviation is sigma (K,): one
        Gauss-Newton step from where it was; None where the change is too large for one step, or is not of this touch.
        """
        moved = []
        for fit in self.fits:
            step = fit.gain @ change
            most = MOST_FOLLOWED[: len(step)] * np.where(np.arange(len(step)) < 2, fit.shape.radius, 1.0)
            if (np.abs(step) > most).any():
                continue
            left = change - fit.slope @ step
            energy, usual = float(((left / sigma) ** 2).sum()), len(change) + 4 * (2 * len(change)) ** 0.5
            if energy > usual + UNFOLLOWED * float(((change / sigma) ** 2).sum()):
                continue
            doubt = np.diag((CURVED * step) ** 2)  # one step is not the whole way
            theta = np.clip(fit.theta + step, LOW[: len(step)], HIGH[: len(step)])
            moved.append(replace(fit, theta=theta, covariance=fit.covariance + doubt))
        if not moved or moved[0].kind != self.fits[0].kind:
            return None
        share = np.array([self.probability[fit.kind] for fit in moved])
        return _posterior(tuple(moved), share / share.sum(), self.measurements)

    @property
    def classes(self) -> Array:
        """(5,) probability of each of shapes.CLASSES; a Hertz contact is a circle."""
        found = np.zeros(len(CLASSES))
        for kind, share in self.probability.items():
            found[0 if kind == "hertz" else CLASSES.index(kind)] += share
        return found

    def image(self, n: int, draws: int = 24, seed: int = 0) -> Array:
        """(n, n) posterior mean of the drop: each kind by its probability, drawn from its posterior."""
        rng, image = np.random.default_rng(seed), np.zeros((n, n))
        shares = [(fit, self.probability[fit.kind]) for fit in self.fits if self.probability[fit.kind] > 0.5 / draws]
        whole = sum(share for _, share in shares)
        for fit, share in shares:
            shapes = fit.drawn(rng, max(2, round(draws * share)))
            for shape in shapes:
                image += share / whole / len(shapes) * shape.drop * shape.fraction(n)
        return image


class FrameErrors(NamedTuple):
    """Covariances (K, K) of a frame about what its touch makes of it: noise and drift; and what the model is wrong by,
    whose size is a guess that the fit itself corrects.
    """

    noise: Array
    model: Array


class TouchFit:
    """Fits of single touches on one skin."""

    def __init__(self, response: TouchResponse) -> None:
        self.response = response

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
            frame = _Whitened(self.response, d, FrameErrors(errors.noise, CORNERED[kind] ** 2 * errors.model))
            best = max((fit.evidence for fit in found), default=-np.inf)
            starts = [before[kind]] if before else self._starts(frame, kind, start, radius)
            optima: list[KindFit] = []
            for theta in starts:
                fit = frame.fit(kind, theta, radius, best, [other.theta for other in optima])
                optima += [fit] if fit else []
            found += over_rotations(optima)
        found.sort(key=lambda fit: -fit.evidence)
        weight = np.exp([fit.evidence - found[0].evidence for fit in found])
        return _posterior(tuple(found), weight / weight.sum(), len(d))

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
        if all(abs(_turn(fit.kind, fit.theta, other.theta)) > SAME_TURN * period for other in distinct):
            distinct.append(fit)
    for fit in distinct:
        turns = [_turn(fit.kind, fit.theta, other.theta) for other in distinct if other is not fit]
        ahead = min((turn % period for turn in turns), default=period) / 2
        behind = min((-turn % period for turn in turns), default=period) / 2
        wide = float(np.sqrt(2 * fit.covariance[4, 4]))
        evidence.append(fit.evidence + float(np.log(0.5 * (erf(ahead / wide) + erf(behind / wide)))))
    return [replace(distinct[0], evidence=float(np.logaddexp.reduce(evidence)))]


def _apart(kind: str, theta: Array, other: Array) -> float:
    """The largest difference of two parameters."""
    off = np.abs(theta - other)
    if kind in PERIOD:
        off[4] = abs(_turn(kind, theta, other))
    return float(off.max())


def _turn(kind: str, theta: Array, other: Array) -> float:
    """The rotation from one touch of a kind to another: within half a period of none."""
    period = PERIOD[kind]
    return float((other[4] - theta[4] + period / 2) % period - period / 2)


def frame_errors(
    gram: Array, sigma: Array, d: Array, peak: float, tare_frames: float = 64.0, drift: Array | None = None
) -> FrameErrors:
    """Of d (K,) about what a touch of about the drop `peak` makes of it.

    gram (K, K): the bundle's; sigma (K,): standard deviation of d of one frame; drift (K, K): covariance of what drift
    since the tare does.
    """
    peak = min(max(peak, 0.05), 0.9)
    wrong = MISFIT * (peak / (1 - peak)) ** MISFIT_ODDS
    noise = np.diag(sigma**2 * (1 + 1 / tare_frames) + FLOOR**2)
    factor = wrong * float(np.linalg.norm(d)) * misfit_factor(gram)
    model = factor @ factor.T + np.diag((MISFIT_EACH * wrong * d) ** 2)
    return FrameErrors(noise if drift is None else noise + drift, model)


def misfit_factor(gram: Array, power: float = MISFIT_POWER) -> Array:
    """(K, K) factor of a covariance of trace 1 that lies where touches do: powers of the Gram matrix's eigenvalues."""
    values, vectors = np.linalg.eigh(gram)
    profile = np.maximum(values, 0) ** power
    return np.asarray(vectors * (profile / np.linalg.norm(profile)))


class _Whitened:
    """One frame, whitened."""

    def __init__(self, response: TouchResponse, d: Array, errors: FrameErrors) -> None:
        try:
            self._root: Array = cholesky(errors.noise + errors.model, lower=True)
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
        count = len(theta)
        mean, sd = MEAN[:count].copy(), SD[:count].copy()
        if count > 4:  # any rotation of the kind's period is as likely
            mean[4], sd[4] = theta[4], PERIOD[kind] / np.sqrt(2 * np.pi)
        held = np.arange(count) == 2 if radius else np.zeros(count, dtype=bool)  # a known size stays as it is
        information = np.where(held, 1e12, 1 / sd**2)
        information[4:5] = 0.0
        if radius:
            mean[2] = np.log(radius)
        occam = float(np.log(sd[~held]).sum())
        left, slope = self._linear(kind, theta)

        def penalty(theta: Array) -> float:
            return float((information * (theta - mean) ** 2).sum())

        cost, damping = float(left @ left) + penalty(theta), 1e-3
        for step_number in range(STEPS):
            hessian, uphill = slope.T @ slope + np.diag(information), slope.T @ left - information * (theta - mean)
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
            if self.misfit(kind, there) + penalty(there) < cost:
                theta, damping = there, damping * 0.3
                left, slope = self._linear(kind, theta)
                cost = float(left @ left) + penalty(theta)
            elif damping > 1e2 or promised < NO_MORE:
                break
            else:
                damping *= 8
        hessian = slope.T @ slope + np.diag(information)
        free = hessian[np.ix_(~held, ~held)]
        evidence = -0.5 * cost - 0.5 * float(np.linalg.slogdet(free)[1]) - occam - self._volume
        covariance, misfit = np.linalg.inv(hessian), float(left @ left)
        follow = covariance @ solve_triangular(self._root.T, slope, lower=False, check_finite=False).T
        aside = follow @ self._model @ follow.T
        surer = np.ones(count)
        near = np.exp(-self._response.room(shape_of(kind, theta)) / BY_THE_EDGE)
        surer[:2], surer[2:4] = PLACE_SURER + (1 - PLACE_SURER) * near, SIZE_LESS_SURE
        covariance += self._wrong(misfit) * surer * aside * surer[:, None] - aside
        return KindFit(kind, theta, covariance, misfit, evidence, self._root @ slope, follow, self._noise)

    def _wrong(self, misfit: float) -> float:
        """Variance of the model's error over what was assumed: as large as what is left of the frame, as far as noise
        lets that be seen.
        """
        assumed = SURE_OF_IT + 3 * (2 * self._noise) ** 0.5 / LEFT
        return float((assumed + max(0.0, misfit - self._noise) / LEFT) / (assumed + 1))


def shape_of(kind: str, theta: Array) -> Shape:
    turn = float(theta[4]) if len(theta) > 4 else 0.0
    aspect = float(np.exp(theta[5])) if len(theta) > 5 else 1.0
    drop = float(1 / (1 + np.exp(-theta[3])))
    return Shape(kind, float(theta[0]), float(theta[1]), float(np.exp(theta[2])), drop, turn, aspect)


def _posterior(fits: tuple[KindFit, ...], probability: Array, measurements: int) -> TouchPosterior:
    """Moments over kinds: within each by its Gaussian, made wider; between them by their difference."""
    rows = []
    for fit in fits:
        shape = fit.shape
        c = fit.covariance
        relative = (1 - shape.drop) ** 2 * c[3, 3]  # of the drop
        area = 4 * c[2, 2]
        both = relative + area + 4 * (1 - shape.drop) * c[2, 3]
        rows.append((shape.centroid, c[:2, :2], (shape.drop, relative), (shape.integral, both), (shape.area, area)))
    position = np.sum([p * row[0] for p, row in zip(probability, rows, strict=True)], axis=0)
    spread = np.sum(
        [
            p * (row[1] + np.outer(row[0] - position, row[0] - position))
            for p, row in zip(probability, rows, strict=True)
        ],
        axis=0,
    )

    def mixed(k: int) -> tuple[float, float]:
        values = np.array([row[k][0] for row in rows])
        variances = values**2 * np.array([row[k][1] for row in rows])
        mean = float(probability @ values)
        wider = np.array([WIDER_INTEGRAL if k == 3 else WIDER[fit.kind] for fit in fits])
        return mean, float(np.sqrt(probability @ (wider**2 * variances + (values - mean) ** 2)))

    def apart(k: int) -> float:
        values = np.array([row[k][0] for row in rows])
        mean = float(probability @ values)
        return float(np.sqrt(probability @ (values - mean) ** 2)) / mean

    kinds: NDArray[np.str_] = np.array([fit.kind for fit in fits])
    return TouchPosterior(
        fits,
        {str(kind): float(p) for kind, p in zip(kinds, probability, strict=True)},
        np.asarray(position),
        np.asarray(spread),
        mixed(2),
        mixed(3),
        mixed(4),
        (apart(2), apart(4)),
        measurements,
    )
