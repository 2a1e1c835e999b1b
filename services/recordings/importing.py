"""`skin import`: an npz of measurements as a recording, so that it replays through the stages like any other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import pack
from services.board.file_source import file_frame
from services.config import SKIN_NAME
from services.recordings.npz_file import InputError, frames_of, read_input
from services.recordings.reconstruction import find_skin
from services.recordings.recording import RecordingWriter
from services.stage import valid_for_s

ROWS_PER_CHUNK = 8
EPOCH_NS = 1_000_000_000_000_000_000
"""A file of measurements knows no time; its recording begins here (2001-09-09), so that importing is reproducible."""


class ImportRefused(ValueError):
    """The file cannot become a recording; says which array, what was found and what is expected."""


def import_arrays(
    arrays: Mapping[str, NDArray[Any]], source: Path, target: Path, skin: str, rate_hz: float, overwrite: bool = False
) -> dict[str, Any]:
    """Writes `target`; the report's keys: file, frames, measurements, seconds. Raises ImportRefused, RecordingError.

    A file with `touched` and `untouched` of equal shape holds presses: each gets its untouched frame just before it.
    """
    if not rate_hz > 0:
        raise ImportRefused(f"found --rate {rate_hz:g}, expected frames per second above 0")
    configured, bundle = find_skin(skin)
    skin = skin if SKIN_NAME.fullmatch(skin) else bundle.name  # a bundle given by its path
    order = measurement_order(arrays, bundle)
    try:
        if "touched" in arrays:
            arrays = {"measurements": arrays["touched"]} | (
                {"reference": arrays["untouched"]} if "untouched" in arrays else {}
            )
        data = read_input(arrays, len(bundle.pattern))
    except InputError as error:
        raise ImportRefused(f"{source}: {error}") from None
    metadata = {"origin": "import", "of": source.name, "bundle": configured.bundle, "skin": skin}
    step_ns, count = int(1e9 / rate_hz), 0
    with RecordingWriter(target, metadata, overwrite) as writer:
        for count, (values, kind) in enumerate(frames_of(data), start=1):
            now_ns = count * step_ns
            frame = file_frame(skin, str(bundle.skin.get("pattern", "custom")), count, values[order], kind, now_ns)
            frame.valid_for_s, frame.board, frame.unit = valid_for_s(1 / rate_hz), source.name, "counts"
            frame.session, frame.seq = "0" * 16, count - 1
            writer.write(f"raw/{skin}", pack(frame).partition(b"\0")[2], EPOCH_NS + now_ns)
            if count % ROWS_PER_CHUNK == 0:
                writer.flush()
    return {"file": str(target), "frames": count, "measurements": len(order), "seconds": count / rate_hz}


def measurement_order(arrays: Mapping[str, NDArray[Any]], bundle: Bundle) -> NDArray[np.intp]:
    """Where in the file each measurement of the bundle stands. Raises ImportRefused where one is not there."""
    if "pattern" not in arrays:
        return np.arange(len(bundle.pattern))
    theirs = arrays["pattern"]
    if theirs.ndim != 2 or theirs.shape[1] != 4 or theirs.dtype.kind not in "iu":
        raise ImportRefused(
            f"`pattern` is {theirs.dtype} of shape {theirs.shape}, "
            "expected integers (k, 4): drive+, drive-, sense+, sense-"
        )
    places = {_key(row): at for at, row in reversed(list(enumerate(theirs.tolist())))}
    missing = [row for row in bundle.pattern.tolist() if _key(row) not in places]
    if missing or len(theirs) != len(bundle.pattern):
        detail = f", and lacks {missing[0]}" if missing else ""
        raise ImportRefused(
            f"`pattern` has {len(theirs)} rows{detail}; the skin's bundle {bundle.name} measures "
            f"{len(bundle.pattern)} ({bundle.skin.get('pattern', 'custom')}): choose the skin that was measured"
        )
    return np.array([places[_key(row)] for row in bundle.pattern.tolist()])


def _key(row: list[int]) -> tuple[int, int, frozenset[int]]:
    """An amplitude has no sign, so the sense pair may be either way round. The drive pair may not: on a real board the
    two ways are two measurements."""
    return row[0], row[1], frozenset(row[2:])
