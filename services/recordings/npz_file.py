"""Files of measurements, checked: in which order their rows are frames, and whether these follow each other in time.

services/rows/ says which of their arrays and columns are what.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.files import FileError
from services.estimation.initialisation.baseline import alike
from services.rows.columns import AS_DOCUMENTED, ReadingOptions, read_columns
from services.rows.files import read_arrays
from services.rows.order import ORDERS, InputError

Array = NDArray[np.float64]

LEAST = 1e-60
"""|Z| below this is no measurement, in whatever unit."""
DELTA_LEVEL = 0.02
"""Root mean square of the relative changes that differences in unknown units are taken for."""
UNIT_UNKNOWN = "not said: `delta` is taken as large as touches usually are, so no force is given"
TARE_ROWS = 64
"""Rows of `reference` that come first as frames, from which the noise is found: those most alike, in whatever order the
rows stand.
"""


@dataclass(frozen=True)
class Input:
    """What a file gives. N rows of K measurements."""

    measurements: NDArray[Any]  # (N, K) real or complex
    untouched: Array | None  # (M, K) |Z|
    reference: Array | None  # (N, K) |Z|
    understood: str = ""  # what of the file is not as documented, and was read all the same
    unit: str = "any: only ratios to the untouched values count"

    @property
    def separate(self) -> bool:
        """Whether no row follows the one before it in time: each has an untouched scan of its own."""
        return self.reference is not None


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of a file. Raises InputError where it is damaged, too large, holds objects, or is of no known kind."""
    try:
        return read_arrays(path)
    except FileError as why:
        raise InputError(str(why)) from None


def reading_options(columns: str, pattern: str, untouched: str) -> ReadingOptions:
    """What the options of these names say. Raises InputError."""
    order: str | NDArray[Any] = pattern
    if pattern and pattern not in ORDERS:
        if not Path(pattern).exists():
            raise InputError(f"--pattern: found {pattern!r}, expected a file, or one of {', '.join(ORDERS)}")
        order = _one_of(Path(pattern), ("pattern", "measurements"))
    if not untouched or untouched.isdecimal():
        return ReadingOptions(columns, order, int(untouched[:9] or 0))
    return ReadingOptions(columns, order, _one_of(Path(untouched), ("untouched", "measurements", "reference")))


def _one_of(path: Path, names: tuple[str, ...]) -> NDArray[Any]:
    """The first of these arrays that a file has, or its only one."""
    arrays = load_npz(path)
    name = next((name for name in names if name in arrays), None if len(arrays) > 1 else next(iter(arrays)))
    if name is None:
        raise InputError(f"{path}: expected an array `{names[0]}`, found {_found(arrays)}")
    return arrays[name]


def read_scans(arrays: Mapping[str, NDArray[Any]], bundle: Bundle, options: ReadingOptions = AS_DOCUMENTED) -> Input:
    """The same as `read_input`, of files in other forms too (services/rows/columns.py), in the order of the bundle's
    measurements. It also reads files of presses (`touched` and `untouched`, a row of each for a press). Raises
    InputError.
    """
    arrays, understood = read_columns(arrays, bundle, options)
    unit = Input.unit
    if "delta" in arrays and "touched" not in arrays and "measurements" not in arrays:
        beside, unit = _beside_one(arrays, bundle)
        arrays = {**arrays, **beside}
    if "touched" in arrays and "measurements" not in arrays:
        arrays, more = _of_presses(arrays)
        understood = "; ".join(filter(None, (understood, more)))
    return replace(read_input(arrays, len(bundle.pattern)), understood=understood, unit=unit)


def read_file(path: Path, bundle: Bundle, options: ReadingOptions = AS_DOCUMENTED) -> Input:
    """The rows of a file. Raises InputError, which names it."""
    try:
        return read_scans(load_npz(path), bundle, options)
    except InputError as why:
        raise InputError(str(why) if str(path) in str(why) else f"{path}: {why}") from None


def _of_presses(arrays: Mapping[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], str]:
    rows = {"measurements": arrays["touched"]}
    if "untouched" not in arrays:
        return {**arrays, **rows}, ""
    if len(arrays["untouched"]) == len(arrays["touched"]):
        return rows | {"reference": arrays["untouched"]}, ""
    return rows | {"untouched": arrays["untouched"]}, "`untouched` has no row for each of `touched`: all are of before"


def read_input(arrays: Mapping[str, NDArray[Any]], k: int) -> Input:
    """Checks keys and shapes for a skin of `k` measurements. Raises InputError."""
    if "measurements" not in arrays:
        raise InputError(f"no array `measurements` of shape (n, {k}); found {_found(arrays)}")
    if ("untouched" in arrays) == ("reference" in arrays):
        both = "both" if "untouched" in arrays else "neither"
        raise InputError(
            f"expected either `untouched` (m, {k}) or `reference` (n, {k}), found {both}; arrays: {_found(arrays)}"
            + ("" if both == "both" else "; --untouched says which rows, or which file, they are")
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


def _beside_one(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> tuple[dict[str, NDArray[Any]], str]:
    """Measurements and their references of a file that has differences alone: in the unit that the skin was registered
    in, else so that they are as large as touches are. Every reference is the same, which says nothing of noise.
    """
    k = len(bundle.pattern)
    delta = _matrix(arrays, "delta", k)
    if delta.dtype.kind == "c":
        raise InputError("`delta` is complex, expected differences of amplitudes: give `measurements` with `untouched`")
    if more := {"untouched", "reference"} & arrays.keys():
        raise InputError(f"`delta` stands alone, found `{min(more)}` beside it: give `measurements` instead of `delta`")
    known = bundle.manifest.get("registration", {})
    unit, said = known.get("delta_unit") if known.get("from_delta") else None, "as the skin was registered"
    if unit is None:
        unit, said = delta_unit(delta, known.get("typical_difference", DELTA_LEVEL)), UNIT_UNKNOWN
    untouched = np.ones(k) if bundle.matrices.normalisation == "measured" else bundle.z0
    changed = np.maximum(untouched + delta * float(unit) * untouched.mean(), 1e-3 * untouched)
    return {"measurements": changed, "reference": np.broadcast_to(untouched, delta.shape).copy()}, said


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
    return a if a.dtype.kind in "fc" else a.astype(float)  # the least integer has no amplitude among its kind


def _found(arrays: Mapping[str, NDArray[Any]]) -> str:
    return ", ".join(f"{name} {a.shape}" for name, a in arrays.items()) or "no arrays"
