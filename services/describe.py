"""What info/<skin> says of a skin's geometry, in metres."""

from __future__ import annotations

from typing import Any

import numpy as np

from models.bundle import Bundle

CORNERS = 64  # of the polygon that stands for a disc


def geometry(bundle: Bundle) -> dict[str, Any]:
    """name, outline (n, 2) [m] counter-clockwise, electrodes (E, 2) [m] their centres, metres_per_unit."""
    skin, metres = bundle.skin, bundle.metres_per_unit
    outline = skin.get("outline")
    if outline is None:
        angle = 2 * np.pi * np.arange(CORNERS) / CORNERS
        outline = float(skin.get("radius", 1.0)) * np.stack([np.cos(angle), np.sin(angle)], 1)
    centres = skin.get("electrodes", {}).get("centre", [])
    return {
        "name": str(skin.get("name", bundle.name)),
        "outline": metres * np.asarray(outline, dtype=float),
        "electrodes": metres * np.asarray(centres, dtype=float).reshape(-1, 2),
        "metres_per_unit": metres,
    }
