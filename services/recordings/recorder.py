"""What records a running service. Only subscribes; nothing waits for it.

Recording does not wake lazy topics unless they are asked for. The stages are asked for their state when a recording
starts and after each new baseline; the answers are stored as `state/<skin>`, and a replay begins from there.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from models.bundle import BundleError
from protocol.frames import Frame, InfoFrame, StatusFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader
from protocol.topics import TOPICS
from services.recordings import settings
from services.recordings.recording import STATE_TOPIC, RecordedMessage, RecordingError
from services.recordings.ring import RingEntry
from services.recordings.rotation import RotatingWriter, Rotation
from services.recordings.snapshots import STATE_EVERY_S, Keeping, Snapshots, file_in
from services.recordings.stage_states import StateReader
from services.runtime.config import MOST_SKINS, ConfigError, load

DEFAULT_TOPICS = ("raw", "contact", "status", "info", "reference")
POLL_S = 0.05
MOST_LATCHED = 1024

log = logging.getLogger(__name__)


class Recorder:
    """Subscribes, writes a recording while one is wanted, and keeps the last seconds for snapshots where `keeping` says
    so. `step` often; not thread-safe.
    """

    def __init__(
        self,
        path: Path | None = None,
        topics: Iterable[str] = DEFAULT_TOPICS,
        skin: str | None = None,
        overwrite: bool = False,
        rotation: Rotation | None = None,
        keeping: Keeping | None = None,
        config: Path | None = None,
    ) -> None:
        """path: record to this file from now on. config: the configuration of what is recorded; None: this process's
        own. Raises RecordingError.
        """
        self.topics, self.skin, self.rotation = list(topics), skin, rotation or Rotation()
        for name in self.topics:
            if name not in TOPICS:
                raise RecordingError(f"no topic {name!r}: expected some of {', '.join(TOPICS)}")
        self.writer: RotatingWriter | None = None
        """What the recording goes to; None while none is made."""
        self.received: Counter[tuple[str, str]] = Counter()
        """Messages that came, by topic and skin."""
        self._ended: RotatingWriter | None = None  # what the last one went to
        self._latched: dict[str, RecordedMessage] = {}
        self._skins: dict[str, float] = {}  # when each was last asked for the stages' state
        self._baselines: dict[str, Any] = {}
        self._zero_ns = (
            time.time_ns() - time.monotonic_ns()
        )  # a clock that is set meanwhile must not tear the file's times
        self._origin = metadata(self.topics, skin, config)  # as the service was started: files may change meanwhile
        self.reader, self.states = AllReader(self.topics, skin), StateReader()
        if path is not None:
            self.record(path, overwrite)
        self.snapshots = None if keeping is None else Snapshots(keeping, lambda event: self._metadata(event))

    def record(self, path: Path, overwrite: bool = False, named_by_time: bool = False) -> None:
        """Begin a recording. named_by_time: its further files are too, else numbered. Raises RecordingError."""
        if self.writer is not None:
            raise RecordingError(f"a recording is being made already: {self.writer.path}")

        def following(k: int) -> Path:
            numbered = (path.with_stem(f"{path.stem}-{n}") for n in range(k, k + 100_000))
            return file_in(path.parent) if named_by_time else next(name for name in numbered if not name.exists())

        def head() -> list[RecordedMessage]:
            return [replace(message, log_time_ns=self.now_ns()) for message in self._latched.values()]

        self.writer = RotatingWriter(path, self.rotation, following, head, self._metadata, overwrite)
        self.writer.begin()
        self._ask_for_file()

    def _ask_for_file(self) -> None:
        """A file has begun: ask for the stages' state."""
        for skin in self._skins:
            self.states.ask(skin, "file")

    def look(self, now: bool = False) -> None:
        """See whether the recording is still where it was begun; where it is not, go on in another file."""
        if self.writer is not None and self.writer.look(now):
            self._ask_for_file()

    def stop(self) -> None:
        """End the recording. Until the next one begins `problem` and `lost` say what is not in it."""
        if self.writer is not None:
            self.writer.close()
            self._ended, self.writer = self.writer, None

    @property
    def lost(self) -> int:
        """Messages that are in no file of this recording, or of the last one."""
        writer = self.writer or self._ended
        return writer.lost if writer is not None else 0

    def step(self, seconds: float = POLL_S) -> int:
        """Takes what arrives within `seconds`; how many messages that was."""
        end, taken = time.monotonic() + seconds, 0
        while True:
            got = self.reader.recv_message(max(0.0, end - time.monotonic()))
            self._take_states()
            if got is not None:
                self._take(*got)
                taken += 1
            if got is None or (taken and time.monotonic() >= end):
                break
        self.look()
        if self.writer is not None:
            self.writer.flush_if_due()
        if self.snapshots is not None:
            self.snapshots.mind(self.now_ns())
        return taken

    def _take(self, frame: Frame, message: bytes) -> None:
        name, _, data = message.partition(b"\0")
        found = RecordedMessage(name.decode(), self.now_ns(), data)
        counted = found.topic.partition("/")[0], frame.skin
        if counted in self.received or len(self.received) < MOST_LATCHED:
            self.received[counted] += 1
        key = ""
        if isinstance(frame, (StatusFrame, InfoFrame)):
            key = f"{found.topic}/{frame.process}"
            if key in self._latched or len(self._latched) < MOST_LATCHED:
                self._latched[key] = found
        self._put(RingEntry(found, key), frame)
        self._ask_states(frame)

    def _put(self, entry: RingEntry, frame: Frame | None, in_file: bool = True) -> None:
        if self.writer is not None and in_file and self.writer.write(entry.message):
            self._ask_for_file()
        if self.snapshots is not None:
            self.snapshots.hear(entry, frame)

    def _ask_states(self, frame: Frame) -> None:
        """Ask at the first frame of a skin, and after each tare: the state holds how drift is followed from there. For
        snapshots, now and then too.
        """
        if isinstance(frame, StatusFrame):  # which comes before the stages answer
            return
        now, requested_s = time.monotonic(), self._skins.get(frame.skin)
        if requested_s is None and len(self._skins) < MOST_SKINS:
            self._skins[frame.skin] = now
            self.states.ask(frame.skin, "ring" if self.writer is None else "file")
        elif requested_s is not None and self.snapshots is not None and now - requested_s >= STATE_EVERY_S:
            self._skins[frame.skin] = now
            self.states.ask(frame.skin, "ring")
        if isinstance(frame, InfoFrame) and (found := frame.info.get("tare_sample_ns")) is not None:
            if self._baselines.setdefault(frame.skin, found) != found:
                self._baselines[frame.skin] = found
                self.states.ask(frame.skin, "tare")

    def _take_states(self) -> None:
        for skin, purpose, packed in self.states.answers():
            topic = f"{STATE_TOPIC}/{skin}"
            message = RecordedMessage(topic, self.now_ns(), packed)
            self._put(RingEntry(message, topic, again=purpose != "tare"), None, in_file=purpose != "ring")

    def now_ns(self) -> int:
        """The system's time, as it would be had nobody set it since we began."""
        return self._zero_ns + time.monotonic_ns()

    @property
    def problem(self) -> str:
        """What is wrong, and what to do; "" while all is well."""
        found = [self.snapshots.problem] if self.snapshots is not None and self.snapshots.problem else []
        writer = self.writer or self._ended
        return "; ".join([*found, *(writer.problems if writer is not None else [])])

    @property
    def gaps(self) -> int:
        """Messages that got lost before they reached us."""
        return self.reader.gaps

    def _metadata(self, event: str = "") -> dict[str, str]:
        started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        return {**self._origin, "started": started} | ({"origin": "snapshot", "event": event} if event else {})

    def close(self) -> None:
        self.states.close()
        self._take_states()
        self.reader.close()
        if self.snapshots is not None:
            self.snapshots.close()
        if self.writer is not None:
            self.writer.close()  # and stays, to be asked for its counts

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def metadata(topics: list[str], skin: str | None, file: Path | None = None) -> dict[str, str]:
    """What a recording says of itself: where it was made, and the settings of its skins."""
    try:
        config = load(file)
        wanted = {name: found for name, found in config.skins.items() if skin in (None, name)}
        carried = settings.text_of(wanted, config.skip)
    except (ConfigError, BundleError) as error:
        log.warning("how the skins are configured is not in the recording: %s", error)
        carried = ""
    return {
        "origin": "record",
        "host": host_id(),
        "topics": " ".join(topics),
        "skin": skin or "",
        settings.KEY: carried,
    }
