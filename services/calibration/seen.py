"""What is seen of touches whose force is known: what force laws take, of contacts as the service makes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, get_args

import numpy as np

from models.bundle import Bundle
from protocol.frames import ContactFrame, ImageFrame
from services.contacts.force.calibration_file import Of
from services.contacts.force.curve import Curve, Quantity
from services.contacts.force.law import ForceLaw
from services.publisher import Publishing
from services.runtime.config import Skin

KINDS: tuple[Of, ...] = get_args(Of)


@dataclass(frozen=True)
class SeenTouch:
    """One touch."""

    x: float  # m, on the sheet
    y: float
    quantities: dict[Of, Quantity]  # what each kind of law takes

    @property
    def strength(self) -> Quantity:
        """How it acts on the measurements, drop times m^2, whatever its size: of touches of sizes that nobody named."""
        integral = self.quantities["integral"]
        return Quantity(integral.value / (1 - min(self.quantities["peak"].value, 1.0) / 2), integral.relative)

    @property
    def acts(self) -> float:
        """How strongly: the integrated drop."""
        return self.quantities["integral"].value


class SeenTouches(NamedTuple):
    """What one frame tells."""

    touches: list[SeenTouch]  # strongest first; none where the frame is not valid
    reasons: list[str]  # of a frame that is not valid; else empty


class TouchReader:
    """Of one skin, without a calibration that it may have already: its publisher, once for each kind of law, each with
    a curve that leaves the quantity as it is. Frames are read once, in their order.
    """

    def __init__(self, skin: Skin, bundle: Bundle, each_alone: bool = False) -> None:
        """each_alone: frames do not follow each other."""
        plain = skin.model_copy(update={"calibration": None})
        law = replace(ForceLaw.of(plain, bundle), curve=Curve(1.0))
        self._by_kind = {of: Publishing("skin", plain, bundle, replace(law, reads=of)) for of in KINDS}
        for publishing in self._by_kind.values():
            publishing.each_alone = each_alone

    def __call__(self, frame: ImageFrame) -> SeenTouches:
        made = dict[Of, ContactFrame]()
        for of, publishing in self._by_kind.items():
            (contacts,) = publishing.process(frame, frozenset())
            assert isinstance(contacts, ContactFrame)
            made[of] = contacts
        first = made["pressure"]
        if not first.valid:
            return SeenTouches([], list(first.reasons) or ["not valid"])
        found = list[SeenTouch]()
        for contact in (contact for contact in first.contacts if contact.state != "end"):
            x, y = contact.on_sheet
            same = {of: next(c for c in each.contacts if c.id == contact.id) for of, each in made.items()}
            found.append(SeenTouch(x, y, {of: _quantity(c.force_n, c.force_sigma_n) for of, c in same.items()}))
        return SeenTouches(sorted(found, key=lambda touch: -touch.acts), [])


def _quantity(value: float | None, sigma: float | None) -> Quantity:
    """As a law without a curve said it."""
    return Quantity(value or 0.0, sigma / value if value and sigma is not None else None)


def mean(several: Sequence[SeenTouch]) -> SeenTouch:
    """Of one touch that is held still."""
    x, y = (float(v) for v in np.mean([(touch.x, touch.y) for touch in several], axis=0))
    return SeenTouch(x, y, {of: _mean([touch.quantities[of] for touch in several]) for of in KINDS})


def _mean(several: Sequence[Quantity]) -> Quantity:
    relative = [q.relative for q in several if q.relative is not None]
    value = float(np.mean([q.value for q in several]))
    return Quantity(value, float(np.mean(relative)) if len(relative) == len(several) else None)
