"""Touches of a skin whose measurements tell only that something touches: what its image shows, or where a registered
skin's response map finds them. Each has the number of the one that was nearest to it in the image before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from models.bundle import Bundle
from protocol.frames import EstimatedTouch, ImageFrame, LocatedTouch
from services.contacts.images.segmentation import Segment, divided, readable, segment
from services.contacts.reading import Appearance, Pixels

SAME = 0.15  # of the skin's half side, within which a touch is the one before: 0.3 m/s, a scan of 5 cm


@dataclass(frozen=True)
class ImageTouch:
    """One touch of an image."""

    segment: Segment  # the part of the image that is its
    appearance: Appearance  # with its place [m]
    reach_m: float  # from its middle to the farthest of it
    located: LocatedTouch | None  # by the map of a registered skin


class ImageTouches:
    """Of one skin."""

    def __init__(self, bundle: Bundle) -> None:
        self._same_m = SAME * bundle.half_width * bundle.metres_per_unit

    def found(self, frame: ImageFrame, before: Mapping[int, Appearance]) -> list[ImageTouch]:
        """Those of a new image, strongest first; before: where touches were, by their numbers."""
        if not frame.image.size or not readable(frame.image):
            return []
        image = Pixels(frame.metres_per_pixel, frame.origin)
        located: Sequence[LocatedTouch | None] = frame.touches
        if located:
            places = [(x, y) for x, y in (touch.position for touch in frame.touches)]
            parts = divided(frame.image, frame.sigma, [image.at(*place) for place in places])
        else:
            parts = segment(frame.image, frame.sigma, [image.at(each.x, each.y) for each in before.values()])
            places, located = [image.place(s.x, s.y) for s in parts], [None] * len(parts)
        return [
            ImageTouch(s, image.appearance(s, frame, *place), s.reach * image.side_m, touch)
            for s, place, touch in zip(parts, places, located, strict=True)
        ]

    def estimated(self, appearance: Appearance, estimates: Iterable[EstimatedTouch]) -> EstimatedTouch | None:
        """A registered skin's touch as the measurements tell it: the nearest that is near enough to be the same."""
        apart = [
            (math.hypot(t.position[0] - appearance.x, t.position[1] - appearance.y), k, t)
            for k, t in enumerate(estimates)
        ]
        distance, _, nearest = min(apart, default=(math.inf, 0, None))
        return nearest if distance < self._same_m else None

    def same(self, touches: list[ImageTouch], before: Mapping[int, Appearance]) -> list[int]:
        """Of each touch the number that it had before, the nearest pairs first; 0: it is new."""
        apart = [
            (math.hypot(touch.appearance.x - each.x, touch.appearance.y - each.y), k, number)
            for k, touch in enumerate(touches)
            for number, each in before.items()
        ]
        found, taken = [0] * len(touches), set[int]()
        for distance, k, number in sorted(apart):
            if distance < max(self._same_m, touches[k].reach_m) and not found[k] and number not in taken:
                found[k] = number
                taken.add(number)
        return found
