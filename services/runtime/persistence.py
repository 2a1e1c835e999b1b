"""A stage's state, kept in the runtime folder, so that a killed process goes on where it stopped; states as plain
maps.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from models.files import check
from protocol.ages import BOOTTIME
from protocol.fields import FieldError, decode_array, encode_array
from protocol.frames import MAX_MESSAGE, read_map
from protocol.runtime import host_id, runtime_dir

LARGEST = MAX_MESSAGE
CHECKSUM = hashlib.sha256().digest_size
AHEAD_S = 1.0  # by how much a clock that is being set right may go back between two processes

log = logging.getLogger(__name__)


def save(process: str, skin: str, state: dict[str, Any]) -> str:
    """Keep a state, with its checksum before it; what a crash or a full disk leaves behind is the old one or the new
    one. Returns why it could not be kept; "" where it is.
    """
    name = f"{process}-{skin}.msgpack"
    fresh = f"{name}.{os.getpid()}"
    when = {"saved_unix_s": time.time(), "boot": host_id(), "saved_boot_s": time.clock_gettime(BOOTTIME)}
    packed: bytes = msgpack.packb({**when, "state": plain(state)})
    try:
        with _folder(create=True) as folder:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(fresh, dir_fd=folder)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            try:
                with os.fdopen(os.open(fresh, flags, 0o600, dir_fd=folder), "wb") as file:
                    file.write(hashlib.sha256(packed).digest() + packed)
                os.replace(fresh, name, src_dir_fd=folder, dst_dir_fd=folder)
            except OSError:
                with contextlib.suppress(OSError):
                    os.unlink(fresh, dir_fd=folder)
                raise
    except (OSError, ValueError) as why:
        said = getattr(why, "strerror", None) or why
        problem = f"the state could not be kept in {_place()} ({said}): after a crash there will be a new tare"
        log.warning("%s: %s", skin, problem)
        return problem
    return ""


def restore(process: str, skin: str) -> tuple[dict[str, Any], float] | None:
    """The kept state and its age [s]; None where there is none that can be read and believed."""
    name = f"{process}-{skin}.msgpack"
    try:
        with _folder() as folder:
            packed = _read(name, folder)
        if hashlib.sha256(packed[CHECKSUM:]).digest() != packed[:CHECKSUM]:
            raise ValueError("its checksum is not that of its content")
        kept = read_map(packed[CHECKSUM:], "the kept state")
        ahead = _ahead_s(kept)
        if not ahead <= AHEAD_S:
            raise ValueError(f"it is of {ahead:.0f} s from now: was the clock set back?")
        state = arrays(kept["state"])
        if not isinstance(state, dict):
            raise ValueError(f"found {type(state).__name__}, expected a map")
        return state, max(0.0, -ahead)
    except FileNotFoundError:
        return None
    except Exception as why:  # whatever is in the file, the service starts
        log.warning("%s: %s is no kept state (%s): starting without it", skin, _place() / name, why)
        return None


def _ahead_s(kept: dict[str, Any]) -> float:
    """How far from now it was saved. Within one boot no setting of the clock counts. Raises ValueError, KeyError."""
    if kept.get("boot") == host_id():
        return float(kept["saved_boot_s"]) - time.clock_gettime(BOOTTIME)
    return float(kept["saved_unix_s"]) - time.time()


def _place() -> Path:
    return runtime_dir() / "state"


@contextlib.contextmanager
def _folder(create: bool = False) -> Iterator[int]:
    """A descriptor of the folder of kept states, which must be ours and no link. Raises OSError, ValueError."""
    if create:
        _place().mkdir(mode=0o700, exist_ok=True)
    fd = os.open(_place(), os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        _check_owner(os.fstat(fd), "its folder")
        yield fd
    finally:
        os.close(fd)


def _read(name: str, folder: int) -> bytes:
    """A regular file of ours, no link. Raises OSError, ValueError, FileError."""
    fd = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    with os.fdopen(fd, "rb") as file:
        found = os.fstat(fd)
        check(found, name, LARGEST)
        _check_owner(found, "it")
        return file.read(LARGEST)


def _check_owner(found: os.stat_result, what: str) -> None:
    if found.st_uid != os.geteuid():
        raise ValueError(f"{what} belongs to user {found.st_uid}, expected {os.geteuid()} (us)")
    if found.st_mode & 0o022:
        raise ValueError(f"{what} has mode {stat.S_IMODE(found.st_mode):04o}: others can write it")


def plain(value: Any) -> Any:
    """Arrays to {dtype, shape, data} maps, numpy scalars to numbers, all the way down."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray):
        return encode_array(np.ascontiguousarray(value))
    return value.item() if isinstance(value, np.generic) else value


def arrays(value: Any) -> Any:
    """The other way. Raises ValueError for a map that looks like an array and is none."""
    if isinstance(value, dict):
        if value.keys() == {"dtype", "shape", "data"}:
            try:
                return decode_array(value)
            except FieldError as wrong:
                raise ValueError(f"found {wrong.found}, expected {wrong.expected}") from None
        return {key: arrays(inner) for key, inner in value.items()}
    return [arrays(inner) for inner in value] if isinstance(value, list) else value
