"""Touched or untouched, with drift estimated in the very frame: log evidence of both, in nats.

    untouched   d ~ N(0, E + B P B^T)                           E: noise and what no model gets right, P: of the drift x
    touched     d ~ N(sum_i y_i a_i, E + B P B^T + (misfit |touch|)^2 M)     a_i: response of a disc, y_i >= 0 its drop

A disc's drop is integrated out under a prior that is even in its logarithm, its place and radius are summed over all
discs of a grid (each radius, each place alike): so more freedom costs by itself what it must (Occam). Further touches
are taken in one by one while each explains the rest better by far. Model error is of the touch's own size, so a strong
touch is not mistaken for two, nor for something else, because discs on a grid and linear physics do not fit it exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.optimize import nnls

from models.bundle import Bundle
from services.estimation.by_bundle import ByBundle
from services.estimation.physics import SkinPhysics
from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]

NEGLIGIBLE = 12.0  # nats below the likeliest disc: numerics, not physics


class Found(NamedTuple):
    """A touch: posterior means, model units and S/m of a disc."""

    position: Array  # (2,)
    radius: float
    drop: float


class Explanation(NamedTuple):
    """Of one frame; N drift quantities."""

    untouched: float  # log evidence
    touched: float
    touch: Array  # (K,) what touches make of d; 0 where there is none
    touches: tuple[Found, ...]
    drift: Array  # (N,) posterior mean, touches given
    drift_covariance: Array  # (N, N)
    left: float  # energy that drift and touches leave, whitened: about the number of measurements where they explain
    measurements: int  # that count

    @property
    def odds(self) -> float:
        """Log evidence of touched against untouched."""
        return self.touched - self.untouched

    def as_good(self, other: Explanation) -> bool:
        """Whether this explanation, which permits less drift, does for the frame: likelier, and not by a touch that
        stands for the drift, unless that leaves less.
        """
        likelier = self.touched - other.touched >= TUNING.steady_nats
        return likelier and (len(self.touches) <= len(other.touches) or self.left <= other.left)

    @property
    def fits(self) -> bool:
        """Whether drift and touches are all that there is: a fault is not explained by them."""
        return self.left < TUNING.fits * self.measurements


class Whitened(NamedTuple):
    root: Array  # (k, k) lower Cholesky factor of the covariance
    log_density: float  # of a frame at the mean, up to a constant

    @classmethod
    def of(cls, covariance: Array) -> Whitened:
        try:
            root = cholesky(covariance, lower=True, check_finite=False)
        except LinAlgError as why:
            raise ValueError(f"a covariance that is none ({why})") from why
        return cls(root, -float(np.log(np.diag(root)).sum()))

    def __call__(self, values: Array) -> Array:
        return np.asarray(solve_triangular(self.root, values, lower=True, check_finite=False))

    def density(self, white: Array) -> float:
        """Log density of a whitened frame, up to a constant."""
        return self.log_density - 0.5 * float(white @ white)


class TouchEvidence:
    def __init__(self, physics: SkinPhysics, tuning: Tuning = TUNING) -> None:
        self.physics, self.tuning = physics, tuning
        low, high = np.log(tuning.least_drop), np.log(tuning.most_drop)
        self._log_range = low, high
        # Of the prior of a drop's logarithm: flat from low to high, Gaussian beyond.
        self._log_width = float(np.log(high - low + np.sqrt(2 * np.pi) * tuning.fall_off))

    def untouched(self, d: Array, error: Array, columns: Array, prior: Array, live: NDArray[np.bool_]) -> float:
        """Log evidence of nothing but drift: no touch is looked for."""
        white = Whitened.of(_restricted(error, columns, prior, live))
        return white.density(white(d[live]))

    def __call__(
        self, d: Array, error: Array, columns: Array, prior: Array, live: NDArray[np.bool_] | None = None
    ) -> Explanation:
        """Explain d (K,). error (K, K): covariance of all but drift and touches; columns (K, N), prior (N, N): the
        drift's. live (K,): measurements that count.
        """
        live = np.ones(len(d), dtype=bool) if live is None else live
        frame, base, b = d[live], _restricted(error, columns, prior, live), columns[live]
        response, misfit = self.physics.response[live], self.physics.misfit[np.ix_(live, live)]
        white = Whitened.of(base)
        seen = white(frame)
        untouched = white.density(seen)
        size = self._size(white(response), seen, response)
        white = Whitened.of(base + (self.tuning.misfit * size) ** 2 * misfit)
        seen, atoms = white(frame), white(response)
        gain, weights = self._touches(atoms, seen)
        touch = response @ weights.sum(axis=0) if len(weights) else np.zeros(len(frame))
        # x given d and the touch, and what of it the touch's own uncertainty leaves open.
        gathered = white(b @ prior)
        reach = gathered.T @ white(np.column_stack([frame, touch]))
        drift = reach[:, 0] - reach[:, 1]
        covariance = prior - gathered.T @ gathered + self._open(gathered.T @ atoms, weights)
        whole = np.zeros(len(d))
        whole[live] = touch
        rest = seen - white(touch)
        return Explanation(
            untouched,
            white.density(seen) + gain,
            whole,
            self._found(weights),
            drift,
            covariance,
            float(rest @ rest),
            len(frame),
        )

    def corrected(
        self, d: Array, error: Array, columns: Array, prior: Array, live: NDArray[np.bool_] | None = None
    ) -> tuple[Array, Array, Explanation]:
        """d (K,) without the likeliest drift, and the covariance (K, K) of what is left of the drift: what images are
        to be made of, and how far they are to trust it.
        """
        found = self(d, error, columns, prior, live)
        return d - columns @ found.drift, columns @ found.drift_covariance @ columns.T, found

    # touches

    def _size(self, atoms: Array, seen: Array, response: Array) -> float:
        """|d| of the likeliest single touch."""
        log, drop = self._log_posterior(atoms, seen)
        best = int(log.argmax())
        return float(np.linalg.norm(response[:, best]) * drop[best])

    def _log_posterior(self, atoms: Array, seen: Array) -> tuple[Array, Array]:
        """Of each disc alone, against no touch: log of prior times integrated likelihood; and its likeliest drop."""
        length = np.linalg.norm(atoms, axis=0)
        z = (atoms.T @ seen) / length
        if not self.physics.signed:
            z = np.abs(z)
        drop = np.maximum(z / length, 1e-6)
        low, high = self._log_range
        log_drop = np.log(drop)
        beyond = np.maximum(np.maximum(low - log_drop, log_drop - high), 0.0) / self.tuning.fall_off
        width = np.sqrt(2 * np.pi) / (length * drop)  # of the likelihood, in the drop's logarithm
        log = np.where(z > 0, 0.5 * z**2, 0.0) - 0.5 * beyond**2 + np.log(np.minimum(width, 1.0)) - self._log_width
        return log + self.physics.log_prior, drop

    def _touches(self, atoms: Array, seen: Array) -> tuple[float, Array]:
        """Log evidence that touches add, and for each touch (T, M) the mean drop of each disc."""
        found: list[Array] = []
        scale, left, gain = np.ones(0), seen, 0.0
        for count in range(self.tuning.touches):
            log, drop = self._log_posterior(atoms, left)
            highest = float(log.max())
            more = highest + float(np.log(np.exp(log - highest).sum()))
            if count and more < self.tuning.another:
                break
            gain += more
            best = int(log.argmax())
            near = np.linalg.norm(self.physics.position - self.physics.position[best], axis=1) < self.tuning.apart
            share = np.where(near & (log > highest - NEGLIGIBLE), np.exp(log - highest), 0.0)
            found.append(share / share.sum() * drop)
            groups = np.column_stack([atoms @ touch for touch in found])
            if not self.physics.signed:
                groups = groups * np.sign(seen @ groups)
            scale, _ = nnls(groups, seen)
            left = seen - groups @ scale
        return gain, np.array(found) * scale[:, None]

    def _open(self, moved: Array, weights: Array) -> Array:
        """(N, N) covariance of the drift that comes of not knowing which disc it was; moved (N, M): by each disc."""
        n = len(moved)
        spread = np.zeros((n, n))
        for drop in weights:
            used = drop > 0
            total = float(drop.sum())
            if not total:
                continue
            share = drop[used] / total
            each = moved[:, used] * total
            each = each - (each @ share)[:, None]
            spread += (each * share) @ each.T
        return spread

    def _found(self, weights: Array) -> tuple[Found, ...]:
        found = []
        for drop in weights:
            total = float(drop.sum())
            if total > 0:
                share = drop / total
                found.append(Found(share @ self.physics.position, float(share @ self.physics.radius), total))
        return tuple(found)


def _restricted(error: Array, columns: Array, prior: Array, live: NDArray[np.bool_]) -> Array:
    if live.sum() < 2:
        raise ValueError(f"only {int(live.sum())} of {len(live)} measurements count: nothing can be explained")
    b = columns[live]
    return np.asarray(error[np.ix_(live, live)] + b @ prior @ b.T)


def _of(bundle: Bundle) -> TouchEvidence:
    skin, series = bundle.skin, None
    if "contact_impedance" in skin:
        series = np.asarray(skin["contact_impedance"], float) / np.asarray(skin["electrodes"]["width"], float)
    return TouchEvidence(SkinPhysics.of(bundle.matrices, bundle.half_width, series))


KEPT = 4  # of one and a half megabytes each

evidence_of = ByBundle(_of, KEPT)
"""Made when it is first asked for, which takes a third of a second, and shared by all skins of the bundle."""
