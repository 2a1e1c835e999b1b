"""Snapshots: the last seconds before an event and those after it, as a file that replays. Taken by command, and by
themselves of contacts and faults. What goes wrong is said and counted; it never stops the recorder.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from protocol.errors import in_words
from protocol.frames import Frame
from services.recordings.recording import RecordingError, RecordingWriter
from services.recordings.ring import Ring, RingEntry
from services.recordings.rotation import PRIVATE, removed
from services.recordings.triggers import Trigger, TriggerWatch

STATE_EVERY_S = 5.0
"""How often the stages are asked for their state, so that a snapshot may begin there."""
LONGEST_S = 300.0
"""Of one snapshot after its first event: further ones that come meanwhile make it longer."""

ASKED_A_MINUTE, ASKED_IN_ALL = 10, 200
"""Snapshots by command: nobody fills a disk by asking."""
MINUTE_NS = 60 * 10**9

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Keeping:
    """What is kept for snapshots. keep: so many of those that were taken by themselves, the oldest go."""

    folder: Path
    before_s: float = 10.0
    after_s: float = 5.0
    memory_bytes: int = 64_000_000
    triggers: tuple[Trigger, ...] = ()
    keep: int = 100


@dataclass
class OpenSnapshot:
    """One that is being written."""

    path: Path
    writer: RecordingWriter
    end_ns: int
    last_end_ns: int


class Snapshots:
    """Hears every message. `mind` often."""

    def __init__(self, keeping: Keeping, metadata: Callable[[str], dict[str, str]]) -> None:
        """metadata: of a file, given the event."""
        self.keeping, self._metadata = keeping, metadata
        self.ring = Ring(keeping.before_s + STATE_EVERY_S + 1.0, keeping.memory_bytes)
        self._watch = TriggerWatch(keeping.triggers)
        self._open: OpenSnapshot | None = None
        self._automatic: deque[Path] = deque()
        self._asked: deque[tuple[int, Path]] = deque()  # by command, and when
        self.taken, self.missed, self.deleted, self.lost = 0, 0, 0, 0
        """Snapshots begun; events of which none could be; old ones deleted; messages that there was no room for."""
        self.last = ""
        """The newest file."""
        self.problem = ""

    @property
    def writing(self) -> bool:
        """Whether one is not whole yet."""
        return self._open is not None

    def hear(self, heard: RingEntry, frame: Frame | None) -> None:
        """A message, the newest; frame: what is in it, None for a state."""
        event = self._watch(frame) if frame is not None else None
        self.ring.add(heard)
        if self._open is not None and not heard.again:
            message = heard.message
            self._open.writer.write(message.topic, message.data, message.log_time_ns)
        if event is not None:
            kind, what = event
            try:
                self.take(kind, what, heard.message.log_time_ns)
            except RecordingError:
                pass  # said in `problem`, and counted

    def take(
        self, kind: str, what: str, now_ns: int, before_s: float | None = None, after_s: float | None = None
    ) -> Path:
        """Begin a snapshot, or have the one that is being written go on for longer; its file. kind: a trigger's name,
        or "snapshot" where somebody asked for it. Raises RecordingError.
        """
        before = self.keeping.before_s if before_s is None else before_s
        event = what if kind == "snapshot" else f"{kind}: {what}"
        end_ns = now_ns + int((self.keeping.after_s if after_s is None else after_s) * 1e9)
        if self._open is not None:
            self._open.end_ns = min(max(self._open.end_ns, end_ns), self._open.last_end_ns)
            return self._open.path
        if kind == "snapshot":
            self._allow(now_ns)
        try:
            self.keeping.folder.mkdir(PRIVATE, parents=True, exist_ok=True)
            path = file_in(self.keeping.folder, f"-{kind}")
            writer = RecordingWriter(path, self._metadata(event))
            self._open = OpenSnapshot(path, writer, end_ns, now_ns + int(LONGEST_S * 1e9))
            for message in self.ring.since(now_ns - int(before * 1e9)):
                writer.write(message.topic, message.data, message.log_time_ns)
            writer.flush()
        except (RecordingError, OSError) as why:
            self.missed += 1
            self._end()
            self._failed(f"no snapshot ({event}): {in_words(why)}")
            raise RecordingError(self.problem) from None
        self.taken += 1
        self.last, self.problem = str(path), ""
        log.info("snapshot (%s): %s", event, path)
        if kind != "snapshot":
            self._automatic.append(path)
            while 0 < self.keeping.keep < len(self._automatic):
                self.deleted += removed(self._automatic.popleft())
        else:
            self._asked.append((now_ns, path))
        return path

    def _allow(self, now_ns: int) -> None:
        """Whether one more may be taken by command. Raises RecordingError."""
        lately = [at for at, _ in self._asked if now_ns - at < MINUTE_NS]
        if len(lately) >= ASKED_A_MINUTE:
            wait_s = (lately[-ASKED_A_MINUTE] + MINUTE_NS - now_ns) * 1e-9
            raise RecordingError(
                f"found {len(lately)} snapshots by command within a minute, allowed are {ASKED_A_MINUTE}: wait "
                f"{wait_s:.0f} s, or use {self.last}, the newest"
            )
        if len(self._asked) >= ASKED_IN_ALL:
            self._asked = deque((at, path) for at, path in self._asked if path.exists())
        if len(self._asked) >= ASKED_IN_ALL:
            raise RecordingError(
                f"found {len(self._asked)} snapshots by command in {self.keeping.folder}, allowed are {ASKED_IN_ALL} "
                "of one recorder: move or delete those that you do not need"
            )

    def mind(self, now_ns: int) -> None:
        """End what is long enough, and write what is due."""
        if self._open is not None:
            self._open.writer.flush_if_due()
        if self._open is not None and now_ns >= self._open.end_ns:
            self._end()

    def _end(self) -> None:
        found, self._open = self._open, None
        if found is None:
            return
        how, writer = found.writer.elsewhere, found.writer
        writer.close()
        self.lost += writer.lost
        if how:
            self._failed(f"the snapshot {found.path} was {how} while it was written")
        elif writer.lost or writer.full:
            lacks = f"{writer.lost} of {writer.lost + sum(writer.counts.values())} messages are not in it"
            self._failed(f"the snapshot {found.path} is not whole: {writer.why}; {lacks}")

    def _failed(self, why: str) -> None:
        if why != self.problem:
            log.error("%s", why)
        self.problem = why

    def close(self) -> None:
        self._end()


def file_in(folder: Path, kind: str = "") -> Path:
    """A file name that the folder does not have yet: the time, to the second, and a number where needed."""
    stem = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()) + kind
    names = (folder / f"{stem}{suffix}.mcap" for suffix in ("", *(f"-{n}" for n in range(1, 1000))))
    return next(path for path in names if not path.exists())
