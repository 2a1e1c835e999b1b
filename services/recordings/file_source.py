"""Frames from files: a recording at its own speed, the rows of an npz file. (`skin replay` is the lossless way.)"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.errors import in_words
from protocol.frames import FrameError, RawFrame, unpack
from protocol.pause import pause
from services.board.source import POLL_S, Source
from services.recordings.npz_file import frames_of, read_file
from services.rows.order import InputError
from services.runtime.stage import SEPARATE, valid_for_s

log = logging.getLogger(__name__)

FILE_RATE_HZ = 22.0  # at which frames of a file without times are given
LONGEST_PAUSE_S = 1.0  # between two recorded frames


class RecordingSource(Source):
    """The raw frames of one skin in a recording, once, at the recorded speed. (`skin replay` is the lossless way.)"""

    def frames(self) -> Iterator[RawFrame | None]:
        from services.recordings.recording import RecordingError

        try:
            yield from self._recorded(Path(self.skin.port))
        except (RecordingError, OSError) as why:
            self.problem = in_words(why)
        yield from self._ended(f"the recording {self.skin.port} has ended")

    def _recorded(self, path: Path) -> Iterator[RawFrame | None]:
        from services.recordings.recording import RecordingReader
        from services.recordings.replay import mark, skins_in

        skins = skins_in(reader := RecordingReader(path))
        theirs = self.name if self.name in skins else next(iter(skins), "")
        if theirs != self.name and len(skins) != 1:
            held = f"skins {', '.join(skins)}, none called {self.name}" if skins else f"no raw frames ({reader.damage})"
            self.problem = f"the recording {path} holds {held}"
            return
        previous, due = 0, time.monotonic()
        for recorded in reader.messages({"raw"}):
            if recorded.topic != f"raw/{theirs}":
                continue
            try:
                frame = unpack(recorded.wire)
            except FrameError:
                self.counts["malformed"] += 1
                continue
            assert isinstance(frame, RawFrame)  # by its topic
            sample = frame.stamps.get("sample", 0)
            due += min(max(0.0, (sample - previous) * 1e-9), LONGEST_PAUSE_S) if previous else 0.0
            previous = sample
            yield from _wait_until(due)
            mark(frame)
            frame.skin = self.name
            yield frame


class FileSource(Source):
    """The rows of an npz file as frames, once; in the order that services/recordings/npz_file.py gives them."""

    def frames(self) -> Iterator[RawFrame | None]:
        due = time.monotonic()
        try:
            data = read_file(Path(self.skin.port), self.bundle)
        except InputError as why:
            yield from self._ended(str(why))
        if data.understood:
            log.info("%s: %s read as: %s", self.name, self.skin.port, data.understood)
        for scan, (values, kind) in enumerate(frames_of(data)):
            due += 1 / FILE_RATE_HZ
            yield from _wait_until(due)
            yield file_frame(self.name, self.pattern_name, scan, values, kind, time.monotonic_ns(), data.separate)
        yield from self._ended(f"the file {self.skin.port} has ended")


def file_frame(
    skin: str, pattern: str, scan: int, values: NDArray[np.generic], kind: str, now_ns: int, separate: bool = False
) -> RawFrame:
    """The raw frame of one row (K,) of a file. separate: whether the row does not follow the one before it in time."""
    return RawFrame(
        skin=skin,
        scan=scan,
        stamps={"sample": now_ns, "read": now_ns},
        source="replay",
        valid=True,
        reasons=["replay", SEPARATE] if separate else ["replay"],
        valid_for_s=valid_for_s(1 / FILE_RATE_HZ),
        z=np.asarray(values, np.complex64),
        status=np.zeros(len(values), np.uint8),
        device_us=now_ns // 1000,
        kind=kind,
        pattern=pattern,
    )


def _wait_until(due: float) -> Iterator[None]:
    while (left := due - time.monotonic()) > 0:
        pause(min(left, POLL_S))
        if left > POLL_S:
            yield None
