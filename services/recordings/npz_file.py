"""Files of measurements (npz). Only this module reads and checks them. It says in which order their rows are frames,
and whether these follow each other in time.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models import npz
from models.bundle import Bundle
from models.files import FileError
from protocol.errors import EitskinError
from services.estimation.first.references import alike

Array = NDArray[np.float64]

LEAST = 1e-60
"""|Z| below this is no measurement, in whatever unit."""
DELTA_LEVEL = 0.02
"""Root mean square of the relative changes that differences in unknown units are taken for."""
TARE_ROWS = 64
"""Rows of `reference` that come first as frames, from which the noise is found: those most alike, in whatever order the
rows stand.
"""


class InputError(EitskinError, ValueError):
    """The file's arrays are not what is needed; says which, what was found and what is expected."""


@dataclass(frozen=True)
class Input:
    """What a file gives. N rows of K measurements."""

    measurements: NDArray[Any]  # (N, K) real or complex
    untouched: Array | None  # (M, K) |Z|
    reference: Array | None  # (N, K) |Z|

    @property
    def separate(self) -> bool:
        """Whether no row follows the one before it in time: each has an untouched scan of its own."""
        return self.reference is not None


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file. Raises InputError where it is none, is damaged, too large, or holds objects."""
    try:
        return npz.read_npz(path)
    except FileError as why:
        raise InputError(str(why)) from None


def read_scans(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> Input:
    """The same as `read_input`, with columns in the order of the bundle's measurements. It also reads files of presses
    (`touched` and `untouched`, a row of each for a press). Raises InputError.
    """
    order = measurement_order(arrays, bundle)
    if "delta" in arrays and "touched" not in arrays and "measurements" not in arrays:
        arrays = {**arrays, **_beside_one(arrays, bundle)}
    if "touched" in arrays and "measurements" not in arrays:
        own = {"reference": arrays["untouched"]} if "untouched" in arrays else {}
        arrays = {"measurements": arrays["touched"], **own}
    data = read_input(arrays, len(bundle.pattern))
    untouched, reference = (None if a is None else a[:, order] for a in (data.untouched, data.reference))
    return Input(data.measurements[:, order], untouched, reference)


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


def _beside_one(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> dict[str, NDArray[Any]]:
    """Measurements and their references of a file that has differences alone: in the unit that the skin was registered
    in, else so that they are as large as touches are. Every reference is the same, which says nothing of noise.
    """
    k = len(bundle.pattern)
    delta = _matrix(arrays, "delta", k)
    known = bundle.manifest.get("registration", {})
    unit = known.get("delta_unit") if known.get("from_delta") else None
    unit = delta_unit(delta, known.get("typical_difference", DELTA_LEVEL)) if unit is None else float(unit)
    untouched = np.ones(k) if bundle.matrices.normalisation == "measured" else _in_file_order(bundle, arrays)
    changed = np.maximum(untouched + delta * unit * untouched.mean(), 1e-3 * untouched)
    return {"measurements": changed, "reference": np.broadcast_to(untouched, delta.shape).copy()}


def _in_file_order(bundle: Bundle, arrays: Mapping[str, NDArray[Any]]) -> Array:
    z0 = np.zeros(len(bundle.z0))
    z0[measurement_order(arrays, bundle)] = bundle.z0
    return z0


def delta_unit(delta: NDArray[Any], level: float = DELTA_LEVEL) -> float:
    """What differences in any unit (n, k) are multiplied by to be relative changes of `level`. Raises InputError.

    Half of the rows are above it, so that a few wild ones say nothing.
    """
    finite = np.where(np.isfinite(delta), delta, np.nan).astype(float)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        largest = np.nanmax(np.abs(finite), initial=0.0)
        typical = largest * np.sqrt(np.nanmedian(np.nanmean((finite / (largest or 1.0)) ** 2, axis=1)))
    if not typical > 0:
        raise InputError("`delta` holds no differences other than 0")
    return float(level / typical)


def frames_of(data: Input) -> Iterator[tuple[NDArray[Any], str]]:
    """(values (K,), kind) of the rows as frames: `untouched` first; each row of `reference` before its own."""
    if data.untouched is not None:
        yield from ((row, "reference") for row in data.untouched)
        yield from ((row, "full") for row in data.measurements)
    elif data.reference is not None:
        yield from ((row, "reference") for row in data.reference[alike(data.reference, TARE_ROWS)])
        for before, row in zip(data.reference, data.measurements, strict=True):
            yield before, "reference"
            yield row, "full"


def measurement_order(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> NDArray[np.intp]:
    """The file's column of each measurement of the bundle. Raises InputError where one is not there."""
    if "pattern" not in arrays:
        return np.arange(len(bundle.pattern))
    theirs = arrays["pattern"]
    if theirs.ndim != 2 or theirs.shape[1] != 4 or theirs.dtype.kind not in "iu":
        raise InputError(
            f"`pattern` is {theirs.dtype} of shape {theirs.shape}, "
            "expected integers (k, 4): drive+, drive-, sense+, sense-"
        )
    places = {_key(row): at for at, row in reversed(list(enumerate(theirs.tolist())))}
    missing = [row for row in bundle.pattern.tolist() if _key(row) not in places]
    if missing or len(theirs) != len(bundle.pattern):
        detail = f", and lacks {missing[0]}" if missing else ""
        raise InputError(
            f"`pattern` has {len(theirs)} rows{detail}; the skin's bundle {bundle.name} measures "
            f"{len(bundle.pattern)} ({bundle.skin.get('pattern', 'custom')}): choose the skin that was measured"
        )
    return np.array([places[_key(row)] for row in bundle.pattern.tolist()])


def _key(row: list[int]) -> tuple[int, int, frozenset[int]]:
    """An amplitude has no sign, so the sense pair may be either way round. The drive pair may not: on a real board the
    two ways are two measurements."""
    return row[0], row[1], frozenset(row[2:])


def _amplitudes(arrays: Mapping[str, NDArray[Any]], name: str, k: int) -> Array:
    """|Z| (n, K), of which enough can be compared with: a baseline of fewer than half the measurements is none."""
    a: Array = np.abs(_matrix(arrays, name, k)).astype(float)
    a[a < LEAST] = 0.0  # the squares of so small numbers underflow
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
