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
        self._anchors: dict[int, Anchor] = {}  # by the contact's id

    def forget(self) -> None:
        self._anchors = {}

    def anchor(self, contacts: Sequence[Contact], followed: Sequence[FollowedTouch]) -> None:
        """Take note of contacts that a new image shows, and of what is followed at the same instant."""
        self._anchors = {}
        for contact in (c for c in contacts if c.state != "end"):
            x, y = contact.on_sheet
            near = [math.hypot(x - t.position[0], y - t.position[1]) for t in followed]
            if near and min(near) < REACH_M:
                k = near.index(min(near))
                t = followed[k]
                dx, dy = x - t.position[0], y - t.position[1]
                apart: float | None = 0.0
                part = 1.0  # what was measured by itself is where it is
                if contact.position_sigma is None:
                    agree = math.hypot(dx, dy) <= AGREE * t.sigma[0]
                    apart, part = (None, 0.5) if agree else (math.hypot(dx, dy), 1.0)
                self._anchors[contact.id] = Anchor(t.number, k, part * dx, part * dy, t.integral, apart)

    def motion(self, followed: Sequence[FollowedTouch]) -> dict[int, Motion]:
        """By now, of the contacts that are followed, by their ids."""
        found = {}
        for number, anchor in self._anchors.items():
            if (touch := _of(anchor, followed)) is not None:
                x, y = touch.position
                found[number] = Motion(x + anchor.dx, y + anchor.dy, *touch.velocity)
        return found

    def moved(self, contacts: Sequence[Contact], followed: Sequence[FollowedTouch], place: Placement) -> list[Contact]:
        """The contacts as they are by now."""
        motion, found = self.motion(followed), []
        for contact in contacts:
            if contact.state != "end" and contact.id in motion:
                anchor = self._anchors[contact.id]
                touch = followed[anchor.place]
                grown = touch.integral / max(anchor.integral, 1e-30)
                contact = _moved(contact, motion[contact.id], grown, _sigma(anchor, touch), place)
            found.append(contact)
        return found

    def state(self) -> list[Any]:
        return [[number, *asdict(anchor).values()] for number, anchor in self._anchors.items()]

    def load(self, state: Sequence[Any]) -> None:
        self._anchors = {int(number): Anchor(int(n), int(k), *rest) for number, n, k, *rest in state}


def _sigma(anchor: Anchor, touch: FollowedTouch) -> list[float]:
    """Of the contact's place: in the middle of two that are about as sure it is surer than either, while it is held."""
    long, short, angle = touch.sigma
    if anchor.apart is None:
        better = 1.0 if any(touch.velocity) else math.sqrt(0.5)
        return [better * long, better * short, angle]
    return [math.hypot(long, anchor.apart), math.hypot(short, anchor.apart), angle]


def _of(anchor: Anchor, followed: Sequence[FollowedTouch]) -> FollowedTouch | None:
    touch = followed[anchor.place] if anchor.place < len(followed) else None
    return touch if touch is not None and touch.number == anchor.number else None


def _moved(contact: Contact, now: Motion, grown: float, sigma: list[float], place: Placement) -> Contact:
    """The contact in another place, its force `grown` times what it was."""
    at = place(now.x, now.y)
    force = None if contact.force_n is None else contact.force_n * grown
    sigma_n = None if contact.force_sigma_n is None else contact.force_sigma_n * grown
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
        wrench=[*pressed.tolist(), *np.cross(at.point, pressed).tolist()],
        position_sigma=sigma if contact.position_sigma is None else contact.position_sigma,
    )
