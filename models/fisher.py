"""How well a touch can be known: its Fisher information under a noise model, drift and a prior.

A touch is a circle (x, y, radius, drop), estimated as theta = (x, y, log radius, log drop): errors of size and drop are
then relative, and their trade-off (what is measured well is drop times area) is a straight line. The measurement is
d = |Z|/|Z0| - 1 with independent noise sigma_k^2 = (relative |Z_k|)^2 + floor^2 in Z, and again in the tare's mean.

Two floors of each error (standard deviations; Van Trees, "Detection, Estimation, and Modulation Theory", I, 2.4):

- Cramer-Rao: F^-1 alone, for unbiased estimators. Drift (a global scale and every contact impedance) is estimated along
  with the touch: parameters with their own prior width.
- Bayesian: (F + P)^-1 with P the prior's information. Uniform priors are taken as normal ones of equal variance, and F
  is that of the touch in question, not its mean over the prior: a floor for touches like this one. Floors of many
  touches are averaged (root mean square) and held against the root mean square of an estimator's errors.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import patterns
from models.elements import Array
from models.forward import ForwardModel, shared
from models.prereconstruction import Drift
from models.pressure import FOAM
from models.shapes import Shape

STEPS = (0.03, 0.03, 0.06, 0.06)  # of theta, for central differences: half or twice changes a floor by a few percent
MESH = "inverse"  # floors from it are within a few percent of those from the training mesh, at a third of the time
SIDE = 2.0  # model units; percentages of position refer to it


@dataclass(frozen=True)
class MeasurementNoise:
    """Noise of an impedance: sigma^2 = (10^(-snr_db/20) |Z|)^2 + floor_ohm^2; tare_frames: averaged for the
    baseline.
    """

    snr_db: float = 70.0
    floor_ohm: float = 0.0
    tare_frames: float = 64  # a mean of several frames against 64 is as one frame against fewer

    def sigma(self, z: Array) -> Array:
        """(K,) standard deviation [ohm] of a difference between one frame and the tare."""
        relative = 0.0 if np.isinf(self.snr_db) else 10 ** (-self.snr_db / 20)
        return np.asarray(np.sqrt(((relative * z) ** 2 + self.floor_ohm**2) * (1 + 1 / self.tare_frames)))


@dataclass(frozen=True)
class SizePrior:
    """What is known before measuring: uniform position (model units), radius and drop [S/m] uniform in their logarithm.

    A range of no width is a known value, a known indenter's radius for one: the Cramer-Rao floor takes it as known too.
    """

    position: tuple[float, float] = (-1.0, 1.0)
    radius: tuple[float, float] = (0.15, 0.45)
    drop: tuple[float, float] = (0.1, 0.5)

    def information(self, known_only: bool = False) -> Array:
        """(4, 4) of theta: 12 / width^2 on the diagonal; known_only: 0 where the width is not."""
        across = float(np.ptp(self.position))
        widths = np.array(
            [across, across, np.log(self.radius[1] / self.radius[0]), np.log(self.drop[1] / self.drop[0])]
        )
        return np.diag(np.where(known_only & (widths > 0), 0.0, 12 / np.maximum(widths, 1e-5) ** 2))


@dataclass(frozen=True)
class Sensitivity:
    """A touch's impedances as transfer matrices, so that any pattern can be read.

    touched, untouched (n, n); slope (4, n, n), of theta; contact (n, n, n), of each log contact impedance (first axis).
    """

    touched: Array
    slope: Array
    untouched: Array
    contact: Array

    def relative(self, pattern: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Z0 (K,), dd/dtheta (K, 4) and dd/d(scale, log contact 1..n) (K, 1 + n) of d = |Z|/|Z0| - 1."""
        z0, z = _read(self.untouched, pattern), _read(self.touched, pattern)
        return z0, (_read(self.slope, pattern) / z0).T, np.column_stack([z / z0, (_read(self.contact, pattern) / z0).T])


@dataclass(frozen=True)
class Floor:
    """Standard deviations an estimator cannot beat. position [model units, x and y together], the others relative."""

    position: float
    radius: float
    drop: float
    integral: float
    force: float = 0.0  # of the foam's pressure summed over the patch (models/pressure.py)

    @property
    def position_percent(self) -> float:
        """Position in per cent of the square's side."""
        return 100 * self.position / SIDE


def sensitivity(skin: str, touch: Shape, mesh: str = MESH) -> Sensitivity:
    """Eight solves of the forward model for a circle or Hertz touch; another shape counts as the circle of its area.

    Kept for the last few thousand touches. Raises ValueError where the touch's centre is off the skin.
    """
    radius = float(np.sqrt(touch.area / np.pi))
    x, y = (float(v) for v in touch.centroid)
    return _sensitivity(skin, mesh, "hertz" if touch.kind == "hertz" else "circle", x, y, radius, float(touch.drop))


@lru_cache(maxsize=4096)
def _sensitivity(skin: str, mesh: str, kind: str, x: float, y: float, radius: float, drop: float) -> Sensitivity:
    model = shared(skin, mesh)
    if not model.skin.inside([x, y]):
        raise ValueError(f"a touch at ({x:.3g}, {y:.3g}) is not on skin '{skin}'")
    theta = np.array([x, y, np.log(radius), np.log(drop)])

    def transfer(at: Array) -> Array:
        shape = Shape(kind, at[0], at[1], float(np.exp(at[2])), min(float(np.exp(at[3])), 0.99))
        return model.solve(model.touched([shape])).transfer

    steps = np.diag(STEPS)
    pairs = [(transfer(theta + step), transfer(theta - step)) for step in steps]
    slope = np.array([(a - b) / (2 * h) for (a, b), h in zip(pairs, STEPS, strict=True)])
    touched = np.mean([(a + b) / 2 for a, b in pairs], axis=0)
    untouched, contact = _untouched(skin, mesh)
    return Sensitivity(touched, slope, untouched, contact)


@lru_cache(maxsize=8)
def _untouched(skin: str, mesh: str) -> tuple[Array, Array]:
    """Transfer matrix, and its derivative to each log contact impedance (n, n, n): from pairs, which fix it wholly."""
    model: ForwardModel = shared(skin, mesh)
    n = model.skin.n_electrodes
    solution = model.solve()
    i, j = np.meshgrid(range(n), range(n), indexing="ij")
    last = np.full(n * n, n - 1)
    keep = (i.ravel() != n - 1) & (j.ravel() != n - 1)
    rows = np.column_stack([j.ravel(), last, i.ravel(), last])[keep]
    slope = np.zeros((n, n, n))
    slope[:, i.ravel()[keep], j.ravel()[keep]] = (solution.jacobian_contact(rows) * model.contact_impedance).T
    return solution.transfer, slope


def floors(
    skin: str,
    touch: Shape,
    noise: MeasurementNoise | float = 70.0,
    prior: SizePrior | None = None,
    pattern: str | ArrayLike | None = None,
    drift: Drift | None = None,
    mesh: str = MESH,
) -> dict[str, Floor]:
    """{"cramer_rao": Floor, "bayes": Floor} of one touch.

    skin: a shipped skin's name or a .toml path. noise: a Noise or dB. pattern: None for the skin's own. drift: standard
    deviations since the tare, relative: none, some, or infinite (nothing known: the drift directions are lost).
    """
    noise = noise if isinstance(noise, MeasurementNoise) else MeasurementNoise(float(noise))
    drift = drift or Drift()
    seen = sensitivity(skin, touch, mesh)
    own = shared(skin, mesh).skin
    rows = own.pattern
    if pattern is not None:
        rows = patterns.pattern(pattern, own.n_electrodes) if isinstance(pattern, str) else np.asarray(pattern)
    fisher = information(seen, rows, noise, drift)
    prior = prior or SizePrior()
    return {
        "cramer_rao": _floor(fisher + prior.information(known_only=True), touch.drop),
        "bayes": _floor(fisher + prior.information(), touch.drop),
    }


def information(seen: Sensitivity, rows: NDArray[np.int64], noise: MeasurementNoise, drift: Drift) -> Array:
    """(4, 4) Fisher information of theta, the drift marginalised out."""
    z0, slope, nuisance = seen.relative(rows)
    sigma = noise.sigma(z0) / np.abs(z0)
    if not sigma.any():
        raise ValueError("without noise nothing limits a touch: give a finite SNR or a floor")
    spread = np.array([drift.scale] + [drift.contact] * (nuisance.shape[1] - 1))
    a, b = slope / sigma[:, None], (nuisance / sigma[:, None])[:, spread > 0]
    spread = spread[spread > 0]
    fisher = a.T @ a
    if b.size:
        inner = b.T @ b + np.diag(1 / spread**2)
        fisher -= a.T @ b @ np.linalg.lstsq(inner, b.T @ a, rcond=1e-12)[0]
    return np.asarray(fisher)


def mean_floor(each: Iterable[Floor]) -> Floor:
    """Root mean square over touches."""
    table = np.array([[f.position, f.radius, f.drop, f.integral, f.force] for f in each])
    return Floor(*(float(v) for v in np.sqrt((table**2).mean(axis=0))))


def _floor(fisher: Array, drop: float) -> Floor:
    covariance = np.linalg.pinv(fisher, rcond=1e-14, hermitian=True)
    area_and_drop = np.array([0, 0, 2, 1.0])
    area_and_pressure = np.array([0, 0, 2, float(FOAM.gain(drop))])
    return Floor(
        position=float(np.sqrt(covariance[0, 0] + covariance[1, 1])),
        radius=float(np.sqrt(covariance[2, 2])),
        drop=float(np.sqrt(covariance[3, 3])),
        integral=float(np.sqrt(area_and_drop @ covariance @ area_and_drop)),
        force=float(np.sqrt(area_and_pressure @ covariance @ area_and_pressure)),
    )


def _read(transfer: Array, pattern: NDArray[np.int64]) -> Array:
    """(..., K) impedances of transfer matrices (..., n, n)."""
    drive_plus, drive_minus, plus, minus = pattern.T
    t = transfer
    return np.asarray(
        t[..., plus, drive_plus] - t[..., plus, drive_minus] - t[..., minus, drive_plus] + t[..., minus, drive_minus]
    )
