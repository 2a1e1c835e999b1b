"""The last seconds in memory, as messages: what a snapshot begins with."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

from services.recordings.recording import RecordedMessage

OVERHEAD_BYTES = 200
"""Of a message in memory, beside its data."""


@dataclass(frozen=True, slots=True)
class RingEntry:
    """A message, and what it replaces: `key` is that of a latched value ("info/palm", "status/palm/stub"),
    "" for a message that is worth nothing once there is a newer one. `again`: a state that only says once more where
    the stages are, so that a file may begin there; in the middle of a file it is left out.
    """

    message: RecordedMessage
    key: str = ""
    again: bool = False

    @property
    def size(self) -> int:
        """Bytes in memory."""
        return len(self.message.data) + OVERHEAD_BYTES


class Ring:
    """Holds `seconds`, or less where that would be more than `most_bytes`; and, whatever their age, the last values of
    what is latched as they were at its beginning.
    """

    def __init__(self, seconds: float, most_bytes: int) -> None:
        self.seconds, self.most_bytes = seconds, most_bytes
        self.bytes = 0
        self.forgotten = 0
        """Messages that had to go before their time, since they were too many."""
        self._held: deque[RingEntry] = deque()
        self._before: dict[str, RecordedMessage] = {}

    def add(self, entry: RingEntry) -> None:
        """A message, the newest."""
        self._held.append(entry)
        self.bytes += entry.size
        oldest_ns = entry.message.log_time_ns - self.seconds * 1e9
        while self._held[0].message.log_time_ns < oldest_ns or (self.bytes > self.most_bytes and len(self._held) > 1):
            gone = self._held.popleft()
            self.bytes -= gone.size
            self.forgotten += gone.message.log_time_ns >= oldest_ns
            if gone.key:
                self._before[gone.key] = gone.message

    def since(self, begin_ns: int) -> list[RecordedMessage]:
        """What a file from `begin_ns` on holds so far: first the latched values, then all messages. It begins a little
        earlier where the stages' state is known: from there a replay gives what came out then.
        """
        held = list(self._held)
        states = [k for k, h in enumerate(held) if h.again and h.message.log_time_ns <= begin_ns]
        last_of = {held[k].key: k for k in states}
        first = min(last_of.values(), default=next((k for k, h in enumerate(held) if _at(h) >= begin_ns), len(held)))
        latched = self._before | {h.key: h.message for h in held[:first] if h.key}
        for key in last_of:
            latched.pop(key, None)  # an older state of this skin
        tail = [h.message for k, h in enumerate(held[first:], first) if not h.again or last_of.get(h.key) == k]
        start_ns = tail[0].log_time_ns if tail else begin_ns
        return [replace(message, log_time_ns=start_ns) for message in latched.values()] + tail

    @property
    def held_s(self) -> float:
        """How far back it goes."""
        return (_at(self._held[-1]) - _at(self._held[0])) * 1e-9 if self._held else 0.0


def _at(entry: RingEntry) -> int:
    return entry.message.log_time_ns
