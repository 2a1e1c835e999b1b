"""npz archives that somebody else may have made (numpy only).

The sizes that an archive declares are added up and checked before anything is unpacked, nothing is unpacked beyond
them, and an array's header is compared with its size before anything is allocated. No pickled object is ever read.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from models.files import FileError, open_file

MAX_NPZ = 512 * 1024 * 1024
"""Bytes of an npz file, packed, and of its arrays unpacked."""
RATIO, SMALL = 100, 32 * 1024 * 1024
"""An archive may unpack to SMALL bytes, or to RATIO times its own size: measurements never pack so well."""
MAX_ARRAYS = 256
MAX_DIMENSIONS = 8


def read_npz(path: str | os.PathLike[str], most: int = MAX_NPZ) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file, `most` bytes of them at most. Raises FileError."""
    with open_file(path, most) as file:
        return npz(file, str(path), most)


def npz(file: BinaryIO, name: str, most: int = MAX_NPZ) -> dict[str, NDArray[Any]]:
    """All arrays of an open file; `name` is for errors."""
    try:
        if file.read(6) == b"\x93NUMPY":
            raise FileError(f"{name} holds one bare array, expected named ones: numpy.savez(path, name=array)")
        packed = file.seek(0, io.SEEK_END)
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            _check_sizes(entries, packed, name, most)
            if entries and not any(entry.filename.endswith(".npy") for entry in entries):
                held = ", ".join(repr(entry.filename[:40]) for entry in entries[:3])
                raise FileError(f"{name} is a zip of {held}, expected an npz (numpy.savez): unpack it, or save as csv")
            return {entry.filename.removesuffix(".npy"): _array(archive, entry, name) for entry in entries}
    except FileError:
        raise
    except Exception:  # zipfile, zlib, struct and numpy each raise their own: all mean a damaged file, or another kind
        raise FileError(
            f"{name} is no npz of plain arrays (numpy.savez): found something else, a damaged file, or object arrays"
        ) from None


def _check_sizes(entries: list[zipfile.ZipInfo], packed: int, name: str, most: int) -> None:
    unpacked = sum(entry.file_size for entry in entries)
    allowed = min(most, max(SMALL, RATIO * packed))
    if unpacked > allowed:
        raise FileError(
            f"{name}: its {packed} bytes unpack to {unpacked}, expected at most {allowed}: no measurements pack so well"
        )
    if len(entries) > MAX_ARRAYS:
        raise FileError(f"{name}: found {len(entries)} arrays, expected at most {MAX_ARRAYS}")
    for entry in entries:
        # Others than numpy's own two unpack whole blocks at once, whatever size the archive declares.
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileError(f"{name}: {entry.filename!r} is packed by method {entry.compress_type}, expected deflate")


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> NDArray[Any]:
    with archive.open(entry) as member:
        return plain_array(member, entry.file_size, f"{name}: array {entry.filename!r}")


def plain_array(member: IO[bytes], length: int, name: str) -> NDArray[Any]:
    """One array as numpy.save writes it, of `length` bytes with its header, which is compared with them before anything
    is allocated. `name` is for errors. Raises FileError, and ValueError, KeyError or EOFError where it is damaged.
    """
    version = np.lib.format.read_magic(member)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, fortran, dtype = read(member)
    if dtype.kind not in "biufcU" or dtype.hasobject:
        raise FileError(f"{name} is {dtype}, expected numbers")
    if len(shape) > MAX_DIMENSIONS or any(n < 0 for n in shape):
        raise ValueError(shape)
    size, left = dtype.itemsize * math.prod(shape), length - member.tell()
    if size != left or math.prod(n or 1 for n in shape) > MAX_NPZ:
        raise FileError(f"{name} of shape {shape} has {left} bytes, expected {size}")
    data = member.read()
    if len(data) != size:
        raise ValueError(len(data))
    if not dtype.itemsize:  # an empty text
        return np.zeros(shape, dtype)
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order="F" if fortran else "C")
