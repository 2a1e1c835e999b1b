"""Whether a stage saw everything that was measured between two of its frames, by their scans and their instants.

What a stage skips (an overload, SIGSTOP) it has not seen either, so each stage asks for itself; `gap` in a frame's
reasons is the word of those before it.
"""

from __future__ import annotations

from typing import Any

from protocol.frames import Frame
from services.runtime.stage import SEPARATE, VALID_S


def longest_s(frame: Frame) -> float:
    """How long at most nothing may be heard before a frame, for it to follow."""
    return max(frame.valid_for_s, VALID_S)


class Continuity:
    """Of one skin's frames, in their order."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """The next frame follows none, so that nothing is missing before it."""
        self._scan = -1
        self._sample_ns = 0

    def broken(self, frame: Frame, scans: int) -> bool:
        """Whether something is missing just before this frame. scans: by how much their numbers go on at most from one
        frame to the next.
        """
        last, before_ns = self._scan, self._sample_ns
        self._scan, self._sample_ns = frame.scan, frame.stamps.get("sample", 0)
        if last < 0 or SEPARATE in frame.reasons:
            return False
        away_s = abs(self._sample_ns - before_ns) * 1e-9
        return "gap" in frame.reasons or not 0 <= frame.scan - last <= scans or away_s > longest_s(frame)

    def state(self) -> list[int]:
        return [self._scan, self._sample_ns]

    def load(self, state: Any) -> None:
        """Older recordings have none."""
        self.forget()
        if state is not None:
            self._scan, self._sample_ns = (int(each) for each in state)
