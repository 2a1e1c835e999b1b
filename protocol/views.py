"""What is read out of frames in the same way for every other world."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from .frames import Contact, ContactFrame, ImageFrame


def present(frame: ContactFrame) -> list[Contact]:
    """The contacts that are there, strongest first."""
    return [contact for contact in frame.contacts if contact.state != "end"]


def has_forces(frame: ContactFrame) -> bool:
    """Whether forces are known: a skin without a force law has none, which is not the same as none pressing."""
    return "uncalibrated_force" not in frame.reasons and all(c.force_n is not None for c in present(frame))


def total(contacts: Iterable[Contact]) -> list[float]:
    """The sum of the contacts' wrenches, 0 where there is none."""
    return [math.fsum(values) for values in zip(*(c.wrench for c in contacts), strict=True)] or [0.0] * 6


def label(contact: Contact) -> str:
    """A contact in a few words."""
    if contact.force_n is None:
        return f"{contact.id} {contact.shape}"
    sigma = "" if contact.force_sigma_n is None else f" ± {contact.force_sigma_n:.1f}"
    return f"{contact.id} {contact.force_n:.1f}{sigma} N{_pressure(contact)} {contact.shape}"


def _pressure(contact: Contact) -> str:
    """Where it is highest, for a person."""
    if contact.pressure_pa is None:
        return ""
    sigma = contact.pressure_sigma_pa
    return f" {contact.pressure_pa / 1e3:.1f}{'' if sigma is None else f' ± {sigma / 1e3:.1f}'} kPa"


def tail(contact: Contact, metres_per_newton: float) -> list[float]:
    """Where an arrow onto the contact begins: the longer, the harder it presses."""
    length = 0.02 if contact.force_n is None else max(0.004, metres_per_newton * contact.force_n)
    return [p + length * n for p, n in zip(contact.position, contact.normal, strict=True)]


def filled(frame: ImageFrame) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Drop and uncertainty, of one shape. Untouched there is no image: nothing has dropped, NaN is not known."""
    drop = frame.image
    if not drop.size:
        across = [round(-2 * start / frame.metres_per_pixel) if frame.metres_per_pixel else 0 for start in frame.origin]
        drop = np.zeros((max(across[1], 0), max(across[0], 0)), "<f4")
    sigma = frame.sigma if frame.sigma.shape == drop.shape else np.full(drop.shape, np.nan, "<f4")
    return drop, sigma


def orientation(normal: Sequence[float], angle: float = 0.0) -> tuple[float, float, float, float]:
    """The turn (x, y, z, w) that brings z to the normal, after one by `angle` about z."""
    nx, ny, nz = normal
    if nz < -0.999999:  # upside down: half a turn about x
        x, y, w = 1.0, 0.0, 0.0
    else:
        w = math.sqrt(max(0.0, 0.5 * (1 + nz)))
        x, y = -0.5 * ny / w, 0.5 * nx / w
    s, c = math.sin(0.5 * angle), math.cos(0.5 * angle)
    return x * c + y * s, y * c - x * s, w * s, w * c
