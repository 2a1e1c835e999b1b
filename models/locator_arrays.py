"""What `skin register` leaves in a bundle for locator.py (numpy only)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]

QUANTITIES = ("", "indentation_m", "force_n")
FEWEST_LIVE = 8  # measurements, with fewer of which nothing is located
MOST_PLACES = 1 << 16


@dataclass(frozen=True)
class KernelMachine:
    """A regression by Matern kernels (5/2) round the presses that it was trained on. N presses, F features."""

    centres: Array  # (N, F)
    weights: Array  # (N, M)
    offset: Array  # (M,)
    length: float
    sigma: Array  # (M,) standard deviation of what it gets wrong, for a press that it was not trained on
    spread: Array  # (M,) of what it was trained to say

    def __call__(self, features: Array) -> tuple[Array, Array]:
        """(F,) -> (M,) and its standard uncertainty, which grows to `spread` far from everything known."""
        near = matern(features[None], self.centres, self.length)[0]
        far = 1.0 - float(near.max())
        return self.offset + near @ self.weights, np.sqrt(self.sigma**2 + (far * self.spread) ** 2)


@dataclass(frozen=True)
class LocatorArrays:
    """What a bundle's locator.npz holds. P places on a grid, K measurements."""

    shape: Array  # (2,) rows and columns of the grid
    corner: Array  # (2,) m, x and y of its first place
    spacing: Array  # () m
    allowed: npt.NDArray[np.bool_]  # (rows * columns,) where the P places are: where presses were
    map: Array  # (P, K) relative change by a mean press
    error: Array  # (K, K) covariance of what is wrong with it, noise included
    noise: Array  # (K,) standard deviation of the noise that is in `error`
    measured: npt.NDArray[np.bool_]  # (K,) measurements that the presses had
    misfit: Array  # () mean square whitened residual of a press that the map was not made of
    spread: Array  # (3,) factor, floor [m^2], gap [m^2]: see locator.uncertain
    more: Array  # (2,) share of the residual that a second, a third touch must explain to count
    rotation: Array  # (K, F) of whitened unit differences into features
    middle: Array  # (K,) their mean
    reach: Array  # (3,) features per metre and centre: places as features
    loudness: Array  # () features per logarithm of an amplitude
    quantity: Array  # () index in QUANTITIES
    place_centres: Array  # of the KernelMachine that corrects places; empty: none
    place_weights: Array
    place_offset: Array
    place_length: Array
    place_sigma: Array
    place_spread: Array
    press_centres: Array  # of the one that says how deep or how hard
    press_weights: Array
    press_offset: Array
    press_length: Array
    press_sigma: Array
    press_spread: Array

    def machine(self, name: str) -> KernelMachine | None:
        centres, weights, offset, length, sigma, spread = (
            np.asarray(getattr(self, f"{name}_{part}"), float)
            for part in ("centres", "weights", "offset", "length", "sigma", "spread")
        )
        return KernelMachine(centres, weights, offset, float(length), sigma, spread) if len(centres) else None


def matern(a: Array, b: Array, length: float) -> Array:
    """(N, M) kernel of (N, F) and (M, F) points, 5/2: twice differentiable."""
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    s = np.sqrt(5.0 * np.maximum(square, 0.0)) / length
    return np.asarray((1 + s + s * s / 3) * np.exp(-s))


def _shapes(a: LocatorArrays, k: int) -> dict[str, tuple[int, ...]]:
    """What each array of k measurements is to be, by what those are that say how many there are."""
    p, f = int(a.allowed.sum()), a.rotation.shape[-1] if a.rotation.ndim == 2 else 0
    live = int(a.measured.sum()) if a.measured.dtype.kind == "b" else -1
    shapes: dict[str, tuple[int, ...]] = {"corner": (2,), "spacing": (), "map": (p, k), "error": (k, k), "noise": (k,)}
    shapes |= {"measured": (k,), "misfit": (), "spread": (3,), "more": (2,), "reach": (3,)}
    shapes |= {"loudness": (), "quantity": (), "rotation": (live, f), "middle": (live,)}
    for name, outputs, inputs in (("place", 2, f + 2), ("press", 1, f + 3)):
        n = len(getattr(a, f"{name}_centres"))
        inputs = inputs if n else 0
        shapes |= {f"{name}_centres": (n, inputs), f"{name}_weights": (n, outputs), f"{name}_length": ()}
        shapes |= {f"{name}_{part}": (outputs,) for part in ("offset", "sigma", "spread")}
    return shapes


def arrays_of(data: Mapping[str, npt.NDArray[Any]], measurements: int) -> LocatorArrays:
    """From the arrays of a locator.npz. Raises ValueError, which says what is wrong."""
    names = LocatorArrays.__dataclass_fields__
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(f"lacks {', '.join(missing)}")
    a = LocatorArrays(**{name: data[name] for name in names})
    if a.spread.shape == (2,):  # registered before there was a gap
        a = replace(a, spread=np.append(a.spread, 0.0))
    sides = a.shape.tolist() if a.shape.dtype.kind in "iu" else []
    if np.shape(sides) != (2,) or min(sides) < 1 or sides[0] * sides[1] > MOST_PLACES:
        raise ValueError(f"shape: found {a.shape}, expected two sides of a grid of at most {MOST_PLACES} places")
    if a.allowed.shape != (sides[0] * sides[1],) or a.allowed.dtype.kind != "b" or not a.allowed.any():
        raise ValueError(f"allowed: found {a.allowed.dtype} {a.allowed.shape}, expected booleans, some of them true")
    for name, shape in _shapes(a, measurements).items():
        array = getattr(a, name)
        if array.shape != shape or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
            raise ValueError(f"{name}: found {array.dtype} {array.shape}, expected finite numbers {shape}")
    positive = np.hstack([a.spacing, a.misfit, a.place_length, a.press_length, np.diag(a.error), a.spread[:2]])
    if a.measured.sum() < FEWEST_LIVE or not (positive > 0).all() or int(a.quantity) not in (0, 1, 2):
        raise ValueError("numbers out of range")
    return a
