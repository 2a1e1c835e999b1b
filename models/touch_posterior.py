"""What a frame says of one touch (numpy only): the likeliest of each kind, their probabilities, the moments over them.

Within a kind the posterior is normal (Laplace); between kinds, their difference. A touch that moves takes its posterior
along by one Gauss-Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.shapes import CLASSES, Array, Shape
from models.touch_parameters import HIGH, LOW, shape_of

WIDER = {"circle": 1.05, "hertz": 1.15, "square": 1.1, "L": 1.3, "triangle": 1.4, "rectangle": 1.25}
WIDER_INTEGRAL = 1.05
"""Standard deviations (of drop and area for each kind) over those of the normal posterior: drop and size of a small
touch trade off along a bent valley. Found as those of models/response_error.py.
"""
MOST_FOLLOWED = np.array([0.3, 0.3, 0.25, 0.6, 0.2, 0.3])  # of one step along a change; place: of the radius
UNFOLLOWED = 0.01  # of a change's energy: what one step may leave of it
BENT_STEPS = 2  # after a linear one, along the response's bend
CURVED = 0.15  # of one step: standard deviation of what it is off by
UNLIKELY_NOW = 1e-4  # probability below which a kind is no longer followed
LESS_SURE, ELSEWHERE = 0.03, 0.1  # of size and drop, where a touch is elsewhere than its fit: by so much of its radius
MOST_LEFT = 25.0  # that such an error leaves at most, where the touch is one of these kinds


@dataclass(frozen=True)
class KindFit:
    """The likeliest touch of one kind. covariance: of theta; misfit: whitened energy it leaves, about K where it fits;
    evidence: log, nats, over the sizes that the response's error may have; as_assumed: where it is as large as was
    assumed. slope (K, n): of the response to theta; bend (K, 3): half its second derivatives to x x, x y and y y, zeros
    where it is not to be followed (touch_fit.bent); gain (n, K): of theta to the frame.
    """

    kind: str
    theta: Array
    covariance: Array
    misfit: float
    evidence: float
    as_assumed: float
    slope: Array
    bend: Array
    gain: Array
    noise: float  # energy that noise leaves of a frame, on the mean

    @property
    def fits_frame(self) -> bool:
        """Whether this touch explains the frame."""
        return bool(self.misfit < self.noise + 4 * (2 * self.noise) ** 0.5 + MOST_LEFT)

    @property
    def shape(self) -> Shape:
        return shape_of(self.kind, self.theta)

    def change(self, step: Array) -> Array:
        """(K,) of the response, where theta goes by a step (n,): to second order in place. To first order a touch that
        has moved looks larger and fainter, by twice the square of how many radii it went.
        """
        x, y = step[:2]
        return np.asarray(self.slope @ step + self.bend @ [x * x, x * y, y * y])

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
            for _ in range(BENT_STEPS):
                step = step + fit.gain @ (change - fit.change(step))
            most = MOST_FOLLOWED[: len(step)] * np.where(np.arange(len(step)) < 2, fit.shape.radius, 1.0)
            if (np.abs(step) > most).any():
                continue
            left = change - fit.change(step)
            energy, usual = float(((left / sigma) ** 2).sum()), len(change) + 4 * (2 * len(change)) ** 0.5
            if energy > usual + UNFOLLOWED * float(((change / sigma) ** 2).sum()):
                continue
            doubt = np.diag((CURVED * step) ** 2)  # no step is the whole way
            far = min(1.0, float(np.hypot(*step[:2])) / (ELSEWHERE * fit.shape.radius))
            doubt[2, 2] += (LESS_SURE * far) ** 2
            doubt[3, 3] += (LESS_SURE * far / (1 - fit.shape.drop)) ** 2
            theta = np.clip(fit.theta + step, LOW[: len(step)], HIGH[: len(step)])
            moved.append(replace(fit, theta=theta, covariance=fit.covariance + doubt))
        if not moved or moved[0].kind != self.fits[0].kind:
            return None
        share = np.array([self.probability[fit.kind] for fit in moved])
        return posterior_of(tuple(moved), share / share.sum())

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


def posterior_of(fits: tuple[KindFit, ...], probability: Array) -> TouchPosterior:
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
    )
