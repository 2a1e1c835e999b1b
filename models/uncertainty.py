"""What a touch in an image is worth: the errors of its peak and its integrated drop, and the drop that a known indenter
must have made (numpy only; fitted by models/calibrate.py, kept in a bundle's manifest beside its network).

Each estimate has a `Map`: a quadratic in a few logarithms that says the relative error which 68.3 % of presses stay
below, and for the known indenter also the factor that most of its estimates are short by. The factors a network gets
wrong depend on the network, so a map names the network file that it was fitted to and holds for no other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]

# How services measure a touch in an image, and so how it was measured when the maps were fitted.
FLOOR = 0.02  # S/m: a weaker peak is no touch (0.2 N by the default law)
RELATIVE_FLOOR = 0.12  # of the strongest peak: weaker ones are side lobes of it
PLATEAU = 0.9  # fraction of the highest pixel above which pixels belong to the peak

ESTIMATES = ("peak", "integral", "known")
WITHIN = 0.6827  # of the presses are to be within one sigma
LEAST, MOST = 2e-3, 2.0  # relative standard uncertainties that are believed
LEAST_NOISE = 2e-6  # relative; less looks the same


@dataclass(frozen=True)
class ImageFeatures:
    """What an image shows of N touches; each an array (N,) or a number. Lengths in model units."""

    peak: Array  # S/m: mean of the pixels near the highest
    sigma: Array  # S/m: the network's own word, mean over the touch
    integral: Array  # S/m times area
    area: Array  # of what exceeds half the peak
    edge: Array  # distance from the centroid to the edge of the image
    noise: Array  # rms relative standard uncertainty of the measurements that the image was made of


def known_drop(seen: ImageFeatures, area: Array | float) -> Array:
    """Peak drop [S/m] of a flat round contact of known area that looks like `seen`.

    A small disc of conductivity 1 - h acts on the measurements in proportion to area * h / (1 - h/2) (a cylinder's
    polarisability), so it is this that an image keeps while it confounds peak and area.
    """
    peak = np.minimum(seen.peak, 0.99)
    strength = seen.integral / (1 - peak / 2) / area
    return np.asarray(strength / (1 + strength / 2))


def estimate(name: str, seen: ImageFeatures, area: Array | float | None = None) -> Array:
    """The quantity that a map is about; `area` of the indenter for "known"."""
    if name == "known":
        assert area is not None
        return known_drop(seen, area)
    return np.asarray(seen.peak if name == "peak" else seen.integral)


def features(name: str, seen: ImageFeatures, area: Array | float | None = None) -> Array:
    """(N, F) of N touches."""
    peak, size = np.maximum(seen.peak, 1e-6), np.maximum(seen.area, 1e-6)
    noise = np.log10(np.maximum(seen.noise, LEAST_NOISE))
    if name == "known":
        assert area is not None
        size = size / area
        last = np.log(area) + 0 * peak
    else:
        last = np.log(np.maximum(seen.sigma, 1e-6) / peak)
    columns = np.broadcast_arrays(noise + 0 * peak, np.log(size), np.log(peak), seen.edge, last)
    return np.stack([np.atleast_1d(np.asarray(c, dtype=float)) for c in columns], axis=1)


@lru_cache
def _pairs(features: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    rows, columns = np.triu_indices(features)
    return rows, columns


@dataclass(frozen=True)
class Map:
    """F features, P = 1 + F + F (F + 1) / 2 coefficients of the quadratic in them, standardised."""

    low: Array  # (F,) features are clipped to where presses were fitted
    high: Array  # (F,)
    sigma: Array  # (P,) of log(relative error)
    factor: Array  # (P,) of log(truth / estimate); empty: 1
    network: str = ""  # sha256 of the network file it was fitted to

    def terms(self, x: Array) -> Array:
        """(N, F) -> (N, P)."""
        z = 2 * (np.clip(x, self.low, self.high) - self.low) / np.maximum(self.high - self.low, 1e-9) - 1
        rows, columns = _pairs(z.shape[1])
        return np.concatenate([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]], axis=1)

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """(factor, relative standard uncertainty) of (N, F) features, each (N,)."""
        terms = self.terms(x)
        factor = np.exp(terms @ self.factor) if self.factor.size else np.ones(len(x))
        return factor, np.clip(np.exp(terms @ self.sigma), LEAST, MOST)

    def to_dict(self) -> dict[str, Any]:
        numbers = {k: [round(float(v), 5) for v in getattr(self, k)] for k in ("low", "high", "sigma", "factor")}
        return {**numbers, "network": self.network}

    @classmethod
    def from_dict(cls, found: Mapping[str, Any]) -> Map:
        """Raises KeyError, TypeError or ValueError where `found` is no map."""
        numbers = {k: np.asarray(found[k], dtype=float) for k in ("low", "high", "sigma", "factor")}
        f = len(numbers["low"])
        if any(v.size not in (f, 1 + f + f * (f + 1) // 2, 0) for v in numbers.values()):
            raise ValueError(f"a map of {f} features with {[v.size for v in numbers.values()]} numbers")
        return cls(**numbers, network=str(found["network"]))


def maps(manifest: Mapping[str, Any], variant: str, file: str | None) -> dict[str, Map]:
    """The maps of a bundle's network; empty where it has none, or none that was fitted to this very network file."""
    said = ((manifest.get("network") or {}).get(variant) or {}).get("uncertainty") or {}
    found = {name: Map.from_dict(said[name]) for name in ESTIMATES if name in said}
    expected = manifest.get("files", {}).get(file)
    return {name: m for name, m in found.items() if m.network == expected}


def fit(x: Array, estimated: Array, truth: Array, correct: bool, network: str = "", rounds: int = 60) -> Map:
    """The map of N presses: features (N, F), estimates and truths (N,). Quantile regression by reweighted least squares
    (Koenker and Bassett, Econometrica 46, 1978).
    """
    low, high = np.quantile(x, [0.002, 0.998], axis=0)
    bare = Map(low, high, np.zeros(0), np.zeros(0), network)
    terms = bare.terms(x)
    factor: Array = np.zeros(0)
    if correct:
        factor = _quantile(terms, np.log(truth / estimated), 0.5, rounds)
        estimated = estimated * np.exp(terms @ factor)
    relative = np.maximum(np.abs(1 - truth / estimated), 1e-4)
    return Map(low, high, _quantile(terms, np.log(relative), WITHIN, rounds), factor, network)


def _quantile(terms: Array, y: Array, q: float, rounds: int) -> Array:
    t, *_ = np.linalg.lstsq(terms, y, rcond=None)
    for _ in range(rounds):
        left = y - terms @ t
        weight = np.where(left > 0, q, 1 - q) / np.maximum(np.abs(left), 1e-2)
        weighted = terms * weight[:, None]
        t = np.linalg.solve(weighted.T @ terms + 1e-4 * len(y) * np.eye(len(t)), weighted.T @ y)
    return np.asarray(t)
