"""Contacts between two images: moved as the touches were that preprocessing follows from part to part of a scan.

What an image says of a touch stays: identity, shape, area. Its place and its force change by as much as those of the
followed touch that was nearest to it when the image was made. The errors of both places, the image's and the followed
touch's, have little to do with each other: where they agree, the contact is in the middle. Where they do not, the touch
is no circle, or the image is of a touch that changed: then the place is the image's, and its uncertainty says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from protocol.frames import Contact, FollowedTouch
from services.contacts.motion import Motion
from services.contacts.surface import Placement

AGREE = 3.0  # standard deviations of the followed touch's place within which an image's is of the same circle
MOVES = 0.13  # of its force, by which it is less sure while the touch moves: about 68 % of truths are then within the
# stated deviation, in 96 simulated touches of 2 N that slide at 0.1 and 0.3 m/s (without it half of them)
REACH_M = 0.008  # between a contact and the followed touch that it is


@dataclass(frozen=True)
class Anchor:
    """A contact's place and strength beside those of a followed touch."""

    number: int
    place: int  # in the list of the touches that are followed
    dx: float  # m
    dy: float
    integral: float
    apart: float | None = 0.0  # m, of image and followed touch where they do not agree; None: it is in the middle


class Following:
    """Of one skin's contacts."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._anchors: dict[int, Anchor] = {}  # by the contact's id
        self._then: list[FollowedTouch] = []  # what was followed when the image was made

    def anchor(self, contacts: Sequence[Contact], followed: Sequence[FollowedTouch]) -> None:
        """Take note of contacts that a new image shows, and of what is followed at the same instant."""
        self._then = list(followed)
        found = {c.id: _anchored(c, self._then) for c in contacts if c.state != "end"}
        self._anchors = {number: anchor for number, anchor in found.items() if anchor is not None}

    def motion(self, followed: Sequence[FollowedTouch]) -> dict[int, Motion]:
        """By now, of the contacts that are followed, by their ids."""
        both = {number: (anchor, _of(anchor, followed)) for number, anchor in self._anchors.items()}
        return {number: _motion(anchor, touch) for number, (anchor, touch) in both.items() if touch is not None}

    def moved(self, contacts: Sequence[Contact], followed: Sequence[FollowedTouch], place: Placement) -> list[Contact]:
        """The contacts as they are by now. One that a fit refined is where the fit has it, which is surer than what is
        followed, until it moves.
        """
        found = []
        for contact in contacts:
            own = _anchored(contact, self._then) if contact.refined else None
            anchor = own or self._anchors.get(contact.id)
            touch = None if anchor is None or contact.state == "end" else _of(anchor, followed)
            if anchor is not None and touch is not None:
                grown = touch.integral / max(anchor.integral, 1e-30)
                still = contact.refined and not any(touch.velocity)
                now = Motion(*contact.on_sheet, 0.0, 0.0) if still else _motion(anchor, touch)
                contact = _moved(contact, now, grown, _sigma(contact, anchor, touch), place)
            found.append(contact)
        return found

    def state(self) -> dict[str, Any]:
        anchors = [[number, *asdict(anchor).values()] for number, anchor in self._anchors.items()]
        return {"anchors": anchors, "then": [asdict(touch) for touch in self._then]}

    def load(self, state: dict[str, Any] | Sequence[Any]) -> None:
        """Older recordings have the anchors alone."""
        kept = state if isinstance(state, dict) else {"anchors": state, "then": []}
        self._anchors = {int(number): Anchor(int(n), int(k), *rest) for number, n, k, *rest in kept["anchors"]}
        self._then = [FollowedTouch(**touch) for touch in kept["then"]]


def _anchored(contact: Contact, followed: Sequence[FollowedTouch]) -> Anchor | None:
    """The contact beside the followed touch that is nearest to it; None where none is near."""
    x, y = contact.on_sheet
    near = [math.hypot(x - t.position[0], y - t.position[1]) for t in followed]
    if not near or min(near) >= REACH_M:
        return None
    k = near.index(min(near))
    t = followed[k]
    dx, dy = x - t.position[0], y - t.position[1]
    if contact.position_sigma is not None:  # what was measured by itself is where it is
        return Anchor(t.number, k, dx, dy, t.integral)
    if math.hypot(dx, dy) <= AGREE * t.sigma[0]:
        return Anchor(t.number, k, 0.5 * dx, 0.5 * dy, t.integral, None)
    return Anchor(t.number, k, dx, dy, t.integral, math.hypot(dx, dy))


def _sigma(contact: Contact, anchor: Anchor, touch: FollowedTouch) -> list[float]:
    """Of the contact's place: in the middle of two that are about as sure it is surer than either, while it is held."""
    long, short, angle = touch.sigma
    if (own := contact.position_sigma) is not None:
        moved = contact.refined and any(touch.velocity)
        return [math.hypot(own[0], long), math.hypot(own[1], long), own[2]] if moved else own
    if anchor.apart is None:
        better = 1.0 if any(touch.velocity) else math.sqrt(0.5)
        return [better * long, better * short, angle]
    return [math.hypot(long, anchor.apart), math.hypot(short, anchor.apart), angle]


def _motion(anchor: Anchor, touch: FollowedTouch) -> Motion:
    """Of a contact that is anchored beside a touch."""
    x, y = touch.position
    return Motion(x + anchor.dx, y + anchor.dy, *touch.velocity)


def _of(anchor: Anchor, followed: Sequence[FollowedTouch]) -> FollowedTouch | None:
    touch = followed[anchor.place] if anchor.place < len(followed) else None
    return touch if touch is not None and touch.number == anchor.number else None


def _moved(contact: Contact, now: Motion, grown: float, sigma: list[float], place: Placement) -> Contact:
    """The contact in another place, its force `grown` times what it was."""
    at = place(now.x, now.y)
    force = None if contact.force_n is None else contact.force_n * grown
    sigma_n = None if contact.force_sigma_n is None else contact.force_sigma_n * grown
    pressure = None if contact.pressure_pa is None else contact.pressure_pa * grown
    pressure_sigma = None if contact.pressure_sigma_pa is None else contact.pressure_sigma_pa * grown
    if sigma_n is not None and (now.vx or now.vy):
        sigma_n = math.hypot(sigma_n, MOVES * (force or 0.0))
    pressed = -(force or 0.0) * at.normal
    return replace(
        contact,
        position=at.point.tolist(),
        velocity=(now.vx * at.along_x + now.vy * at.along_y).tolist(),
        normal=at.normal.tolist(),
        sheet=None if place.flat else [now.x, now.y],
        force_n=force,
        force_sigma_n=sigma_n,
        pressure_pa=pressure,
        pressure_sigma_pa=pressure_sigma,
        wrench=[*pressed.tolist(), *np.cross(at.point, pressed).tolist()],
        position_sigma=sigma,
    )
