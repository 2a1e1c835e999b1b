"""The image of a held frame: it was sent once, with the first frame that showed it (WIRE.md, "Rules for readers")."""

from __future__ import annotations

from .frame_types import ImageFrame

ANY = ""
"""Session of an image that was taken over from a state: the producer has begun another one since."""


class HeldImage:
    """Keeps the image last sent, and gives it to the frames that hold it."""

    def __init__(self) -> None:
        self.last: ImageFrame | None = None
        """The frame that brought it."""

    def complete(self, frame: ImageFrame) -> bool:
        """Put the image into a frame that holds it, or keep the one it brings. False where it holds one that we do
        not know: subscribe anew, and the next frame brings it.
        """
        if frame.image.size:
            self.last = frame
            return True
        if not frame.held:
            return True
        last = self.last
        if last is None or last.reconstructed != frame.reconstructed or last.session not in (ANY, frame.session):
            return False
        frame.image, frame.sigma, frame.classes = last.image, last.sigma, last.classes
        frame.touches = last.touches
        return True
