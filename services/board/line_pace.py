"""The line's pace: when a scan's first byte came, and when the next byte is worth waking up for."""

from __future__ import annotations

EARLY_S = 0.0015  # before a scan's last byte is expected it is waited for byte by byte
LONGEST_LINE_S = 0.02  # that a scan is expected to take on the line: slower ones are listened to all the time


class LinePace:
    """The pace of one connection's line."""

    def __init__(self, now_s: float) -> None:
        self._began_s = now_s  # when the first byte of what is not complete came
        self._line_s = 0.0  # from the first byte of the last scan to its last
        self._paused = False  # since the last look at the line

    def first_byte_s(self, now_s: float, *, waited: bool, dropped: bool, complete: bool, waits: bool) -> float:
        """Returns when the first byte came of the first message that the bytes read now complete.

        waited, waits: something incomplete was there before them, is there after them. dropped: some of it was no
        message, so that the first byte of what was one is not known. complete: there is a message.
        """
        began_s = self._began_s if waited and not dropped else now_s
        self._began_s = now_s if complete or not waits else began_s
        self._paused = self._paused and complete
        return began_s

    def received(self, seconds: float) -> None:
        """Takes how long a scan took from its first byte to its last."""
        # Complete at the first look after a pause: the pause was too long.
        self._line_s = self._line_s / 2 if self._paused else (seconds if seconds < LONGEST_LINE_S else 0.0)

    def pause_s(self, now_s: float) -> float:
        """Returns for how long the next byte is not worth waking up for: the rest of a scan comes as slowly as that of
        the last.
        """
        pause_s = self._line_s - EARLY_S - (now_s - self._began_s)
        self._paused = pause_s > 0
        return max(0.0, pause_s)
