"""What touches look like: the part of the image that is each one's, moved with it since the image was made; where no
image shows a touch yet, the disc that the measurements tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.bundle import Bundle
from protocol.frames import EstimatedTouch, ImageFrame
from services.contacts.images.outline import outline
from services.contacts.images.segmentation import Segment, class_probabilities, divided, readable

CORNERS = 32  # of the outline of a disc
LARGER = 2.5  # times the disc's area, or a part of it: an image that differs by more shows something else


@dataclass
class Appearance:
    """Of one touch."""

    x: float  # m, where the touch was then
    y: float
    area_m2: float
    orientation: float  # rad, of the longest axis to x
    outline: list[list[float]]  # m
    classes: list[float]  # probabilities; empty: the image tells none


@dataclass(frozen=True)
class Pixels:
    """Where the pixels of an image lie on the sheet."""

    side_m: float
    origin: list[float]  # m, of the outer corner of the first

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Column and row of a place [m]; whole numbers are middles of pixels."""
        x0, y0 = self.origin
        return (x - x0) / self.side_m - 0.5, (y - y0) / self.side_m - 0.5

    def place(self, x: float, y: float) -> tuple[float, float]:
        """The other way round: of a column and a row [m]."""
        x0, y0 = self.origin
        return x0 + (x + 0.5) * self.side_m, y0 + (y + 0.5) * self.side_m

    def area(self, s: Segment) -> float:
        """m^2"""
        return s.area * self.side_m * self.side_m

    def appearance(self, s: Segment, frame: ImageFrame, x: float, y: float) -> Appearance:
        """Of a touch at x, y [m] whose part of the image this is."""
        drawn = outline(s.mask, self.side_m, self.origin)
        return Appearance(x, y, self.area(s), s.orientation, drawn, class_probabilities(s, frame.classes))


class Appearances:
    """Of one skin's touches, by their ids."""

    def __init__(self, bundle: Bundle) -> None:
        self._pixels = Pixels(bundle.metres_per_pixel, list(bundle.image_origin))
        self.forget()

    def forget(self) -> None:
        self.known: dict[int, Appearance] = {}

    def see(self, frame: ImageFrame) -> None:
        """Take what a new image shows of the touches of its frame."""
        touches = frame.estimates
        self.known = {}
        if not touches or not frame.image.size or not readable(frame.image):
            return
        places = [self._pixels.at(*touch.position) for touch in touches]
        for touch, s in zip(touches, divided(frame.image, frame.sigma, places), strict=True):
            disc = math.pi * touch.radius_m**2
            if disc / LARGER < self._pixels.area(s) < disc * LARGER:
                self.known[touch.id] = self._pixels.appearance(s, frame, *touch.position)

    def of(self, touch: EstimatedTouch) -> Appearance:
        """By now."""
        x, y = touch.position
        known = self.known.get(touch.id)
        if known is None:
            angle, radius = 2 * np.pi * np.arange(CORNERS) / CORNERS, touch.radius_m
            disc = np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)])
            return Appearance(x, y, math.pi * radius**2, 0.0, disc.tolist(), [])
        dx, dy = x - known.x, y - known.y
        moved = [[px + dx, py + dy] for px, py in known.outline]
        return Appearance(x, y, known.area_m2, known.orientation, moved, known.classes)
