"""What touches look like: the part of the image that is each one's, moved with it since the image was made; where no
image shows a touch yet, the disc that the measurements tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.bundle import Bundle
from protocol.frames import EstimatedTouch, ImageFrame
from services.contacts.outline import outline
from services.contacts.segmentation import class_probabilities, divided, readable

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


class Appearances:
    """Of one skin's touches, by their ids."""

    def __init__(self, bundle: Bundle) -> None:
        self._metres, self._origin = bundle.metres_per_pixel, list(bundle.image_origin)
        self.forget()

    def forget(self) -> None:
        self.known: dict[int, Appearance] = {}

    def see(self, frame: ImageFrame) -> None:
        """Take what a new image shows of the touches of its frame."""
        touches = frame.estimates
        self.known = {}
        if not touches or not frame.image.size or not readable(frame.image):
            return
        m, (x0, y0) = self._metres, self._origin
        places = [((t.position[0] - x0) / m - 0.5, (t.position[1] - y0) / m - 0.5) for t in touches]
        for touch, s in zip(touches, divided(frame.image, frame.sigma, places), strict=True):
            area, disc = s.area * m * m, math.pi * touch.radius_m**2
            if not disc / LARGER < area < disc * LARGER:
                continue
            self.known[touch.id] = Appearance(
                x=touch.position[0],
                y=touch.position[1],
                area_m2=area,
                orientation=s.orientation,
                outline=outline(s.mask, m, [x0, y0]),
                classes=class_probabilities(s, frame.classes),
            )

    def of(self, touch: EstimatedTouch) -> Appearance:
        """By now."""
        x, y = touch.position
        known = self.known.get(touch.id)
        if known is None:
            return Appearance(x, y, math.pi * touch.radius_m**2, 0.0, _round(x, y, touch.radius_m), [])
        dx, dy = x - known.x, y - known.y
        moved = [[px + dx, py + dy] for px, py in known.outline]
        return Appearance(x, y, known.area_m2, known.orientation, moved, known.classes)


def _round(x: float, y: float, radius: float) -> list[list[float]]:
    angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
    corners: Sequence[Sequence[float]] = np.column_stack(
        [x + radius * np.cos(angle), y + radius * np.sin(angle)]
    ).tolist()
    return [list(corner) for corner in corners]
