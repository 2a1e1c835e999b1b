"""Random changes of clean differences in training, drawn anew for each batch: noise, drift, dead electrodes, model
error. (Symmetries of the skin: symmetries.py.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.prereconstruction import Array, Drift, Operator, PreReconstructor

# What two meshes or two solvers differ by, of |d|. It is no noise: it looks like the signal of a touch that is not
# there, a thousandth of what is, and falls off with the Gram matrix's eigenvalues almost as touches do (their power 0.4
# in amplitude, against 0.5). Independent errors of that size on each channel would bury the corners of every shape.
MODEL_ERROR, MISFIT_POWER = 1.2e-3, 0.4
SERVICE_DRIFT = Drift(scale=2e-5, contact=1e-4)  # a little less than services allow for at rest


@dataclass(frozen=True, eq=False)
class OwnSkin:
    """What was measured of one very skin; it looks like itself only as it is, so it has no symmetries."""

    error: Array  # (K, K) factor of the covariance of what is wrong with its model, of |d|
    noise: Array  # (K,) standard deviation of d


@dataclass(frozen=True)
class Condition:
    """What one tare found, and the true noise and drift."""

    operator: Operator
    sigma: Array  # (K,) true noise of d
    drift: Drift
    contact: Array  # (K, E)
    error: Array  # (K, K) factor of the model error's covariance, of |d|
    live: npt.NDArray[np.bool_]
    tare_frames: int

    def spoil(self, d: Array, rng: np.random.Generator) -> Array:
        """(N, K) clean differences -> measured ones."""
        n, k = d.shape
        size = np.linalg.norm(d, axis=1, keepdims=True)
        d = d + size * (rng.standard_normal((n, k)) @ self.error.T)
        d = d + self.sigma * np.sqrt(1 + 1 / self.tare_frames) * rng.standard_normal((n, k))
        if self.drift.scale or self.drift.contact:
            shift = self.drift.contact * rng.standard_normal((n, self.contact.shape[1]))
            d = d + (1 + d) * self.drift.scale * rng.standard_normal((n, 1)) + shift @ self.contact.T
        return np.where(self.live, d, 0.0)


def random_condition(pre: PreReconstructor, rng: np.random.Generator, own: OwnSkin | None = None) -> Condition:
    """Weighted to what is measured most: a third without noise, most of the rest between 58 and 85 dB; of a skin of
    one's own, half with about the noise that it has.
    """
    m = pre.m
    kind = rng.random()
    decibel = 120.0 if kind < 0.33 else rng.uniform(58, 85) if kind < 0.8 else rng.uniform(45, 110)
    share = rng.choice([0.0, rng.uniform()])  # of the noise that is the converter's, the same in ohm on every channel
    sigma = 10 ** (-decibel / 20) * np.sqrt(1 - share + share * (np.median(m.z0) / m.z0) ** 2)
    if own is not None and rng.random() < 0.5:
        sigma = np.maximum(own.noise * 10 ** rng.uniform(-0.5, 0.5), 1e-6)
    kind = rng.random()
    drift = Drift() if kind < 0.4 else SERVICE_DRIFT
    if kind > 0.65:
        drift = Drift(scale=10 ** rng.uniform(-4.5, -2.5), contact=10 ** rng.uniform(-3.5, -1.5))
    return condition(pre, rng, sigma, drift, dead=int(rng.choice(3, p=[0.9, 0.07, 0.03])), own=own)


def condition(
    pre: PreReconstructor,
    rng: np.random.Generator,
    sigma: Array,
    drift: Drift,
    dead: int = 0,
    exact: bool = False,
    own: OwnSkin | None = None,
) -> Condition:
    """The condition of a true sigma (K,), as a tare of 64 frames would see it. exact: no model error."""
    m, k = pre.m, pre.measurements
    live = np.ones(k, dtype=bool)
    if dead:
        electrodes = rng.choice(m.contact.shape[1], dead, replace=False)
        live[np.isin(m.pattern, electrodes).any(axis=1)] = False
    estimate = sigma * np.clip(1 + 0.06 * rng.standard_normal(k), 0.7, 1.3)
    operator = pre.condition(estimate, drift=drift, weights=live.astype(float))
    error = (MODEL_ERROR * _misfit_factor(m.gram.astype(float)) if own is None else own.error) * (not exact)
    return Condition(operator, sigma, drift, m.contact, error, live, 64)


def _misfit_factor(gram: Array) -> Array:
    """(K, K) factor of a covariance of trace 1 that lies where touches do: powers of the Gram matrix's eigenvalues."""
    values, vectors = np.linalg.eigh(gram)
    profile = np.maximum(values, 0) ** MISFIT_POWER
    return np.asarray(vectors * (profile / np.linalg.norm(profile)))
