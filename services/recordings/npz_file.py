"""Files of measurements (npz): the one place that reads and checks them, and says in which order their rows are
frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import npz
from models.files import FileError

Array = NDArray[np.float64]

LEAST = 1e-60
"""|Z| below this is no measurement, in whatever unit."""
TARE_ROWS = 64
"""Rows of `reference` that come first as frames, from which the noise is found."""


class InputError(ValueError):
    """The file's arrays are not what is needed; says which, what was found and what is expected."""


@dataclass(frozen=True)
class Input:
    """What a file gives. N rows of K measurements."""

    measurements: NDArray[Any]  # (N, K) real or complex
    untouched: Array | None  # (M, K) |Z|
    reference: Array | None  # (N, K) |Z|


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file. Raises InputError where it is none, is damaged, too large, or holds objects."""
    try:
        return npz.read_npz(path)
    except FileError as why:
        raise InputError(str(why)) from None


def read_input(arrays: Mapping[str, NDArray[Any]], k: int) -> Input:
    """Checks keys and shapes for a skin of `k` measurements. Raises InputError."""
    if "measurements" not in arrays:
        raise InputError(f"no array `measurements` of shape (n, {k}); found {_found(arrays)}")
    if ("untouched" in arrays) == ("reference" in arrays):
        both = "both" if "untouched" in arrays else "neither"
        raise InputError(
            f"expected either `untouched` (m, {k}) or `reference` (n, {k}), found {both}; arrays: {_found(arrays)}"
        )
    measurements = _matrix(arrays, "measurements", k)
    if "untouched" in arrays:
        return Input(measurements, _amplitudes(arrays, "untouched", k), None)
    reference = _amplitudes(arrays, "reference", k)
    if len(reference) != len(measurements):
        raise InputError(
            f"`reference` has {len(reference)} rows, `measurements` {len(measurements)}: expected one each"
        )
    return Input(measurements, None, reference)


def frames_of(data: Input) -> Iterator[tuple[NDArray[Any], str]]:
    """(values (K,), kind) of the rows as frames: `untouched` first; each row of `reference` before its own."""
    if data.untouched is not None:
        yield from ((row, "reference") for row in data.untouched)
        yield from ((row, "full") for row in data.measurements)
    elif data.reference is not None:
        yield from ((row, "reference") for row in data.reference[:TARE_ROWS])
        for before, row in zip(data.reference, data.measurements, strict=True):
            yield before, "reference"
            yield row, "full"


def _amplitudes(arrays: Mapping[str, NDArray[Any]], name: str, k: int) -> Array:
    """|Z| (n, K), of which enough can be compared with: a baseline of fewer than half the measurements is none."""
    a: Array = np.abs(_matrix(arrays, name, k)).astype(float)
    a[a < LEAST] = 0.0  # squares of what is that small are nothing
    usable = int((np.isfinite(a) & (a > 0)).any(axis=0).sum())
    if usable < k / 2:
        raise InputError(
            f"`{name}` has finite values other than 0 in {usable} of {k} columns, expected at least {(k + 1) // 2}: "
            "check the cable and the electrodes"
        )
    return a


def _matrix(arrays: Mapping[str, NDArray[Any]], name: str, k: int) -> NDArray[Any]:
    a = arrays[name]
    if a.dtype.kind not in "iufc" or a.ndim != 2 or a.shape[1] != k or not len(a):
        raise InputError(
            f"`{name}` is {a.dtype} of shape {a.shape}, expected numbers of shape (n, {k}) in the skin's pattern order"
        )
    if not np.isfinite(a).any():
        raise InputError(f"`{name}` holds no finite number")
    return a


def _found(arrays: Mapping[str, NDArray[Any]]) -> str:
    return ", ".join(f"{name} {a.shape}" for name, a in arrays.items()) or "no arrays"
