"""`skin import`: an npz of measurements as a recording, so that it replays through the stages like any other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from protocol.errors import EitskinError
from protocol.frames import pack
from protocol.whole_file import whole_file
from services.recordings import settings
from services.recordings.file_source import file_frame
from services.recordings.npz_file import frames_of, read_scans
from services.recordings.reconstruction import find_skin
from services.recordings.recording import RecordingError, RecordingWriter
from services.rows.columns import AS_DOCUMENTED, ReadingOptions
from services.rows.order import InputError
from services.runtime.config import SKIN_NAME
from services.runtime.stage import valid_for_s

ROWS_PER_CHUNK = 8
EPOCH_NS = 1_000_000_000_000_000_000
"""A file of measurements knows no time; its recording begins here (2001-09-09), so that importing is reproducible."""


class ImportRefused(EitskinError, ValueError):
    """The file cannot become a recording; says which array, what was found and what is expected."""


def import_arrays(
    arrays: Mapping[str, NDArray[Any]],
    source: Path,
    target: Path,
    skin: str,
    rate_hz: float,
    overwrite: bool = False,
    options: ReadingOptions = AS_DOCUMENTED,
) -> dict[str, Any]:
    """Writes `target`; the report's keys: file, frames, measurements, seconds, understood. Raises ImportRefused,
    RecordingError.

    A file with `touched` and `untouched` of equal shape holds presses: each gets its untouched frame just before it,
    and none follows another in time.
    """
    if not rate_hz > 0:
        raise ImportRefused(f"found --rate {rate_hz:g}, expected frames per second above 0")
    configured, bundle = find_skin(skin)
    skin = skin if SKIN_NAME.fullmatch(skin) else bundle.name  # a bundle given by its path
    try:
        data = read_scans(arrays, bundle, options)
    except InputError as error:
        raise ImportRefused(f"{source}: {error}") from None
    if not SKIN_NAME.fullmatch(configured.frame_id):
        configured = configured.model_copy(update={"frame_id": skin})
    carried = settings.text_of({skin: configured})
    metadata = {"origin": "import", "of": source.name, "skin": skin, settings.KEY: carried}
    step_ns, count = int(1e9 / rate_hz), 0
    if target.exists() and not overwrite:
        raise RecordingError(f"{target} is there already: choose another name, or say --overwrite")
    with whole_file(target) as part, RecordingWriter(part, metadata) as writer:
        for count, (values, kind) in enumerate(frames_of(data), start=1):
            now_ns = count * step_ns
            frame = file_frame(
                skin, str(bundle.skin.get("pattern", "custom")), count, values, kind, now_ns, data.separate
            )
            frame.valid_for_s, frame.board, frame.unit = valid_for_s(1 / rate_hz), source.name, "counts"
            frame.session, frame.seq = "0" * 16, count - 1
            writer.write(f"raw/{skin}", pack(frame).partition(b"\0")[2], EPOCH_NS + now_ns)
            if count % ROWS_PER_CHUNK == 0:
                writer.flush()
        writer.close()
        if writer.why:
            raise RecordingError(f"cannot write {target}: {writer.why}")
    report = {"file": str(target), "frames": count, "measurements": len(bundle.pattern), "seconds": count / rate_hz}
    return report | {"understood": data.understood}
