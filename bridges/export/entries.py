"""The frames of a recording, each with the time of day at which the skin was measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from protocol.frames import Frame, ImageFrame
from protocol.held import HeldImage

Logged = tuple[int, Frame]
"""When a frame was recorded [Unix ns], and the frame."""


@dataclass(frozen=True)
class Entry:
    """A frame, and when it was measured [Unix ns]; where it does not say, when it was recorded."""

    ns: int
    frame: Frame

    @property
    def skin(self) -> str:
        return self.frame.skin


def timed(read: Callable[[], Iterable[Logged]]) -> Iterator[Entry]:
    """Read twice: first how far the time of day was ahead of each host's monotonic clock, by the frame that was
    recorded soonest after its last stamp; then the frames, held images put in again.
    """
    ahead: dict[str, int] = {}
    for logged_ns, frame in read():
        if frame.stamps and frame.source != "replay":
            found = logged_ns - max(frame.stamps.values())
            ahead[frame.host] = min(found, ahead.get(frame.host, found))
    held: dict[str, HeldImage] = {}
    for logged_ns, frame in read():
        if isinstance(frame, ImageFrame) and not held.setdefault(frame.skin, HeldImage()).complete(frame):
            continue
        sample = frame.stamps.get("sample")
        known = sample is not None and frame.source != "replay" and frame.host in ahead
        yield Entry(sample + ahead[frame.host] if known and sample is not None else logged_ns, frame)
