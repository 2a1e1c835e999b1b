"""Touches as circles on the bundle's linear model: what a scan in parts measures of them, and which of them explain a
whole scan best.

A touch is x, y [model units], log radius, log drop, and the velocity of its place [model units/s]. What the linear
model is wrong by is part of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.part_image import (
    AHEAD,
    HIGH,
    LEAST,
    LOW,
    SD,
    STENCIL,
    WIDER,
    PartImage,
    PartTouch,
    ellipse,
    spread_of,
    variance_of,
)

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

RADIUS, DROP = 2, 3  # of a touch: x, y, log radius, log drop, vx, vy
MODEL = 4  # of them, that d depends on
STEP = np.array([0.05, 0.05, 0.5, 1.0])  # that one step of a fit does not much exceed
FITS = 2.0  # chi-square per value of a whole scan, beyond which its touches are no circles
ELSEWHERE = 0.4  # model units from a touch: another one is told from its change
MOST = 4  # touches that are told apart
TINY = 1e-9  # keeps solvable what no value tells


class Fit(NamedTuple):
    """Touches (N, 6) that hold still, the covariance (4 N, 4 N) of what d depends on, chi-square per value left."""

    touches: Array
    covariance: Array
    misfit: float


class Circles:
    """For one bundle."""

    def __init__(self, bundle: Bundle) -> None:
        self._image = PartImage(bundle)
        self._half = bundle.half_width
        self.all: Rows = np.arange(len(bundle.pattern))
        self.metres_per_unit = self._image.metres_per_unit

    def expected(self, touches: Array, rows: Rows, tau: Array) -> tuple[Array, Array]:
        """(n,) d of these measurements, each tau (n,) s after the state, and (n, 6 N) its derivative."""
        drop = np.exp(touches[:, DROP])
        each = np.empty((len(touches), len(STENCIL), len(rows)))
        for k, touch in enumerate(touches):
            each[k] = self._image.responses(touch[:DROP] + STENCIL, rows) * drop[k]
        slope = np.empty((len(rows), len(touches), 6))
        slope[:, :, :DROP] = ((each[:, 1::2] - each[:, 2::2]) / (2 * AHEAD[:, None])).transpose(2, 0, 1)
        slope[:, :, DROP] = each[:, 0].T
        slope[:, :, MODEL:] = slope[:, :, :2] * tau[:, None, None]
        expected = each[:, 0].sum(axis=0) + (slope[:, :, MODEL:] * touches[:, MODEL:]).sum(axis=(1, 2))
        return expected, slope.reshape(len(rows), -1)

    def another(self, off: Array, width: Array, rows: Rows, touches: Array) -> float:
        """How much of |off / width|^2, of these measurements (n,), a touch explains that begins elsewhere."""
        grid = self._image.grid
        away = np.hypot(*(grid.position[:, None] - touches[None, :, :RADIUS]).transpose(2, 0, 1)).min(axis=1)
        whitened = grid.response[np.ix_(away > ELSEWHERE, rows)] / width
        gain = np.maximum(whitened @ (off / width), 0.0) ** 2 / ((whitened**2).sum(axis=1) + TINY)
        return float(gain.max(initial=0.0))

    def still(self, touches: Array) -> Array:
        """(K,) d of touches that do not move."""
        held = touches.copy()
        held[:, MODEL:] = 0.0
        return self.expected(held, self.all, np.zeros(len(self.all)))[0]

    def possible(self, touches: Array) -> Array:
        """The nearest touches that can be."""
        within = touches.copy()
        within[:, :RADIUS] = np.clip(within[:, :RADIUS], -self._half, self._half)
        within[:, RADIUS:MODEL] = np.clip(within[:, RADIUS:MODEL], LOW, HIGH)
        return within

    def places(self, touches: Array, covariance: Array) -> list[tuple[float, float, tuple[float, float, float]]]:
        """x, y and their uncertainty (along the longest axis, the shortest, angle of the longest), of the part of each
        touch that lies on the skin. covariance (4 N, 4 N).
        """
        found = []
        for k, touch in enumerate(touches):
            own = covariance[MODEL * k : MODEL * k + DROP, MODEL * k : MODEL * k + DROP]
            at, spread = self._image.place(touch[:DROP], own)
            found.append((float(at[0]), float(at[1]), ellipse(spread, WIDER, LEAST)))
        return found

    def fitted(self, d: Array, noise: Array, around: Array, steps: int = 2) -> Fit:
        """The touches of about these places that explain a whole scan best, if they hold still."""
        touches, tau = around.copy(), np.zeros(len(d))
        touches[:, MODEL:] = 0.0
        width = np.sqrt(variance_of(d, noise, float((d**2).mean())))
        columns = [6 * k + n for k in range(len(touches)) for n in range(MODEL)]
        damping = np.diag(np.tile(STEP**-2.0, len(touches)))
        for _ in range(steps):
            expected, slope = self.expected(touches, self.all, tau)
            slope = slope[:, columns] / width[:, None]
            step = np.linalg.solve(slope.T @ slope + damping, slope.T @ ((d - expected) / width))
            touches[:, :MODEL] += step.reshape(-1, MODEL)
            touches = self.possible(touches)
        expected, slope = self.expected(touches, self.all, tau)
        slope = slope[:, columns] / width[:, None]
        chi2 = float((((d - expected) / width) ** 2).sum())
        # Somewhere on the skin: what has slid to where no measurement sees it would have no covariance otherwise.
        prior = np.diag(np.tile([self._half**-2.0, self._half**-2.0, *SD**-2.0], len(touches)))
        covariance = spread_of(chi2, len(d) - len(columns)) * np.linalg.inv(slope.T @ slope + prior)
        return Fit(touches, np.asarray(covariance, dtype=np.float64), chi2 / len(d))

    def found(self, d: Array, noise: Array) -> Fit:
        """The touches that explain a whole scan; none where they are no circles that are apart."""
        seen = [self._image.fit(d, noise)]
        fit = self.fitted(d, noise, as_touches(seen))
        while fit.misfit > FITS and len(seen) < MOST:  # another one, where what is left of d is largest
            seen.append(self._image.fit(d - self.still(fit.touches), noise))
            fit = self.fitted(d, noise, np.concatenate([fit.touches, as_touches(seen[-1:])]), steps=8)
        if fit.misfit > FITS or not _apart(fit.touches):
            return Fit(as_touches([]), np.zeros((0, 0)), fit.misfit)
        return fit


def as_touches(seen: Sequence[PartTouch]) -> Array:
    """(N, 6) of touches that do not move."""
    return np.array([[t.x, t.y, np.log(t.radius), np.log(t.drop), 0.0, 0.0] for t in seen]).reshape(-1, 6)


def _apart(touches: Array) -> bool:
    """Whether no touch lies within another: two that grow into each other are not told apart."""
    away = np.hypot(*(touches[:, None, :RADIUS] - touches[None, :, :RADIUS]).transpose(2, 0, 1))
    reach = np.exp(touches[:, RADIUS])
    return bool((away + 1e9 * np.eye(len(touches)) > np.maximum(reach[:, None], reach)).all())
