"""Arrays of a file by their names: npz, npy, MATLAB's mat, HDF5, csv; each of them may be gzipped.

The first bytes say which it is, not the name. What is unpacked is bounded before it is unpacked.
"""

from __future__ import annotations

import codecs
import contextlib
import gzip
import importlib
import io
import math
import os
import re
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.files import FileError, open_file, read_bytes
from models.npz import MAX_NPZ, RATIO, SMALL, npz, plain_array
from services.rows.table import parse_table

Arrays = dict[str, NDArray[Any]]

GZIP, ZIP, NPY, HDF5 = b"\x1f\x8b", b"PK", b"\x93NUMPY", b"\x89HDF\r\n\x1a\n"
HDF5_AT = (0, 512)  # MATLAB puts a text of its own before it
NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f]")
KINDS = "npz, npy, mat, HDF5 or csv, gzipped or not"
MAT_NUMBERS = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}


def read_arrays(path: str | os.PathLike[str]) -> Arrays:
    """All arrays of numbers in a file. Raises FileError. Of one array that has no name, the name is `measurements`."""
    name = str(path)
    with open_file(path, MAX_NPZ) as file:
        if file.read(len(ZIP)) == ZIP:  # whose members are read one by one
            file.seek(0)
            return npz(file, name)
    data = read_bytes(path, MAX_NPZ)
    if data.startswith(GZIP):
        name, data = name.removesuffix(".gz"), _unpacked(data, name)
    if data.startswith(ZIP):
        return npz(io.BytesIO(data), name)
    if data.startswith(NPY):
        file = io.BytesIO(data)
        return _whole(name, "npy", lambda: {"measurements": plain_array(file, len(data), f"{name}: its array")})
    if any(data[at:].startswith(HDF5) for at in HDF5_AT):
        return _whole(name, "HDF5", lambda: _of_hdf5(data, name))
    if data.startswith(b"MATLAB") or name.lower().endswith(".mat"):
        return _whole(name, "mat", lambda: _of_mat(data, name))
    return parse_table(_text(data, name), name)


def _text(data: bytes, name: str) -> str:
    """Of UTF-8 or UTF-16, or of an older Windows, whose signs of units stand in the names alone."""
    with contextlib.suppress(UnicodeDecodeError):
        return data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    if NO_TEXT.search(data):
        raise FileError(f"{name}: found neither text nor a known kind of file, expected {KINDS}")
    return data.decode("latin-1")


def _whole(name: str, kind: str, read: Callable[[], Arrays]) -> Arrays:
    """What a reader of another library gives; whatever it raises means a damaged file."""
    try:
        return read()
    except FileError:
        raise
    except Exception:
        raise FileError(f"{name} begins like {kind}, but is damaged or cut: expected {KINDS}") from None


def _unpacked(data: bytes, name: str) -> bytes:
    most = min(MAX_NPZ, max(SMALL, RATIO * len(data)))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            found = file.read(most + 1)
    except (OSError, EOFError, zlib.error):
        raise FileError(f"{name} is gzipped, but damaged or cut") from None
    if len(found) > most:
        raise FileError(f"{name}: its {len(data)} bytes unpack to more than {most}: no measurements pack so well")
    return found


def _of_mat(data: bytes, name: str) -> Arrays:
    """MATLAB's versions 4 to 7."""
    from scipy.io import loadmat, whosmat

    held = [(key, shape, kind) for key, shape, kind in whosmat(io.BytesIO(data))]
    _bounded(sum(math.prod(shape) for _, shape, _ in held), name)
    numbers = [key for key, _, kind in held if kind in MAT_NUMBERS]
    if not numbers:
        kinds = ", ".join(f"{key} ({kind})" for key, _, kind in held) or "nothing"
        raise FileError(f"{name}: found {kinds}, expected arrays of numbers: save each by a name of its own")
    found = loadmat(io.BytesIO(data), variable_names=numbers)
    return {key: np.asarray(found[key]) for key in numbers}


def _of_hdf5(data: bytes, name: str) -> Arrays:
    try:
        h5py = importlib.import_module("h5py")
    except ImportError:
        raise FileError(
            f"{name} is HDF5 (MATLAB's v7.3), which needs the Python package h5py: `make venv EXTRAS=hdf5`, or save it "
            "in MATLAB with '-v7'"
        ) from None
    found: Arrays = {}
    with h5py.File(io.BytesIO(data), "r") as file:
        own = {key: file[key] for key in file if isinstance(file.get(key, getlink=True), h5py.HardLink)}
        numbers = {key: each for key, each in own.items() if isinstance(each, h5py.Dataset) and _holds_numbers(each)}
        _bounded(sum(each.size for each in numbers.values()), name)
        for key, each in numbers.items():
            values = np.asarray(each)
            if values.dtype.names:
                values = values["real"] + 1j * values["imag"]
            found[key] = values.T if "MATLAB_class" in each.attrs else values  # which counts columns first
    if not found:
        raise FileError(f"{name}: found no arrays of numbers at its top: save each by a name of its own")
    return found


def _holds_numbers(array: Any) -> bool:
    """Whether a dataset is one of numbers in this very file; MATLAB keeps text and the shape of an empty one so."""
    if array.shape is None or array.external or array.is_virtual or "MATLAB_empty" in array.attrs:
        return False
    text = array.attrs.get("MATLAB_class") in (b"char", "char")
    return not text and (array.dtype.kind in "biufc" or set(array.dtype.names or ()) == {"real", "imag"})


def _bounded(values: int, name: str) -> None:
    if values > MAX_NPZ / 8:
        raise FileError(f"{name}: found {values} numbers, expected at most {MAX_NPZ // 8}")
