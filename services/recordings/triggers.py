"""What a snapshot is taken of by itself: a contact that begins, a fault that begins."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from protocol.frames import ContactFrame, Frame, StatusFrame

Trigger = Literal["contact", "fault"]
TRIGGERS: tuple[Trigger, ...] = ("contact", "fault")
NO_FAULTS = frozenset({"coarse", "changing", "extrapolated", "uncalibrated_force", "replay", "separate", "low_snr"})
"""Reasons that a healthy skin gives too."""
MOST_KNOWN = 256


class TriggerWatch:
    """Sees all frames, in order."""

    def __init__(self, wanted: Iterable[Trigger]) -> None:
        self._wanted = frozenset(wanted)
        self._touching: dict[str, set[tuple[str, int]]] = {}  # of each skin: sessions and ids
        self._well: dict[str, bool] = {}  # of each skin: whether its last frame was valid
        self._reasons: dict[str, set[str]] = {}
        self._levels: dict[tuple[str, str], str] = {}  # of each process

    def __call__(self, frame: Frame) -> tuple[Trigger, str] | None:
        """What begins with this frame, if that is wanted, and in words."""
        if isinstance(frame, ContactFrame):
            return self._contacts(frame)
        if isinstance(frame, StatusFrame):
            return self._status(frame)
        return None

    def _contacts(self, frame: ContactFrame) -> tuple[Trigger, str] | None:
        if len(self._well) >= MOST_KNOWN and frame.skin not in self._well:
            return None
        reasons = set(frame.reasons) - NO_FAULTS
        new = reasons - self._reasons.get(frame.skin, reasons)
        fell = self._well.get(frame.skin, False) and not frame.valid
        self._well[frame.skin], self._reasons[frame.skin] = frame.valid, reasons
        touching = {(frame.session, c.id) for c in frame.contacts if c.state != "end"} if frame.valid else set()
        came = touching - self._touching.get(frame.skin, set())
        if frame.valid or not frame.contacts:
            self._touching[frame.skin] = touching
        if "fault" in self._wanted and (fell or new):
            return "fault", f"{frame.skin}: {', '.join(sorted(new or reasons)) or 'not valid'}"
        if "contact" in self._wanted and came:
            return "contact", f"{frame.skin}: contact {min(number for _, number in came)}"
        return None

    def _status(self, frame: StatusFrame) -> tuple[Trigger, str] | None:
        key = frame.skin, frame.process
        if len(self._levels) >= MOST_KNOWN and key not in self._levels:
            return None
        before = self._levels.get(key, frame.level)
        self._levels[key] = frame.level
        failed = frame.level in ("ERROR", "STALE") and before not in ("ERROR", "STALE")
        if "fault" in self._wanted and failed and frame.process != "recorder":
            return "fault", f"{frame.skin}: {frame.process} {frame.level}"
        return None
