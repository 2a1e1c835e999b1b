"""The fields of a contact: of a touch that is there, and of one that ended."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from protocol.frames import SHAPES, Contact, EstimatedTouch, ImageFrame
from services.contacts.force.law import Force, ForceLaw, ImagePatch
from services.contacts.images.of_image import ImageTouch
from services.contacts.reading import Appearance, Pixels
from services.contacts.surface import Placement


class ContactWriter:
    """tells_force: whether the skin's contacts have forces, by a force law or by registration."""

    def __init__(self, law: ForceLaw, place: Placement, tells_force: bool) -> None:
        self.law, self.place, self.tells_force = law, place, tells_force

    def of_estimate(self, number: int, state: str, touch: EstimatedTouch, appearance: Appearance) -> Contact:
        """A touch as the measurements tell it, and as an image shows it."""
        force = self.law.of_touch(touch, appearance.classes)
        contact = self._here(number, state, appearance, force, touch.velocity)
        contact.confidence = 0.5 * (1 + math.erf(math.sqrt(touch.z2 / 2)))
        contact.position_sigma = list(touch.sigma)
        return contact

    def of_image(
        self, number: int, state: str, touch: ImageTouch, frame: ImageFrame, moves: EstimatedTouch | None
    ) -> Contact:
        """A touch as an image shows it, or as a registered skin's map tells it; moves: as the measurements tell it."""
        appearance, located, s = touch.appearance, touch.located, touch.segment
        pixels = Pixels(frame.metres_per_pixel, frame.origin)
        integral = s.volume * pixels.side_m * pixels.side_m
        found = self.law.force(ImagePatch(s.peak, s.peak_sigma, integral, *pixels.place(s.x, s.y)))
        if located is not None and not self.law.exists:
            found = Force(located.force_n, None if located.force_n is None else located.value_sigma)
        contact = self._here(number, state, appearance, found, (0.0, 0.0) if moves is None else moves.velocity)
        # probability that the peak is not noise, from its own standard deviation
        contact.confidence = 1.0 if s.peak_sigma <= 0 else 0.5 * (1 + math.erf(s.peak / s.peak_sigma / math.sqrt(2)))
        if located is not None:
            contact.position_sigma, contact.indentation_m = list(located.sigma), located.indentation_m
            contact.indentation_sigma_m = None if located.indentation_m is None else located.value_sigma
        return contact

    def _here(self, number: int, state: str, shown: Appearance, force: Force, velocity: Sequence[float]) -> Contact:
        """What all contacts that are there have."""
        best = int(np.argmax(shown.classes)) if shown.classes else -1
        return Contact(
            id=number,
            state=state,
            orientation=shown.orientation,
            area_m2=shown.area_m2,
            force_n=force.newton,
            force_sigma_n=force.sigma,
            pressure_pa=force.pressure,
            pressure_sigma_pa=force.pressure_sigma,
            shape=SHAPES[best] if shown.classes else "unknown",
            shape_probability=shown.classes[best] if shown.classes else None,
            **self._placed(shown.x, shown.y, velocity, force.newton or 0.0),
        )

    def moved(self, contact: Contact, before: EstimatedTouch, now: EstimatedTouch) -> Contact:
        """The same contact, as far on as the measurements say."""
        (x0, y0), (x, y) = before.position, now.position
        on_x, on_y = contact.on_sheet[0] + x - x0, contact.on_sheet[1] + y - y0
        return replace(contact, **self._placed(on_x, on_y, now.velocity, contact.force_n or 0.0))

    def _placed(self, x: float, y: float, velocity: Sequence[float], force: float) -> dict[str, Any]:
        """The fields that a place on the sheet decides. The touch presses against the normal: its wrench is about the
        origin of the frame of contacts.
        """
        at, (vx, vy) = self.place(x, y), velocity
        pressed = -force * at.normal
        return {
            "position": at.point.tolist(),
            "velocity": (vx * at.along_x + vy * at.along_y).tolist(),
            "normal": at.normal.tolist(),
            "wrench": [*pressed.tolist(), *np.cross(at.point, pressed).tolist()],
            "sheet": None if self.place.flat else [x, y],
        }

    def gone(self, contacts: Sequence[Contact]) -> list[Contact]:
        """The last contacts of touches that were shown so."""
        ended: dict[str, Any] = {"state": "end", "confidence": 0.0, "force_n": 0.0 if self.tells_force else None}
        return [Contact(id=c.id, position=c.position, normal=c.normal, sheet=c.sheet, **ended) for c in contacts]
