"""What a press does to each measurement, as a function of its place: a Gaussian process for all measurements.

The response of measurement k to a mean press at x is a share of the bundle's own sensitivity, with a gain that nobody
knows, plus a smooth field. The field's length, its noise and the sensitivities' share are those of the greatest
marginal likelihood over all measurements of this very skin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.locator_arrays import matern
from services.calibration.fields import half_width, sample, sensitivities
from services.calibration.presses import Presses, evenly, radius_of
from services.calibration.registration import Similarity

Array = NDArray[np.float64]

BLUR = 1.0  # pixels
LENGTHS = (0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # of the presses' radius
NOISES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # beside the field's variance
SHARES = (1e-3, 0.1, 1.0, 10.0)  # of the sensitivities, beside the field's variance
MOST_FOR_LENGTH = 300  # presses from which length, noise and share are found
DIAGONALS = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9)  # share of the residuals' diagonal in their covariance
COVARIANCE_FOLDS = 5
ROUNDS = 2  # in which maps and strengths are found from each other
AMPLITUDES = (0.3, 3.0)  # of what a press's depth leads to expect


@dataclass(frozen=True)
class Smoothness:
    """What the Gaussian process assumes."""

    length_m: float
    noise: float
    share: float  # of the bundle's sensitivities; infinite: nothing but them


@dataclass(frozen=True)
class ResponseFit:
    """The posterior of N presses and K measurements, in a frame of true metres."""

    bundle: Bundle
    similarity: Similarity
    assumed: Smoothness
    xy: Array  # (N, 2) m, in the machine's frame
    strength: Array  # (N,)
    alpha: Array  # (N, K)
    scale: Array  # (K,) by which measurements were divided
    norm: Array  # (K,) by which sensitivities were
    left: Array  # (N, K) what is wrong with the map for each press, made without it

    def at(self, machine: Array) -> Array:
        """(P, 2) m of the machine's frame -> (P, K) difference by a mean press there."""
        fields, half = sensitivities(self.bundle, BLUR), half_width(self.bundle)
        physics, fitted = (sample(fields, self.similarity.to_skin(at), half) / self.norm for at in (machine, self.xy))
        known = self.strength[:, None] * self.alpha
        found = self.assumed.share * physics * (fitted * known).sum(axis=0)
        if np.isfinite(self.assumed.length_m):
            found = found + matern(machine, self.xy, self.assumed.length_m) @ known
        return np.asarray(found * self.scale)

    @property
    def error(self) -> Array:
        """(K, K) covariance of what is wrong with the map for a press that it was not made of, noise included."""
        return covariance(self.left)


def fit(
    presses: Presses, similarity: Similarity, bundle: Bundle, assumed: Smoothness | None = None, field: bool = True
) -> ResponseFit:
    """The map of these presses. assumed: else found from them; field False: a gain per measurement alone."""
    scale = np.sqrt((presses.difference**2).mean(axis=0))
    scale = np.where(presses.measured & (scale > 0), scale, 1.0)
    y = presses.difference / scale
    physics = sample(sensitivities(bundle, BLUR), similarity.to_skin(presses.xy), half_width(bundle))
    norm = np.maximum(np.sqrt((physics**2).mean(axis=0)), 1e-30)
    f = physics / norm * presses.strength[:, None]
    if not field:
        assumed = Smoothness(np.inf, 0.3, 1.0)
    elif assumed is None:
        some = evenly(len(presses), MOST_FOR_LENGTH)
        assumed = smoothness(y[some], presses.xy[some], presses.strength[some], f[some], presses.measured)
    alpha, left, _ = _posterior(y, presses.xy, presses.strength, f, assumed)
    return ResponseFit(
        bundle, similarity, assumed, presses.xy, presses.strength, alpha, scale, norm, left * scale * presses.measured
    )


def covariance(left: Array) -> Array:
    """(K, K) of residuals (N, K). There are more numbers in it than residuals, so it is drawn towards its diagonal, as
    far as makes residuals most likely that took no part.
    """
    live = left.any(axis=0)
    some = left[:, live] / np.sqrt((left[:, live] ** 2).mean(axis=0))
    fold = np.random.default_rng(4).permutation(len(some)) % COVARIANCE_FOLDS
    cost = dict.fromkeys(DIAGONALS, 0.0)
    for one in np.unique(fold):
        rest, out = some[fold != one], some[fold == one]
        if len(rest):
            for share in DIAGONALS:
                lower = np.linalg.cholesky(_drawn(rest, share))
                cost[share] += float((np.linalg.solve(lower, out.T) ** 2).sum())
                cost[share] += 2 * len(out) * float(np.log(np.diag(lower)).sum())
    # One step further: residuals have heavier tails than a normal distribution.
    best = min(DIAGONALS.index(share) for share in DIAGONALS if cost[share] == min(cost.values()))
    return _drawn(left, DIAGONALS[min(best + 1, len(DIAGONALS) - 1)])


def _drawn(left: Array, share: float) -> Array:
    """(K, K) covariance of residuals (N, K), `share` of it their variances alone."""
    found = left.T @ left / len(left)
    own = np.maximum(np.diag(found), 1e-6 * float(np.diag(found).mean()) + 1e-30)
    return np.asarray((1 - share) * found + share * np.diag(own))


def fit_amplitudes(presses: Presses, similarity: Similarity, bundle: Bundle) -> tuple[ResponseFit, Presses]:
    """The map, and the presses with strengths of their own: each as strong as the map that was made without it says.

    Skins are not even and probes do not press twice alike, whatever depth the file states.
    """
    found = fit(presses, similarity, bundle)
    for _ in range(ROUNDS):
        live = presses.measured
        expected, d = (presses.difference - found.left)[:, live], presses.difference[:, live]
        weighted = np.linalg.solve(found.error[np.ix_(live, live)], expected.T).T
        amplitude = ((weighted * d).sum(axis=1) + 1.0) / ((weighted * expected).sum(axis=1) + 1.0)
        strength = presses.strength * np.clip(amplitude, *AMPLITUDES)
        presses = replace(presses, strength=strength / strength.mean())
        found = fit(presses, similarity, bundle)
    return found, presses


def smoothness(y: Array, xy: Array, strength: Array, f: Array, measured: NDArray[np.bool_]) -> Smoothness:
    """The assumptions of the greatest marginal likelihood, each measurement with a variance of its own; length and
    noise for a share of 1 first, then the share.

    y, f (N, K): differences and sensitivities at the presses, both of unit size; xy (N, 2) m; strength (N,).
    """
    radius = radius_of(xy)
    y, f = y[:, measured], f[:, measured]

    def likelihood(length: float, noise: float, share: float) -> float:
        return _posterior(y, xy, strength, f, Smoothness(length, noise, share))[2]

    _, length, noise = max((likelihood(radius * s, n, 1.0), radius * s, n) for s in LENGTHS for n in NOISES)
    _, share = max((likelihood(length, noise, s), s) for s in SHARES)
    return Smoothness(length, noise, share)


def _posterior(y: Array, xy: Array, a: Array, f: Array, assumed: Smoothness) -> tuple[Array, Array, float]:
    """alpha (N, K), leave-one-out residuals (N, K), and the mean logarithm of the marginal likelihood.

    y, f (N, K): as for `smoothness`; a (N,): strengths; xy (N, 2) m. The field's covariance is shared by all
    measurements; the sensitivities add one direction to each (Sherman and Morrison).
    """
    n = len(xy)
    near = matern(xy, xy, assumed.length_m) if np.isfinite(assumed.length_m) else np.zeros((n, n))
    lower = np.linalg.cholesky(near * np.outer(a, a) + assumed.noise * np.eye(n))
    half = np.linalg.inv(lower)
    inverse = half.T @ half
    kf, ky = inverse @ f, inverse @ y
    s = (f * kf).sum(axis=0) + 1 / assumed.share
    alpha = ky - kf * ((f * ky).sum(axis=0) / s)
    diagonal = np.diag(inverse)[:, None] - kf**2 / s
    variance = np.maximum((y * alpha).sum(axis=0) / n, 1e-12)
    logs = 0.5 * n * np.log(variance) + np.log(np.diag(lower)).sum() + 0.5 * np.log(s * assumed.share)
    return alpha, alpha / diagonal, -float(logs.mean())
