"""What training does to clean differences: symmetries of the skin, noise, drift, dead electrodes, model error.
Afresh each batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.geometry import Skin
from models.prereconstruction import Array, Drift, Operator, PreReconstructor

CHANNEL_ERROR = 1e-3  # of d, per channel and sample: what meshes and solvers differ by
CHANNEL_FLOOR = 1e-5  # of |Z|, likewise


@dataclass(frozen=True)
class Symmetry:
    """d'[k] = d[measurements[k]] belongs to the image transposed (if so), then flipped along y and x (if so)."""

    measurements: npt.NDArray[np.integer]
    transpose: bool
    flip_y: bool
    flip_x: bool

    def image(self, images: npt.NDArray) -> npt.NDArray:
        """Transforms (..., n, n) images [iy, ix]."""
        if self.transpose:
            images = np.swapaxes(images, -1, -2)
        if self.flip_y:
            images = images[..., ::-1, :]
        return images[..., ::-1] if self.flip_x else images


def symmetries(skin: Skin) -> list[Symmetry]:
    """Those of the square grid's eight that map the skin's electrodes (place, width) onto themselves and the
    pattern onto itself.
    """
    points = skin.point(skin.electrodes)
    row = {_key(m): k for k, m in enumerate(skin.pattern)}
    found = []
    for code in range(8):
        transpose, flip_y, flip_x = bool(code & 4), bool(code & 2), bool(code & 1)
        moved = points[:, ::-1] if transpose else points
        moved = moved * [-1 if flip_x else 1, -1 if flip_y else 1]
        distance = np.linalg.norm(points[:, None] - moved[None], axis=2)
        source = distance.argmin(axis=1)  # electrode e stands where `source[e]` has been moved to
        if distance.min(axis=1).max() > 1e-6 or not np.allclose(skin.widths, skin.widths[source]):
            continue
        keys = [_key(source[m]) for m in skin.pattern]
        if all(k in row for k in keys):
            found.append(Symmetry(np.array([row[k] for k in keys]), transpose, flip_y, flip_x))
    return found


def _key(measurement: npt.NDArray[np.integer]) -> tuple[tuple[int, ...], ...]:
    """The same for every order that reads the same |Z|: pairs turned round, drive and sense exchanged (reciprocity)."""
    a, b, c, d = (int(e) for e in measurement)
    first, second = sorted((tuple(sorted((a, b))), tuple(sorted((c, d)))))
    return (first, second)


@dataclass(frozen=True)
class Condition:
    """What one tare found, and what really holds."""

    operator: Operator
    sigma: Array  # (K,) true noise of d
    drift: Drift
    contact: Array  # (K, E)
    live: npt.NDArray[np.bool_]
    tare_frames: int

    def spoil(self, d: Array, rng: np.random.Generator) -> Array:
        """(N, K) clean differences -> measured ones."""
        n, k = d.shape
        d = d * (1 + CHANNEL_ERROR * rng.standard_normal((n, k))) + CHANNEL_FLOOR * rng.standard_normal((n, k))
        d = d + self.sigma * np.sqrt(1 + 1 / self.tare_frames) * rng.standard_normal((n, k))
        if self.drift.scale or self.drift.contact:
            shift = self.drift.contact * rng.standard_normal((n, self.contact.shape[1]))
            d = d + (1 + d) * self.drift.scale * rng.standard_normal((n, 1)) + shift @ self.contact.T
        return np.where(self.live, d, 0.0)


def random_condition(pre: PreReconstructor, rng: np.random.Generator) -> Condition:
    """Weighted to what is measured most: half between 58 and 82 dB, a quarter without noise; half without drift."""
    m = pre.m
    kind = rng.random()
    decibel = rng.uniform(58, 82) if kind < 0.5 else rng.uniform(45, 105) if kind < 0.75 else 130.0
    share = rng.choice([0.0, rng.uniform()])  # of the noise that is the converter's, the same in ohm on every channel
    sigma = 10 ** (-decibel / 20) * np.sqrt(1 - share + share * (np.median(m.z0) / m.z0) ** 2)
    drift = Drift()
    if rng.random() < 0.5:
        drift = Drift(scale=10 ** rng.uniform(-4.5, -2.5), contact=10 ** rng.uniform(-3.5, -1.5))
    return condition(pre, rng, sigma, drift, dead=int(rng.choice(3, p=[0.85, 0.1, 0.05])))


def condition(pre: PreReconstructor, rng: np.random.Generator, sigma: Array, drift: Drift, dead: int = 0) -> Condition:
    """The condition of a true sigma (K,), as a tare of 64 frames would see it."""
    m, k = pre.m, pre.measurements
    live = np.ones(k, dtype=bool)
    if dead:
        electrodes = rng.choice(m.contact.shape[1], dead, replace=False)
        live = ~np.isin(m.pattern, electrodes).any(axis=1)
    estimate = sigma * np.clip(1 + 0.06 * rng.standard_normal(k), 0.7, 1.3)
    operator = pre.condition(estimate, drift=drift, weights=live.astype(float))
    return Condition(operator, sigma, drift, m.contact, live, 64)
