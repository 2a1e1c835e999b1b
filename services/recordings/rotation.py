"""A recording in several files: the next one begins when one is large or long enough."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from services.recordings.recording import RecordedMessage, RecordingError, RecordingWriter

RETRY_S = 10.0

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
        self.files, self.deleted = 1, 0
        """Files begun, and files deleted since."""
        self.problem = ""
        """Why no new file could begin; "" while all is well."""

    def write(self, message: RecordedMessage) -> bool:
        """Takes one message; whether a new file begins with it, which then lacks the stages' state."""
        turned = self._due() and self._turn()
        self._writer.write(message.topic, message.data, message.log_time_ns)
        return turned

    def begin(self) -> None:
        """Write what each file begins with."""
        for message in self._head():
            self._writer.write(message.topic, message.data, message.log_time_ns)

    def _due(self) -> bool:
        now, limit = time.monotonic(), self._rotation
        large = 0 < limit.file_bytes <= self._writer.bytes
        return (large or 0 < limit.file_s <= now - self._began_s) and now >= self._retry_s

    def _turn(self) -> bool:
        """Begin the next file; where that cannot be, go on with this one."""
        path = self._following(self.files + 1)
        try:
            following = RecordingWriter(path, self._metadata())
        except (RecordingError, OSError) as why:
            self.problem, self._retry_s = f"{why}; recording goes on in {self.path}", time.monotonic() + RETRY_S
            log.error("%s", self.problem)
            return False
        self._counts += Counter(self._writer.counts)
        self._lost += self._writer.lost
        self._writer.close()
        self._bytes += self._writer.bytes
        self._writer, self.path, self.problem = following, path, ""
        self._began_s = time.monotonic()
        self.files += 1
        self._files.append(path)
        while 0 < self._rotation.keep < len(self._files):
            self.deleted += removed(self._files.popleft())
        self.begin()
        return True

    def flush_if_due(self) -> None:
        self._writer.flush_if_due()

    @property
    def full(self) -> str:
        """Why nothing can be written now, as the system says it; "" while all is well."""
        return self._writer.full

    @property
    def lost(self) -> int:
        """Messages that there was no room for, in all files."""
        return self._lost + self._writer.lost

    @property
    def bytes(self) -> int:
        """Of all files, those deleted too."""
        return self._bytes + self._writer.bytes

    @property
    def counts(self) -> dict[str, int]:
        """Messages taken so far, by topic, in all files."""
        return dict(self._counts + Counter(self._writer.counts))

    def close(self) -> None:
        self._writer.close()


def removed(path: Path) -> bool:
    """Delete one of our own files; whether it is gone by our hand."""
    try:
        path.unlink()
    except OSError as why:
        log.warning("cannot delete %s: %s", path, why.strerror)
        return False
    return True
