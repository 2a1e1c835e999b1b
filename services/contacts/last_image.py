"""What the newest image frame said of its touches, for the parts of scans between it and the next one, and which image
the next one has to follow.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from protocol.frames import ContactFrame, ImageFrame, PartFrame, RefinedTouch
from protocol.held import ANY
from services.runtime.stage import HARMLESS, add_reason, inherited


class LastImage:
    """Of one skin. A part or an image that does not follow it, by the scan that it names, follows another image."""

    def __init__(self, skin: str) -> None:
        self._skin = skin
        self._last: ImageFrame | None = None

    def forget(self) -> None:
        self._last = None

    def take(self, frame: ImageFrame, said: ContactFrame) -> None:
        """Take note of an image frame, without its arrays, and of the contact frame that was made of it. What was only
        late says nothing of its parts, which have an age of their own.
        """
        doubts = [reason for reason in said.reasons if reason not in HARMLESS | {"late"}]
        valid = said.valid or ("late" in said.reasons and set(doubts) <= {"changing"})
        self._last = ImageFrame(
            skin=frame.skin,
            session=frame.session,
            scan=frame.scan,
            valid=valid,
            reasons=[reason for reason in frame.reasons if reason == "changing"] if valid else doubts,
            touched=frame.touched,
            reconstructed=frame.reconstructed,
            residual=frame.residual,
            noise=frame.noise,
            refined=frame.refined,
        )

    def precedes(self, frame: PartFrame | ImageFrame) -> bool:
        """Whether it is the image that a frame follows; else that one was not seen. An image of a whole scan names
        none: those follow each other by their numbers.
        """
        if isinstance(frame, ImageFrame) and (self._last is None or not frame.after):
            return True
        return self._last is not None and self._last.scan == frame.after

    def doubts(self, part: ImageFrame, after: int) -> None:
        """Make a part doubted by what its image, of the scan `after`, was refused for."""
        last = self._last
        if last is not None and last.scan == after and not last.valid:
            part.valid = False
            for reason in last.reasons:
                add_reason(part.reasons, reason)

    def held_by(self, part: PartFrame) -> ImageFrame:
        """The image frame of a part: it holds the last image, whose touches are by now where the part says. Where that
        image is not known it holds none.
        """
        last = self._last
        out = ImageFrame(**inherited(part), touched=True, held=True)
        if last is None or last.scan != part.after or not last.touched:
            return out
        out.session, out.reconstructed = last.session, last.reconstructed
        out.residual, out.noise, out.refined = last.residual, last.noise, last.refined
        out.followed = part.followed
        for reason in last.reasons:
            add_reason(out.reasons, reason)
        self.doubts(out, part.after)
        return out

    def state(self) -> dict[str, Any] | None:
        last = self._last
        if last is None:
            return None
        names = ("scan", "valid", "reasons", "touched", "reconstructed", "residual", "noise")
        refined = None if last.refined is None else asdict(last.refined)
        return {**{name: getattr(last, name) for name in names}, "refined": refined}

    def load(self, state: dict[str, Any] | None) -> None:
        """Older recordings have none."""
        self._last = None
        if state is not None:
            refined = None if state["refined"] is None else RefinedTouch(**state["refined"])
            self._last = ImageFrame(skin=self._skin, session=ANY, **{**state, "refined": refined})
