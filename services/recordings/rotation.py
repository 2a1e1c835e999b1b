"""A recording in several files: the next one begins when one is large or long enough."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from protocol.errors import in_words
from services.recordings.recording import RecordedMessage, RecordingError, RecordingWriter

RETRY_S = 10.0
LOOK_S = 0.3  # how often it is looked whether the file is still there
PRIVATE = 0o700  # of a folder of recordings
ADVICE = dict.fromkeys(map(os.strerror, (errno.ENOSPC, errno.EDQUOT)), "make room in {}")
ADVICE[os.strerror(errno.EFBIG)] = "begin another file, smaller ones with --file-mb or file_mb of [recorder]"
"""What to do where nothing can be written, by what the system says."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rotation:
    """When the next file begins; 0: never. keep: so many files of a recording, the oldest go; 0: all."""

    file_bytes: int = 0
    file_s: float = 0.0
    keep: int = 0


class RotatingWriter:
    """Writes like a RecordingWriter. Each file stands by itself: it begins with what `head` gives."""

    def __init__(
        self,
        path: Path,
        rotation: Rotation,
        following: Callable[[int], Path],
        head: Callable[[], Iterable[RecordedMessage]],
        metadata: Callable[[], dict[str, str]],
        overwrite: bool = False,
    ) -> None:
        """following: the name of the k-th file, from 2 on. Raises RecordingError where the first cannot be written."""
        self.path, self._rotation = path, rotation
        self._following, self._head, self._metadata = following, head, metadata
        self._writer = RecordingWriter(path, metadata(), overwrite)
        self._began_s, self._retry_s = time.monotonic(), 0.0
        self._files = deque([path])
        self._counts: Counter[str] = Counter()
        self._lost = self._bytes = 0
        self._why = ""
        self.files, self.deleted = 1, 0
        """Files begun, and files deleted since."""
        self.problem = ""
        """Why no new file could begin; "" while all is well."""
        self.torn = ""
        """What became of the last file that was deleted or moved while it was written; "" where none was."""
        self._tear, self._checked_s = "", self._began_s
        self.nowhere = False
        """Whether the file is gone and no other could begin: nothing is recorded."""
        self.ended = False

    def write(self, message: RecordedMessage) -> bool:
        """Takes one message; whether a new file begins with it, which then lacks the stages' state."""
        if self.nowhere:
            self._lost += 1
            return False
        turned = self._due() and self._turn()
        self._writer.write(message.topic, message.data, message.log_time_ns)
        return turned

    def look(self, now: bool = False) -> bool:
        """Whether a new file has begun, which lacks the stages' state, because the one before was deleted or moved.
        Looks every LOOK_S, or `now`.
        """
        if not now and time.monotonic() - self._checked_s < LOOK_S:
            return False
        self._checked_s = time.monotonic()
        if not self.nowhere:
            how = self._writer.elsewhere
            if not how:
                return False
            self._let_go(how)
        return self._begin_anew()

    def _let_go(self, how: str) -> None:
        """The file is no longer under its name; what a deleted one held is lost."""
        self._close_file()
        held = sum(self._writer.counts.values())
        if how == "deleted":
            self._lost += held
            self._counts -= Counter(self._writer.counts)
        self.nowhere = True
        lost = f": its {held} messages are lost" if how == "deleted" else ""
        self._tear = f"{self.path} was {how} while it was recorded{lost}"
        log.error("%s", self._tear)

    def _begin_anew(self) -> bool:
        path = self._following(self.files + 1)
        try:
            path.parent.mkdir(mode=PRIVATE, exist_ok=True)
            self._writer = RecordingWriter(path, self._metadata())
        except (RecordingError, OSError) as why:
            self.torn = f"{self._tear}; nothing is recorded until a file can begin again: {in_words(why)}"
            return False
        self.nowhere, self.path = False, path
        self.torn = f"{self._tear}; the recording goes on in {path}"
        log.warning("%s", self.torn)
        self._begin_file(path)
        return True

    def begin(self) -> None:
        """Write what each file begins with."""
        for message in self._head():
            self._writer.write(message.topic, message.data, message.log_time_ns)

    def _due(self) -> bool:
        now, limit = time.monotonic(), self._rotation
        large = 0 < limit.file_bytes <= self._writer.bytes
        wanted = large or 0 < limit.file_s <= now - self._began_s
        return wanted and now >= self._retry_s and not self._writer.full  # what waits for room is this file's

    def _turn(self) -> bool:
        """Begin the next file; where that cannot be, go on with this one."""
        path = self._following(self.files + 1)
        try:
            following = RecordingWriter(path, self._metadata())
        except RecordingError as why:
            self.problem, self._retry_s = f"{why}; recording goes on in {self.path}", time.monotonic() + RETRY_S
            log.error("%s", self.problem)
            return False
        self._close_file()
        self._writer, self.path, self.problem = following, path, ""
        self._begin_file(path)
        return True

    def _close_file(self) -> None:
        self._writer.close()
        self._counts += Counter(self._writer.counts)
        self._lost += self._writer.lost
        self._bytes += self._writer.bytes
        self._why = self._writer.why or self._why

    def _begin_file(self, path: Path) -> None:
        self._began_s = time.monotonic()
        self.files += 1
        self._files.append(path)
        while 0 < self._rotation.keep < len(self._files):
            self.deleted += removed(self._files.popleft())
        self.begin()

    def flush_if_due(self) -> None:
        if not self.nowhere:
            self._writer.flush_if_due()

    @property
    def full(self) -> str:
        """Why nothing can be written now, as the system says it; "" while all is well."""
        return "" if self.nowhere else self._writer.full

    @property
    def lost(self) -> int:
        """Messages that are in no file: there was no room for them, or the file that held them was deleted."""
        return self._lost + (0 if self.nowhere else self._writer.lost)

    @property
    def bytes(self) -> int:
        """Of all files, those deleted too."""
        return self._bytes + (0 if self.nowhere else self._writer.bytes)

    @property
    def counts(self) -> dict[str, int]:
        """Messages taken so far, by topic, in all files but those that somebody deleted meanwhile."""
        return dict(self._counts + Counter({} if self.nowhere else self._writer.counts))

    @property
    def problems(self) -> list[str]:
        """What is wrong, and what to do."""
        lost, why = self.lost, (self.full or self._writer.why or self._why)
        found = [text for text in (self.problem, self.torn) if text]
        if self.ended:
            summary = f"{lost} of {lost + sum(self.counts.values())} messages are not in {self.path.parent}"
            summary = summary if lost else f"it is not known whether all of {self.path} is on the medium"
            return [f"{why or 'a file was taken away'}: {summary}", *found] if lost or self.full else found
        if self.full:
            summary = f"{lost} messages are lost so far" if lost else "nothing is lost yet"
            advice = ADVICE.get(self.full, "see what is wrong with {}").format(self.path.resolve().parent)
            return [f"{self.full}: {advice}; {summary}, recording goes on by itself when it can", *found]
        return [f"{lost} messages are lost so far: {why}", *found] if lost and not self.torn else found

    def close(self) -> None:
        self.ended = True
        if not self.nowhere:
            self._writer.close()


def removed(path: Path) -> bool:
    """Delete one of our own files; whether it is gone by our hand."""
    try:
        path.unlink()
    except OSError as why:
        log.warning("cannot delete %s: %s", path, why.strerror)
        return False
    return True
