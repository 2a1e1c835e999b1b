"""The fields of a contact: of a touch that is there, and of one that ended."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from protocol.frames import SHAPES, Contact, EstimatedTouch, RefinedTouch
from services.contacts.force import ForceLaw
from services.contacts.reading import Appearance
from services.contacts.refined import agrees, refined, settled
from services.contacts.surface import Placed, Placement


class ContactWriter:
    """tells_force: whether the skin's contacts have forces, by a force law or by registration."""

    def __init__(self, law: ForceLaw, place: Placement, tells_force: bool) -> None:
        self.law, self.place, self.tells_force = law, place, tells_force

    def of_estimate(self, number: int, state: str, touch: EstimatedTouch, look: Appearance) -> Contact:
        """A touch as the measurements tell it, and as it looks."""
        found = self.law.of_touch(touch, look.classes)
        best = int(np.argmax(look.classes)) if look.classes else -1
        at, (vx, vy) = self.place(*touch.position), touch.velocity
        return Contact(
            id=number,
            state=state,
            position=at.point.tolist(),
            velocity=(vx * at.along_x + vy * at.along_y).tolist(),
            normal=at.normal.tolist(),
            orientation=look.orientation,
            area_m2=look.area_m2,
            force_n=found.newton,
            force_sigma_n=found.sigma,
            pressure_pa=found.pressure,
            pressure_sigma_pa=found.pressure_sigma,
            wrench=_wrench(at, found.newton or 0.0),
            shape=SHAPES[best] if look.classes else "unknown",
            shape_probability=look.classes[best] if look.classes else None,
            confidence=0.5 * (1 + math.erf(math.sqrt(touch.z2 / 2))),
            position_sigma=list(touch.sigma),
            sheet=None if self.place.flat else list(touch.position),
        )

    def gone(self, contacts: Sequence[Contact]) -> list[Contact]:
        """The last contacts of touches that were shown so."""
        force = 0.0 if self.tells_force else None
        return [
            Contact(
                id=c.id,
                state="end",
                position=c.position,
                normal=c.normal,
                force_n=force,
                confidence=0.0,
                sheet=c.sheet,
            )
            for c in contacts
        ]

    def fitted(self, contact: Contact, touch: RefinedTouch) -> Contact | None:
        """The contact as a fit has it; None where image and fit do not mean the same touch."""
        force = self.law.of_fit(touch)
        if not agrees(contact, touch, force):
            return None
        at, said = self.place(*touch.position), settled(contact, touch, force)
        return refined(contact, touch, at, said, _wrench(at, said[0].newton or 0.0), flat=self.place.flat)


def _wrench(at: Placed, force: float) -> list[float]:
    """On the skin, at its frame's origin: the touch presses against the normal."""
    pressed = -force * at.normal
    return [*pressed.tolist(), *np.cross(at.point, pressed).tolist()]
