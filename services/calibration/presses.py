"""Files of presses at known places: read, checked, and put into one order whatever order they stand in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.errors import EitskinError
from services.estimation.initialisation.baseline import noise_of_references
from services.recordings.npz_file import delta_unit
from services.rows.columns import read_columns
from services.rows.order import InputError

Array = NDArray[np.float64]

PER_PRESS = ("touched", "untouched", "delta", "xy", "depth", "force")
MOST_MISSING = 0.1
"""Share of the presses that a measurement may be missing in; one that is missing in more is left out altogether."""
SAME_PLACE_M = 1e-4
MOST_KINDS = 8
LEAST_STRENGTH = 0.05


class RegistrationError(EitskinError, ValueError):
    """The presses cannot be registered; says what was found, what was expected and what to do."""


@dataclass(frozen=True)
class Presses:
    """N presses at known places. K measurements, in the bundle's order."""

    difference: Array  # (N, K) as the services form it: |Z| / |Z0| - 1, or the bundle's own normalisation
    xy: Array  # (N, 2) m, in the machine's frame
    strength: Array  # (N,) relative to the mean press
    noise: Array  # (K,) standard deviation of a difference that nothing caused
    measured: NDArray[np.bool_]  # (K,) which measurements were there; the others are 0
    value: Array | None = None  # (N,) how deep [m] or how hard [N], where the file says
    quantity: str = ""  # "indentation_m" or "force_n": what `value` is
    from_delta: bool = False
    unit: float = 1.0  # what `delta` was multiplied by
    left_out: int = 0  # presses of the file that could not be used
    understood: str = ""  # what of the file is not as documented, and was read all the same

    def __getitem__(self, rows: Any) -> Presses:
        value = None if self.value is None else self.value[rows]
        own = {"difference": self.difference[rows], "xy": self.xy[rows], "strength": self.strength[rows]}
        return replace(self, value=value, **own)

    def __len__(self) -> int:
        return len(self.xy)


def read_presses(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> Presses:
    """From touched and untouched (n, k), or delta (n, k); xy (n, 2); optionally depth (n,) [m] or force (n,) [N], and
    pattern (k, 4). Raises RegistrationError.

    The presses come out in an order of their own, so that nothing depends on the file's.
    """
    k = len(bundle.pattern)
    signal = ("touched", "untouched") if "touched" in arrays or "delta" not in arrays else ("delta",)
    missing = [name for name in (*signal, "xy") if name not in arrays]
    if missing:
        raise RegistrationError(
            f"no array {', '.join(missing)}: expected touched and untouched (n, {k}), or delta (n, {k}), touched less "
            "untouched in any unit; and xy (n, 2) in metres"
        )
    try:
        arrays, understood = read_columns(arrays, bundle)
    except InputError as why:
        raise RegistrationError(str(why)) from None
    values = {name: np.asarray(arrays[name]) for name in PER_PRESS if name in arrays}
    n = _count(values, signal, k)
    xy = values["xy"]
    value, quantity = _pressed(values, n)
    with np.errstate(all="ignore"):
        if signal == ("delta",):
            unit = _unit(values["delta"])
            difference, before = values["delta"].astype(float) * unit, None
            if bundle.matrices.normalisation == "model":
                difference *= bundle.z0.mean() / bundle.z0
        else:
            unit, before = 1.0, np.abs(values["untouched"]).astype(float)
            difference = _difference(np.abs(values["touched"]).astype(float), before, bundle)
    rows, measured = usable(difference, xy)
    difference, xy = np.where(measured, difference, 0.0)[rows], xy[rows].astype(float)
    noise = _noise(difference, None if before is None else before[rows], measured)
    value = None if value is None else value[rows]
    sequence = np.lexsort((*difference.T[:4], xy[:, 1], xy[:, 0]))
    left_out = n - len(rows)
    strength = _strength(difference, value)
    made = Presses(difference, xy, strength, noise, measured, value, quantity, signal == ("delta",), unit, left_out)
    return replace(made[sequence], understood=understood)


def _count(values: Mapping[str, NDArray[Any]], signal: tuple[str, ...], k: int) -> int:
    """How many presses the arrays have. Raises RegistrationError where they are not numbers, or disagree."""
    for name, array in values.items():
        if array.dtype.kind not in ("iufc" if name in ("touched", "untouched") else "iuf"):
            raise RegistrationError(f"{name} is {array.dtype}, expected numbers")
    shapes = [values[name].shape for name in signal]
    if len(set(shapes)) > 1 or len(shapes[0]) != 2 or shapes[0][1] != k:
        found = " and ".join(f"{name} {shape}" for name, shape in zip(signal, shapes, strict=True))
        raise RegistrationError(f"{found}: expected (n, {k}), one row per press")
    n = int(shapes[0][0])
    if values["xy"].shape != (n, 2):
        raise RegistrationError(f"xy {values['xy'].shape}: expected ({n}, 2), metres")
    return n


def part(arrays: Mapping[str, NDArray[Any]], rows: Any) -> dict[str, NDArray[Any]]:
    """The same arrays with some of their presses."""
    return {name: a[rows] if name in PER_PRESS else a for name, a in arrays.items()}


def usable(difference: Array, xy: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The rows of the presses that can be used, and which measurements (K,): what is not finite is left out.

    difference (n, K), xy (n, 2) as the file has them. Raises RegistrationError where too little is left.
    """
    finite = np.isfinite(difference)
    rows = np.isfinite(xy).all(axis=1) & (finite.mean(axis=1) >= 0.5)
    changes = np.ptp(np.where(finite, difference, 0.0), axis=0) > 0
    measured = changes & (finite[rows].mean(axis=0) >= 1 - MOST_MISSING if rows.any() else False)
    k = difference.shape[1]
    if measured.sum() < k / 2:
        raise RegistrationError(
            f"{int(measured.sum())} of {k} measurements are finite, with an untouched value above 0, and change from "
            f"press to press; expected at least {(k + 1) // 2}: check the cable, the electrodes and the file"
        )
    rows &= finite[:, measured].all(axis=1)
    return np.flatnonzero(rows), measured


def radius_of(xy: Array) -> float:
    """From the middle of the bounding box of places (N, 2) to the farthest of them, in their unit; above 0."""
    return max(float(np.linalg.norm(xy - 0.5 * (xy.min(axis=0) + xy.max(axis=0)), axis=1).max()), 1e-9)


def evenly(n: int, most: int) -> NDArray[np.intp]:
    """At most `most` of n rows, evenly among them."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))


def folds_of(xy: Array, count: int) -> NDArray[np.intp]:
    """(N,) in which of `count` parts each press is left out: presses at one place are left out together."""
    places, at = np.unique(np.round(xy / SAME_PLACE_M), axis=0, return_inverse=True)
    dealt = np.random.default_rng(5).permutation(len(places)) % count
    return np.asarray(dealt[at.ravel()])


def _difference(after: Array, before: Array, bundle: Bundle) -> Array:
    """(n, K) as the services form it, of |Z| touched and untouched (n, K); NaN where there was no untouched value. The
    bundle's normalisation "model" divides by its own |Z0|, in the unit that the untouched values have.
    """
    before = np.where(np.isfinite(before) & (before > 0), before, np.nan)
    if bundle.matrices.normalisation == "measured":
        return np.asarray(after / before - 1)
    gain = np.nanmedian(before / bundle.z0, axis=1, keepdims=True)
    return np.asarray((after - before) / (gain * bundle.z0))


def _unit(delta: NDArray[Any]) -> float:
    """What `delta` (n, K) is multiplied by, since nobody says its unit."""
    try:
        return delta_unit(delta)
    except InputError as why:
        raise RegistrationError(str(why)) from None


def _pressed(values: Mapping[str, NDArray[Any]], n: int) -> tuple[Array | None, str]:
    """How hard or how deep each press was, where the file says so in numbers that differ."""
    for name, quantity, unit in (("force", "force_n", "newtons"), ("depth", "indentation_m", "metres")):
        if name in values:
            if values[name].shape != (n,):
                raise RegistrationError(f"{name} {values[name].shape}: expected ({n},), {unit}")
            if np.isfinite(values[name]).all():
                return values[name].astype(float), quantity
    return None, ""


def _noise(difference: Array, before: Array | None, measured: NDArray[np.bool_]) -> Array:
    """From untouched scans that differ; else, an upper bound, from what the presses themselves leave unexplained."""
    if before is not None and len(np.unique(np.nan_to_num(before), axis=0)) > 1:
        return np.where(measured, noise_of_references(before), 1.0)
    n = len(difference)
    few = max(1, min(n, int(measured.sum())) // 2)
    scale = np.maximum(np.sqrt((difference**2).mean(axis=0)), 1e-30)
    u, s, v = np.linalg.svd(difference / scale, full_matrices=False)
    left = difference / scale - (u[:, :few] * s[:few]) @ v[:few]
    level = scale * np.sqrt((left**2).mean(axis=0) * n / max(n - few, 1))
    return np.where(measured, np.maximum(level, 1e-9), 1.0)


def _strength(difference: Array, value: Array | None) -> Array:
    """How strong each press is beside the mean one, from how deep or hard it was: the mean change by presses of its
    kind, or, where all differ, what a parabola through the changes says.
    """
    change = np.abs(difference).mean(axis=1)
    n = len(change)
    if value is None or not n:
        return np.ones(n)
    kinds, kind = np.unique(np.round(value, 5), return_inverse=True)
    if len(kinds) <= min(MOST_KINDS, n // 3):
        expected = np.array([change[kind == k].mean() for k in range(len(kinds))])[kind]
    elif n > 3 * MOST_KINDS:
        x = (value - value.mean()) / max(float(value.std()), 1e-30)
        expected = np.polynomial.Polynomial.fit(x, change, 2)(x)
    else:
        return np.ones(n)
    return np.asarray(np.maximum(expected / change.mean(), LEAST_STRENGTH))
