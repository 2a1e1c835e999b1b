"""What an untouched skin may have done since it was last seen untouched, and how much of that a frame shows.

The sheet dries and warms (a global factor), electrodes age (16 contact impedances). Both go on steadily rather than at
random, so their standard deviations grow as rate * time, from REST_S of it. The allowance moves in steps of a factor of
four, so that an operator serves for long.

An allowance that is too small makes drift look like touches; one that is too wide costs a touch the two thirds of its
signal that drift could have made. Where time allows several steps, the frame decides: drift may go either way, while
touches only ever lower the conductivity, so their likeliest explanation by a drop >= 0 (non-negative least squares)
tells the two apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from models.prereconstruction import Drift, PreReconstructor
from services.estimation.drift import DriftRates
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

STEP = 4.0  # ratio of neighbouring allowances
STEPS = 6  # reach 1/4, 1, 4, 16, 64, 256 s: a sheet that dried by 5 %, contacts that changed by a fifth
REST_S = 0.25
LINEARISATION = 1e-3  # of what drift does that its Jacobian does not give: 4e-4 in EIDORS' frames at +-30 %
MISFIT = 1e-2  # of |d| that the linear, coarse picture of a touch does not give
TYPICAL = 0.3  # S/m: drop of a pixel that is touched
COARSE = 2  # pixels of the reconstruction matrices to one of the non-negative fit, along each axis


class DriftPrior:
    """The law of `Drift` over time, in steps 0 ... STEPS - 1."""

    def __init__(self, rates: DriftRates) -> None:
        self.rates = rates
        self.widest = STEPS - 1

    def step(self, since_s: float) -> int:
        """The step that covers `since_s` seconds after the last untouched frame; the widest one for longer."""
        return int(np.clip(np.ceil(np.log(max(since_s, REST_S) / REST_S) / np.log(STEP) - 1e-9), 0, self.widest))

    def drift(self, step: int) -> Drift:
        seconds = REST_S * STEP**step
        return Drift(scale=self.rates.scale_per_s * seconds, contact=self.rates.contact_per_s * seconds)

    def sigma(self, sigma: Array, contact: NDArray[np.floating], step: int) -> Array:
        """(K,) noise of d with what the linear drift of this step leaves unsaid. contact (K, E): d per change."""
        drift = self.drift(step)
        spread = np.sqrt(drift.scale**2 + drift.contact**2 * (contact**2).sum(axis=1))
        return np.asarray(np.hypot(sigma, LINEARISATION * spread))


class MarginalLikelihood:
    """How well each step of the allowance explains a frame, touches being free to be any drop >= 0."""

    def __init__(self, pre: PreReconstructor, drift_prior: DriftPrior) -> None:
        self.m, self.drift_prior = pre.m, drift_prior
        (h, w), k = self.m.inside.shape, pre.measurements
        blocks = (h // COARSE, COARSE, w // COARSE, COARSE)
        jacobian = self.m.jacobian.reshape(k, *blocks).sum(axis=(2, 4)).reshape(k, -1)
        self._jacobian = np.asarray(jacobian[:, self.m.inside.reshape(blocks).any(axis=(1, 3)).ravel()], dtype=float)
        values, vectors = np.linalg.eigh(self.m.gram)
        misfit = vectors * np.maximum(values, 0.0) ** TUNING.misfit_power @ vectors.T
        self._misfit = misfit / np.trace(misfit)
        # Touches raise d only where the bundle's model says which way d goes.
        self.speaks = self.m.normalisation == "model"

    def __call__(self, d: Array, sigma: Array, live: NDArray[np.bool_], step: int) -> float:
        """-log p of (K,) d with noise sigma (K,), up to what all steps have in common. Some milliseconds."""
        drift = self.drift_prior.drift(step)
        contact, on = self.m.contact[live], np.ix_(live, live)
        covariance = np.diag(self.drift_prior.sigma(sigma, self.m.contact, step)[live] ** 2 + TUNING.absolute**2)
        covariance += drift.scale**2 + drift.contact**2 * contact @ contact.T
        covariance += MISFIT**2 * float(d[live] @ d[live]) * self._misfit[on]
        root = np.linalg.cholesky(covariance)
        white = solve_triangular(root, np.column_stack([self._jacobian[live], d[live]]), lower=True, check_finite=False)
        try:
            drop, residual = nnls(white[:, :-1], white[:, -1])
        except RuntimeError:  # it did not converge: this step does not explain the frame
            return float("inf")
        # Laplace's approximation: each pixel that is used costs what it was free to be before and is not any more.
        used = TYPICAL * white[:, :-1][:, drop > 0]
        _, occam = np.linalg.slogdet(np.eye(used.shape[1]) + used.T @ used)
        return float(0.5 * (residual**2 + occam) + np.log(np.diag(root)).sum())
