"""After a gap frames are not valid until one says by itself what touches.

Nobody watched meanwhile: a touch may still be where it was, or another one in its place. An image of a whole scan that
explains its measurements, and shows nothing that is still to be confirmed, says all that touches; a second one that is
like the first does so too. Where neither comes, as of a touch that goes on moving, the third image is believed as it is
without a gap.
"""

from __future__ import annotations

from typing import Any

from protocol.frames import ImageFrame
from services.runtime.continuity import Continuity, longest_s

IMAGES = 3  # of whole scans, after which what is not sure is believed as without a gap
PUT_OFF = 2  # whole scans in parts, after which another one comes at the latest or a part says something


class AfterGap:
    """Of one skin's frames. `waits`: nothing measured since a gap was judged by itself yet. A start is a gap, and so is
    a time without a valid frame.
    """

    def __init__(self, parts: int) -> None:
        """parts: of a scan in parts."""
        self._parts = parts
        self._continuity = Continuity()
        self.forget()

    def forget(self) -> None:
        """Nothing was watched."""
        self._continuity.forget()
        self.waits, self._images = True, 0
        self._valid_ns = 0  # sample of the newest valid frame

    def look(self, frame: ImageFrame) -> None:
        """Note whether this frame follows the one before it."""
        broken = self._continuity.broken(frame, PUT_OFF * self._parts if frame.part else 1)
        silent = frame.stamps.get("sample", 0) - self._valid_ns > longest_s(frame) * 1e9
        if broken or silent:
            self.missed()

    def missed(self) -> None:
        """Something is missing before the next frame."""
        if not self.waits:
            self.waits, self._images = True, 0

    def saw(self) -> None:
        """An image was looked at."""
        self._images += 1

    def judged(self, frame: ImageFrame, whole: bool, sure: bool) -> bool:
        """Whether a frame without another fault may be believed. whole: it is of a whole scan; sure: contacts are shown
        of an image that is sure, and nothing waits to be confirmed.
        """
        if self.waits and whole:
            still = sure and "changing" not in frame.reasons
            self.waits = frame.touched and not still and self._images < IMAGES
        if not self.waits:
            self._valid_ns = frame.stamps.get("sample", 0)
        return not self.waits

    def state(self) -> dict[str, Any]:
        return {
            "waits": self.waits,
            "images": self._images,
            "valid_ns": self._valid_ns,
            "continuity": self._continuity.state(),
        }

    def load(self, state: dict[str, Any] | None) -> None:
        """Older recordings have none: what they had seen was judged."""
        self.forget()
        if state is None:
            self.waits = False
            return
        self.waits, self._images = bool(state["waits"]), int(state["images"])
        self._valid_ns = int(state["valid_ns"])
        self._continuity.load(state["continuity"])
