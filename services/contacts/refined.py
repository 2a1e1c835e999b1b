"""A contact as a fit of its shape to the measurements finds it, in the place of what its image shows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from models.shapes import Shape
from protocol.frames import SHAPES, Contact, RefinedTouch
from services.contacts.force.law import Force
from services.contacts.surface import Placed

APART = 3.0  # standard uncertainties beyond which image and fit do not mean the same touch
ASIDE = 0.3  # of the touch's radius: what an image's place may be off by, whatever the fit says of its own
LARGER = 2.0  # times: areas that differ by more are of different touches
KIND_UNKNOWN = 0.15  # of an image's force: what it is wrong by where the touch is soft, which it does not know
ROUND = 48  # corners of an outline that is round
FIT_SHARE = 0.75  # of the shape's probabilities: likeliest on 300 touches at 70 dB
DIFFER = (0.05, 0.1)  # of drop and area: kinds that differ by more leave the image a say; see `settled`


def agrees(contact: Contact, touch: RefinedTouch, force: Force) -> bool:
    """Whether fit and image differ by no more than they state: in place, force and area."""
    x, y = contact.on_sheet
    radius = math.sqrt(max(touch.area_m2, 1e-12) / math.pi)
    aside = math.hypot(touch.position[0] - x, touch.position[1] - y)
    if not aside <= math.hypot(APART * touch.sigma[0], ASIDE * radius):
        return False
    ratio = touch.area_m2 / max(contact.area_m2, 1e-12)
    if not 1 / LARGER <= ratio <= LARGER * (1 + APART * touch.area_sigma_m2 / max(touch.area_m2, 1e-12)):
        return False
    if force.newton is None or contact.force_n is None:
        return True
    own = max(contact.force_sigma_n or 0.0, KIND_UNKNOWN * contact.force_n)
    unsure = math.hypot(force.sigma or 0.0, own)
    return abs(force.newton - contact.force_n) <= APART * unsure


def area_of_image(touch: RefinedTouch) -> bool:
    """Whether a contact's area is its image's, and its outline too: the kinds that explain the frame differ in it."""
    return touch.between_kinds[1] > DIFFER[1]


def settled(contact: Contact, touch: RefinedTouch, force: Force) -> tuple[Force, float, float]:
    """Force, area and its standard uncertainty. A fit knows them as far as it knows what kind of shape it is: where the
    kinds that explain the frame differ, it may as well be one that was not fitted. Then the area is the image's, which
    is nearer on 300 touches, and the force the geometric mean of both; what that changes counts as uncertain.
    """
    if touch.between_kinds[0] > DIFFER[0] and force.newton is not None and contact.force_n is not None:
        mean = math.sqrt(force.newton * contact.force_n)
        sigma = None if force.sigma is None else math.hypot(force.sigma, mean - force.newton)
        force = force._replace(newton=mean, sigma=sigma)
    if area_of_image(touch):
        return force, contact.area_m2, math.hypot(touch.area_sigma_m2, touch.area_m2 - contact.area_m2)
    return force, touch.area_m2, touch.area_sigma_m2


def refined(
    contact: Contact, touch: RefinedTouch, at: Placed, said: tuple[Force, float, float], wrench: list[float], flat: bool
) -> Contact:
    """at: the fit's place on the skin; said: what is `settled`."""
    best = int(np.argmax(touch.probabilities))
    force, area, area_sigma = said
    return replace(
        contact,
        position=at.point.tolist(),
        normal=at.normal.tolist(),
        sheet=None if flat else list(touch.position),
        orientation=_half_turn(touch.rotation) if touch.kind == "rectangle" else contact.orientation,
        area_m2=area,
        area_sigma_m2=area_sigma,
        force_n=force.newton,
        force_sigma_n=force.sigma,
        pressure_pa=force.pressure,
        pressure_sigma_pa=force.pressure_sigma,
        wrench=wrench,
        shape=SHAPES[best],
        shape_probability=touch.probabilities[best],
        position_sigma=list(touch.sigma),
        refined=True,
        kind=touch.kind,
        kind_probability=touch.probability,
    )


def both(fit: list[float], image: list[float]) -> list[float]:
    """Class probabilities by a fit and by the network together: their weighted geometric mean, as both read the same
    frame. Each errs where the other does not: a fit where its model is not exact, the network where it was trained too
    little. image: [] where there are none.
    """
    if not image:
        return fit
    mean = np.array(fit) ** FIT_SHARE * np.array(image) ** (1 - FIT_SHARE)
    return [min(1.0, float(p)) for p in mean / mean.sum()] if mean.sum() > 0 else fit


def refined_outline(touch: RefinedTouch) -> list[list[float]]:
    """Closed polygon of (x, y), counter-clockwise, metres."""
    x, y = touch.centre
    shape = Shape(touch.kind, x, y, touch.radius_m, touch.drop, touch.rotation, touch.aspect)
    return [[float(x), float(y)] for x, y in shape.outline(ROUND)]


def _half_turn(angle: float) -> float:
    """An axis has no direction: -pi/2 to pi/2."""
    return (angle + math.pi / 2) % math.pi - math.pi / 2
