"""Where a real skin's frame lies in that of the machine that presses it: a similarity fitted to known presses.

This needs no reconstruction. The bundle's sensitivities say how each measurement should change with the place of a
press, up to a gain per measurement. The similarity found is the one that explains most of the measured change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from models.bundle import Bundle
from protocol.errors import EitskinError
from services.estimation.references import noise_of_references
from services.recordings.npz_file import InputError, measurement_order

Array = NDArray[np.float64]

FEWEST = 20
PRESS_BLUR = 2.0
"""Pixels of the bundle's grid over which sensitivities are averaged: about the width of a press."""
MOST_DEPTHS = 8


class RegistrationError(EitskinError, ValueError):
    """The presses cannot be registered; says what was found, what was expected and what to do."""


@dataclass(frozen=True)
class Presses:
    """N presses at known places. K measurements, in the bundle's order."""

    difference: Array  # (N, K) |Z| / |Z0| - 1
    xy: Array  # (N, 2) m, in the machine's frame
    strength: Array  # (N,) relative to the mean press
    noise: Array  # (K,) standard deviation of a difference that nothing caused

    def __getitem__(self, rows: Any) -> Presses:
        return Presses(self.difference[rows], self.xy[rows], self.strength[rows], self.noise)

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True)
class Similarity:
    """machine = offset + scale * R(angle) * M * skin; M mirrors y where `mirrored`."""

    angle: float  # rad
    scale: float  # of the skin's true size to the bundle's metres
    offset: Array  # (2,) m, the skin's centre in the machine's frame
    mirrored: bool  # the electrodes are numbered the other way round than the bundle's

    @property
    def matrix(self) -> Array:
        c, s = np.cos(self.angle), np.sin(self.angle)
        rotation = np.array([[c, -s], [s, c]])
        return rotation @ np.diag([1.0, -1.0]) if self.mirrored else rotation

    def to_machine(self, skin: Array) -> Array:
        """(N, 2) m of the bundle's frame -> (N, 2) m of the machine's."""
        return np.asarray(self.offset + self.scale * skin @ self.matrix.T)

    def to_skin(self, machine: Array) -> Array:
        return np.asarray((machine - self.offset) @ self.matrix / self.scale)


def read_presses(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> Presses:
    """Read touched, untouched (n, k), xy (n, 2), optionally depth (n,), pattern (k, 4). Raises RegistrationError."""
    missing = [name for name in ("touched", "untouched", "xy") if name not in arrays]
    if missing:
        raise RegistrationError(
            f"no array {', '.join(missing)}: expected touched and untouched (n, {len(bundle.pattern)}), "
            "and xy (n, 2) in metres"
        )
    try:
        order = measurement_order(arrays, bundle)
    except InputError as why:
        raise RegistrationError(str(why)) from None
    touched, untouched, xy = (np.asarray(arrays[name]) for name in ("touched", "untouched", "xy"))
    for name in ("touched", "untouched", "xy", "depth"):
        if name in arrays and arrays[name].dtype.kind not in ("iufc" if "touched" in name else "iuf"):
            raise RegistrationError(f"{name} is {arrays[name].dtype}, expected numbers")
    if touched.shape != untouched.shape or touched.ndim != 2 or touched.shape[1] != len(order):
        raise RegistrationError(
            f"touched {touched.shape} and untouched {untouched.shape}: "
            f"expected both (n, {len(order)}), one row per press"
        )
    if xy.shape != (len(touched), 2) or not np.isfinite(xy).all():
        raise RegistrationError(f"xy {xy.shape}: expected ({len(touched)}, 2), metres, all finite")
    before = np.abs(untouched[:, order]).astype(float)
    if not (before > 0).all():
        raise RegistrationError("untouched holds values that are not above 0: leave those presses out")
    difference = np.abs(touched[:, order]) / before - 1
    if not np.isfinite(difference).all():
        raise RegistrationError("touched holds values that are not finite: leave those presses out")
    return Presses(difference, xy.astype(float), _strength(arrays, difference), noise_of_references(before))


def part(arrays: Mapping[str, NDArray[Any]], rows: slice) -> dict[str, NDArray[Any]]:
    """Some of the presses."""
    return {name: a[rows] if name in ("touched", "untouched", "xy", "depth") else a for name, a in arrays.items()}


def _strength(arrays: Mapping[str, NDArray[Any]], difference: Array) -> Array:
    """How strong each press is: the mean change by presses of its depth; 1 where depths are unknown or all differ."""
    depth = np.asarray(arrays.get("depth", np.zeros(len(difference))))
    if depth.shape != (len(difference),):
        raise RegistrationError(f"depth {depth.shape}: expected ({len(difference)},), metres")
    kinds, kind = np.unique(np.round(depth, 5), return_inverse=True)
    if len(kinds) > MOST_DEPTHS:
        return np.ones(len(difference))
    change = np.abs(difference).mean(axis=1)
    of_kind = np.array([change[kind == k].mean() for k in range(len(kinds))])
    return np.asarray(of_kind[kind] / change.mean())


def sensitivities(bundle: Bundle, blur: float) -> Array:
    """(K, h, w) the sensitivities averaged over a press `blur` pixels wide; no singular points at electrodes."""
    m = bundle.matrices
    inside = m.inside.astype(float)
    weight = np.maximum(ndimage.gaussian_filter(inside, blur), 0.2)
    found = []
    for row in m.jacobian.astype(float).reshape(-1, *m.inside.shape):
        limit = np.percentile(np.abs(row), 98)
        found.append(ndimage.gaussian_filter(np.clip(row, -limit, limit) * inside, blur) / weight)
    return np.array(found)


def sample(fields: Array, points: Array, half_width_m: float) -> Array:
    """Values (N, K) of fields (K, h, w) at (N, 2) points [m] of the skin's frame; the edge's value outside."""
    h, w = fields.shape[1:]
    x = np.clip((points[:, 0] / half_width_m + 1) * w / 2 - 0.5, 0, w - 1)
    y = np.clip((points[:, 1] / half_width_m + 1) * h / 2 - 0.5, 0, h - 1)
    left, low = np.minimum(x.astype(int), w - 2), np.minimum(y.astype(int), h - 2)
    right, up = x - left, y - low
    lower = (1 - right) * fields[:, low, left] + right * fields[:, low, left + 1]
    upper = (1 - right) * fields[:, low + 1, left] + right * fields[:, low + 1, left + 1]
    return np.asarray(((1 - up) * lower + up * upper).T)


def half_width(bundle: Bundle) -> float:
    """Half the side of the bundle's image, in its metres."""
    return 0.5 * bundle.image_size * bundle.metres_per_pixel


def register(presses: Presses, bundle: Bundle) -> tuple[Similarity, float]:
    """The similarity, and the share of the measurements' variance that it explains with one gain per measurement.

    Raises RegistrationError for too few presses.
    """
    if len(presses) < FEWEST:
        raise RegistrationError(f"{len(presses)} presses: at least {FEWEST}, spread over the skin, are needed")
    fields, width = sensitivities(bundle, PRESS_BLUR), half_width(bundle)
    y = presses.difference / np.sqrt((presses.difference**2).mean(axis=0))

    def unexplained(parameters: Array, mirrored: bool) -> float:
        similarity = Similarity(parameters[0], float(np.exp(parameters[1])), parameters[2:], mirrored)
        x = sample(fields, similarity.to_skin(presses.xy), width) * presses.strength[:, None]
        gain = (x * y).sum(axis=0) / np.maximum((x * x).sum(axis=0), 1e-30)
        return float(((y - gain * x) ** 2).mean())

    centre = 0.5 * (presses.xy.min(axis=0) + presses.xy.max(axis=0))
    starts = [
        (unexplained(np.array([angle, 0.0, *centre]), mirrored), angle, mirrored)
        for mirrored in (False, True)
        for angle in np.radians(np.arange(0, 360, 10))
    ]
    _, angle, mirrored = min(starts)
    start = np.array([angle, 0.0, *centre])
    steps = np.diag([0.1, 0.1, 0.06 * width, 0.06 * width])
    simplex = np.vstack([start, start + steps])
    best = optimize.minimize(
        unexplained, start, (mirrored,), "Nelder-Mead", options={"initial_simplex": simplex, "maxiter": 300}
    )
    found = best.x
    turn = float((found[0] + np.pi) % (2 * np.pi) - np.pi)
    return Similarity(turn, float(np.exp(found[1])), np.asarray(found[2:]), mirrored), 1 - float(best.fun)
