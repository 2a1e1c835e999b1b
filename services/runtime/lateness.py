"""Which frames are too old to be acted on, and which queued frames are skipped."""

from __future__ import annotations

import time

from protocol.ages import Ages
from protocol.frames import Frame
from protocol.pause import pause

STOOD_S = 0.1  # a wait that is longer than meant by so much: the process stood still, and what came meanwhile is old
ARRIVING_S = 0.01  # for all that has queued up in sockets and threads to arrive


class Lateness:
    """Lateness in one process. A frame from a recording is never late here: a replay gives the same frames however slow
    the machine; readers of replays judge them by their stamp `read`.
    """

    def __init__(self) -> None:
        self._ages = Ages(("acquisition",))
        self._looked_s = time.monotonic()

    def stood_still(self, timeout_s: float) -> bool:
        """Whether this process (stopped, swapped out) or the whole host (suspended) stood still since the last call,
        apart from a wait of timeout_s. If so, this waits for the queued frames to arrive, so that the newest is found.
        """
        now = time.monotonic()
        stood = self._ages.look() or now - self._looked_s > max(0.0, timeout_s) + STOOD_S
        if stood:
            pause(ARRIVING_S)
            now = time.monotonic()
        self._looked_s = now
        return stood

    def late(self, frame: Frame) -> bool:
        """Whether a live frame was measured longer ago than its `valid_for_s`."""
        if frame.source == "replay":
            return False
        measured = self._ages.measured_ns(frame, time.monotonic_ns())
        return measured is not None and self._ages.age_s(measured) > frame.valid_for_s

    def news(self, frames: list[Frame], stood: bool) -> list[Frame]:
        """The queued frames that are to be processed, oldest first. A live frame that is late is skipped where a newer
        one waits. After the process `stood` still only the newest is processed.
        """
        return [
            frame
            for n, frame in enumerate(frames, 1)
            if n == len(frames) or frame.source == "replay" or not (stood or self.late(frame))
        ]

    def close(self) -> None:
        self._ages.close()
