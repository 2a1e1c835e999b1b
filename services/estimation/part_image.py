"""Where one touch is, and how sure that is, from the values that the parts since its beginning have measured.

The touch is a circle of the bundle's linear model, theta = (x, y, log radius, log drop). It starts from the likeliest
of a grid and goes to the likeliest of all by Gauss-Newton steps; there its posterior is taken as normal. What the
linear model is wrong by is part of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.touch_grid import touches
from protocol.frames import BegunTouch

Array = NDArray[np.floating]
Values = tuple[NDArray[np.intp], Array, Array]  # which measurements, d, standard deviation

LINEAR = 0.05  # of d: by so much the linear response of a circle is wrong, once it is in its place; and by half of it
# of the rms of d
WIDER = 1.15  # times the posterior's standard deviation: what is stated
BELIEVED = 12  # values that the noise they were taken to have counts for
LEAST = 0.004  # model units that are stated at least
MEAN = np.log([0.2, 0.2])  # prior of log radius [model units], log drop [S/m]
SD = np.array([0.5, 0.9])
COARSE = 0.05  # of the side: a standard deviation beyond it is coarse
INFORMATION = np.diag([0.0, 0.0, *SD**-2])
STEPS = 8
DONE = 0.2  # of the penalty: a step that gains less is the last one
MOST_MISFIT = 2.5  # squares left per value, beyond which it is no circle: one between two touches leaves 3
MOST = np.array([0.1, 0.1, 0.3, 0.5])  # of one step
LOW, HIGH = np.log([0.04, 0.005]), np.log([0.9, 0.97])  # of log radius, log drop
TINY = 1e-9  # keeps solvable what nothing depends on, as of a circle off the skin
AHEAD = np.array([0.02, 0.02, 0.05])  # of the derivatives
STENCIL = np.array([np.zeros(3), *(sign * step for step in np.diag(AHEAD) for sign in (1, -1))])


@dataclass(frozen=True)
class PartTouch:
    """A circle; lengths in model units. at: the centre of its part that lies on the skin; sigma of that: along the
    longest and the shortest axis, angle of the longest [rad].
    """

    x: float
    y: float
    radius: float
    drop: float
    drop_sigma: float
    densest: float  # times the drop: the largest there is. On the skin's edge a part of the circle has all of it
    at: tuple[float, float]
    sigma: tuple[float, float, float]
    fits: bool  # whether it explains the values
    unexplained: float  # share of what was measured


class PartImage:
    """For one bundle."""

    def __init__(self, bundle: Bundle) -> None:
        m = bundle.matrices
        self._inside = np.asarray(m.inside, dtype=np.float64)
        h, w = m.inside.shape
        jacobian = np.asarray(m.jacobian, dtype=np.float64)  # (K, P)
        self._by_pixel = np.ascontiguousarray(jacobian.T).reshape(h, w, -1)  # (H, W, K)
        self.half_width, self.measurements = bundle.half_width, len(bundle.pattern)
        self.grid = touches(m, self.half_width)
        self._of_grid = np.asarray(self.grid.response, dtype=np.float64)  # (M, K)
        self._of_grid_squared = self._of_grid**2
        self._pixel = 2 * self.half_width / w
        self._x, self._y = ((np.arange(n) + 0.5) * self._pixel - self.half_width for n in (w, h))
        self.metres_per_unit = bundle.metres_per_pixel * bundle.image_size / (2 * self.half_width)

    def fit(self, d: Array, sigma: Array, start: Array | None = None) -> PartTouch:
        """d (K,) with standard deviation sigma (K,), infinite where nothing was measured since the touch began. start:
        theta, where the likeliest of the grid is not to be looked for.
        """
        values = self._values(d, sigma)
        rows, seen, noise = values
        theta, left, slope = self._climbed(self._start(*values) if start is None else start, values, STEPS)
        covariance = np.linalg.inv(slope.T @ slope + INFORMATION + TINY * np.eye(4))
        chi2 = float(left @ left)
        misfit = max(1.0, chi2 / len(rows))
        covariance *= spread_of(chi2, len(rows) - 4)
        place, spread, densest = self._place(theta[:3], covariance[:3, :3])
        axes = ellipse(spread, WIDER, LEAST)
        x, y, radius, drop = float(theta[0]), float(theta[1]), float(np.exp(theta[2])), float(np.exp(theta[3]))
        drop_sigma = WIDER * drop * float(np.sqrt(covariance[3, 3]))
        unexplained = max(0.0, chi2 - len(rows)) / float(((seen / noise) ** 2).sum())
        at = float(place[0]), float(place[1])
        return PartTouch(x, y, radius, drop, drop_sigma, densest, at, axes, misfit < MOST_MISFIT, unexplained)

    def towards(self, d: Array, sigma: Array, start: Array, steps: int) -> NDArray[np.float64]:
        """theta after so many steps of a fit."""
        return np.asarray(self._climbed(start, self._values(d, sigma), steps)[0], dtype=np.float64)

    def _values(self, d: Array, sigma: Array) -> Values:
        rows = np.flatnonzero(np.isfinite(sigma))
        seen = d[rows].astype(float)
        return rows, seen, np.sqrt(variance_of(seen, sigma[rows].astype(float), float((seen**2).mean())))

    def _climbed(self, theta: Array, values: Values, steps: int) -> tuple[Array, Array, Array]:
        """The likeliest theta, what it leaves of the values, and the derivative of the response; whitened."""
        cost, left, slope = self._linear(theta, *values)
        damping = 1e-3
        for _ in range(steps):
            hessian = slope.T @ slope + INFORMATION
            pull = slope.T @ left - np.array([0.0, 0.0, *(SD**-2 * (theta[2:] - MEAN))])
            damped = hessian.copy()
            damped.flat[::5] *= 1 + damping
            damped.flat[::5] += TINY
            step = np.linalg.solve(damped, pull)
            step *= min(1.0, float((MOST / np.maximum(np.abs(step), 1e-9)).min()))
            there = theta + step
            there[:2] = np.clip(there[:2], -self.half_width, self.half_width)
            there[2:] = np.clip(there[2:], LOW, HIGH)
            found = self._linear(there, *values)
            if found[0] < cost:
                theta, damping, done = there, damping * 0.3, cost - found[0] < DONE
                cost, left, slope = found
                if done:
                    break
            else:
                damping *= 10
        return theta, left, slope

    def place(self, circle: Array, covariance: Array) -> tuple[Array, Array]:
        """(2,) centre of the part of a circle (x, y, log radius) that lies on the skin, and its covariance (2, 2)."""
        return self._place(circle, covariance)[:2]

    def _place(self, circle: Array, covariance: Array) -> tuple[Array, Array, float]:
        """And the largest share of a pixel."""
        shares, (rows, columns) = self._near(circle + STENCIL)
        weight = np.maximum(shares.sum(axis=(1, 2)), TINY)
        x, y = shares.sum(axis=1) @ self._x[columns], shares.sum(axis=2) @ self._y[rows]
        at = np.stack([x, y], axis=1) / weight[:, None]
        slope = (at[1::2] - at[2::2]).T / (2 * AHEAD)
        return at[0], slope @ covariance @ slope.T, float(shares[0].max())

    def begun(self, touch: PartTouch) -> BegunTouch:
        """The touch as readers are told of it."""
        metres, (long, short, angle) = self.metres_per_unit, touch.sigma
        return BegunTouch(
            position=[metres * touch.at[0], metres * touch.at[1]],
            sigma=[metres * long, metres * short, angle],
            drop=touch.densest * touch.drop,
            drop_sigma=touch.densest * touch.drop_sigma,
            integral=float(np.pi * (metres * touch.radius) ** 2 * touch.drop),
            unexplained=touch.unexplained,
        )

    def _start(self, rows: NDArray[np.intp], d: Array, noise: Array) -> Array:
        weight, pull = np.zeros(self.measurements), np.zeros(self.measurements)
        weight[rows], pull[rows] = noise**-2.0, d / noise**2
        size = np.maximum(np.sqrt(self._of_grid_squared @ weight), 1e-12)
        z = self._of_grid @ pull / size
        best = int(z.argmax())
        drop = float(np.clip(z[best] / size[best], 0.01, 0.9))
        return np.array([*self.grid.position[best], np.log(self.grid.radius[best]), np.log(drop)])

    def _linear(self, theta: Array, rows: NDArray[np.intp], d: Array, noise: Array) -> tuple[float, Array, Array]:
        """Penalty, what is left of d, and the derivative of the response; whitened."""
        responses = float(np.exp(theta[3])) * self.responses(theta[:3] + STENCIL, rows) / noise
        ahead, behind = responses[1::2], responses[2::2]
        slope = np.column_stack([*((ahead - behind) / (2 * AHEAD[:, None])), responses[0]])
        left = d / noise - responses[0]
        penalty = float(left @ left) + float((((theta[2:] - MEAN) / SD) ** 2).sum())
        return penalty, left, slope

    def _near(self, circles: Array) -> tuple[Array, tuple[slice, slice]]:
        """(M, h, w) share of each pixel under circles (M, 3) of x, y, log radius, of a circle's area in all where it
        lies on the skin; and which pixels those are: none other is under one of them.
        """
        x, y, log_r = circles.T[:, :, None]
        radius = np.exp(log_r)
        reach = max(radius.ravel().tolist()) + self._pixel
        columns, rows = self._range(x, reach), self._range(y, reach)
        across, down = self._x[columns] - x, self._y[rows] - y
        away = np.sqrt((down**2)[:, :, None] + (across**2)[:, None, :])
        share = np.clip((radius[:, :, None] - away) / self._pixel + 0.5, 0.0, 1.0)
        scale = np.pi * radius[:, :, None] ** 2 / self._pixel**2
        scale = scale / np.maximum(share.sum(axis=(1, 2), keepdims=True), 1e-9)
        return np.asarray(share * self._inside[rows, columns] * scale), (rows, columns)

    def _range(self, at: Array, reach: float) -> slice:
        """The pixels of a line, of which one or another is within reach."""
        each = at.ravel().tolist()
        low, high = ((edge + self.half_width) / self._pixel for edge in (min(each) - reach, max(each) + reach))
        return slice(max(0, int(low)), max(0, int(high) + 1))

    def responses(self, circles: Array, rows: NDArray[np.intp]) -> Array:
        """(M, n) d of these measurements per S/m of circles (M, 3) of x, y, log radius, which are near each other."""
        shares, at = self._near(circles)
        count = len(circles)
        return np.asarray(shares.reshape(count, -1) @ self._by_pixel[at].reshape(-1, self.measurements))[:, rows]


def variance_of(d: Array, noise: Array, energy: float, linear: float = LINEAR) -> NDArray[np.float64]:
    """(n,) variance of values d (n,) about a linear picture of them. noise (n,): standard deviations. energy: mean
    square of the values that felt the touch; linear: as LINEAR.
    """
    return np.asarray(noise**2 + (linear * d) ** 2 + (linear / 2) ** 2 * energy)


def spread_of(chi2: float, free: int) -> float:
    """By how much the noise of values is larger than it was taken to be, as what is left of them has it."""
    return (chi2 + BELIEVED) / (max(free, 0) + BELIEVED)


def ellipse(covariance: Array, wider: float, least: float) -> tuple[float, float, float]:
    """Longest and shortest axis, and the longest one's angle, of a place's covariance (2, 2), times `wider` and at
    least `least`.
    """
    values, vectors = np.linalg.eigh(covariance)
    short, long = np.maximum(wider * np.sqrt(np.maximum(values, 0.0)), least)
    return float(long), float(short), float(np.arctan2(vectors[1, 1], vectors[0, 1]))
