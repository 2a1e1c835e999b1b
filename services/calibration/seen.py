"""What is seen of touches whose force is known: what force laws take, read as the service reads it. That is the touch
as the measurements tell it, or of a skin whose measurements do not tell its touches, the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from models.bundle import Bundle
from models.measurement.tables import tells_touches
from protocol.frames import EstimatedTouch, ImageFrame
from services.contacts.calibration_file import Of
from services.contacts.force import ForceLaw, Look, Quantity
from services.contacts.reading import Appearances
from services.contacts.segmentation import segment
from services.runtime.config import Skin


@dataclass(frozen=True)
class SeenTouch:
    """Of one touch, in the skin's frame."""

    x: float  # m
    y: float
    acts: float  # how strongly: m^2 of insulating sheet, or of an image its integral [S/m m^2]
    quantities: dict[Of, Quantity]  # what each kind of law takes


class TouchReader:
    """Of one skin, without a calibration that it may have already."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        law = ForceLaw.of(skin.model_copy(update={"calibration": None}), bundle)
        self._laws: dict[Of, ForceLaw] = {reads: replace(law, reads=reads) for reads in get_args(Of)}
        self._appearances = Appearances(bundle) if tells_touches(bundle) else None

    def __call__(self, frame: ImageFrame) -> list[SeenTouch]:
        """What a frame tells of its touches, strongest first."""
        if not frame.touched:
            return []
        if self._appearances is None:
            looks = [Look.of(s, frame) for s in segment(frame.image, frame.sigma)] if frame.image.size else []
            return [self._of_image(look) for look in looks if look.peak > 0 and look.integral > 0]
        self._appearances.see(frame)
        seen = [self._of_estimate(touch, self._appearances.of(touch).classes) for touch in frame.estimates]
        return sorted(seen, key=lambda touch: -touch.acts)

    def _of_image(self, look: Look) -> SeenTouch:
        found = {reads: law.quantity(look) for reads, law in self._laws.items()}
        return SeenTouch(look.x, look.y, look.integral, found)

    def _of_estimate(self, touch: EstimatedTouch, classes: Sequence[float]) -> SeenTouch:
        found = {reads: law.quantity_of(touch, classes) for reads, law in self._laws.items()}
        x, y = touch.position
        return SeenTouch(x, y, touch.strength, found)


def mean(several: Sequence[SeenTouch]) -> SeenTouch:
    """Of one touch that is held still."""
    x, y, acts = (float(v) for v in np.mean([(touch.x, touch.y, touch.acts) for touch in several], axis=0))
    return SeenTouch(
        x, y, acts, {of: _mean([touch.quantities[of] for touch in several]) for of in several[0].quantities}
    )


def _mean(several: Sequence[Quantity]) -> Quantity:
    relative = [q.relative for q in several if q.relative is not None]
    value = float(np.mean([q.value for q in several]))
    return Quantity(value, float(np.mean(relative)) if len(relative) == len(several) else None)
