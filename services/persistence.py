"""A stage's state in the runtime folder, so that a process that was killed goes on where it stopped; and states as
plain maps.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from protocol.fields import Mismatch, decode_array, encode_array
from protocol.runtime import runtime_dir

LARGEST = 16 * 1024 * 1024

log = logging.getLogger(__name__)


def save(process: str, skin: str, state: dict[str, Any]) -> None:
    """Keep a state; what a crash leaves behind is the old one or the new one."""
    path = _file(process, skin)
    try:
        path.parent.mkdir(mode=0o700, exist_ok=True)
        fresh = path.with_suffix(f".{os.getpid()}")
        fresh.write_bytes(msgpack.packb({"saved_unix_s": time.time(), "state": plain(state)}))
        fresh.replace(path)
    except OSError as why:
        log.warning("%s: the state could not be kept (%s): after a crash there will be a new tare", skin, why)


def restore(process: str, skin: str) -> tuple[dict[str, Any], float] | None:
    """The kept state and its age [s]; None where there is none that can be read."""
    path = _file(process, skin)
    try:
        packed = path.read_bytes()
        if len(packed) > LARGEST:
            raise ValueError(f"{len(packed)} bytes")
        kept = msgpack.unpackb(packed)
        return arrays(kept["state"]), max(0.0, time.time() - float(kept["saved_unix_s"]))
    except FileNotFoundError:
        return None
    except Exception as why:  # whatever is in the file, the service starts
        log.warning("%s: %s is no kept state (%s): starting without it", skin, path, why)
        return None


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
            except Mismatch as wrong:
                raise ValueError(f"found {wrong.found}, expected {wrong.expected}") from None
        return {key: arrays(inner) for key, inner in value.items()}
    return [arrays(inner) for inner in value] if isinstance(value, list) else value


def _file(process: str, skin: str) -> Path:
    return runtime_dir() / "state" / f"{process}-{skin}.msgpack"


def shaped(values: Any, shape: tuple[int, ...], finite: bool = True) -> NDArray[np.float64]:
    """The array of a saved state, checked. Raises ValueError."""
    found = np.array(values, dtype=np.float64)
    if found.shape != shape or (finite and not np.isfinite(found).all()):
        raise ValueError(f"found an array of shape {found.shape}, expected {shape}, finite")
    return found
