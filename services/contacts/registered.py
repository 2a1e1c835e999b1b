"""Touches of a registered skin: their places from its response map, their shapes from the image."""

from __future__ import annotations

from typing import Any

from models.bundle import Bundle
from models.locator_arrays import QUANTITIES
from protocol.frames import ImageFrame, LocatedTouch
from services.contacts.motion import Patch
from services.contacts.segmentation import Segment, divided


def measures_force(bundle: Bundle) -> bool:
    """Whether the skin was registered with presses of known force."""
    return bundle.locator is not None and QUANTITIES[int(bundle.locator.quantity)] == "force_n"


def patches(frame: ImageFrame) -> tuple[list[Segment], list[Patch]]:
    """The image's part that belongs to each located touch, and the touch as the tracker follows it."""
    m, (x0, y0) = frame.metres_per_pixel, frame.origin
    places = [(t.position[0], t.position[1]) for t in frame.touches]
    segments = divided(frame.image, frame.sigma, [((x - x0) / m - 0.5, (y - y0) / m - 0.5) for x, y in places])
    each = zip(places, frame.touches, segments, strict=True)
    return segments, [Patch(x, y, touch.amplitude, s.reach * m) for (x, y), touch, s in each]


def registered(touch: LocatedTouch) -> dict[str, Any]:
    """The fields of a contact that only a registered skin has."""
    deep = touch.indentation_m is not None
    return {
        "position_sigma": list(touch.sigma),
        "indentation_m": touch.indentation_m,
        "indentation_sigma_m": touch.value_sigma if deep else None,
    }
