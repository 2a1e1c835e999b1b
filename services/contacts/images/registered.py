"""Touches of a registered skin: their places from its response map, their shapes from the image."""

from __future__ import annotations

from typing import Any

from models.bundle import Bundle
from models.locator_arrays import QUANTITIES
from protocol.frames import LocatedTouch


def measures_force(bundle: Bundle) -> bool:
    """Whether the skin was registered with presses of known force."""
    return bundle.locator is not None and QUANTITIES[int(bundle.locator.quantity)] == "force_n"


def registered(touch: LocatedTouch) -> dict[str, Any]:
    """The fields of a contact that only a registered skin has."""
    deep = touch.indentation_m is not None
    return {
        "position_sigma": list(touch.sigma),
        "indentation_m": touch.indentation_m,
        "indentation_sigma_m": touch.value_sigma if deep else None,
    }
