"""The placement that a skin's configuration asks for."""

from __future__ import annotations

import numpy as np

from services.contacts.surface import Array, Cylinder, Placement, Plane, rotation
from services.runtime.config import ConfigError, Skin


def placement(skin: Skin, outline: Array, name: str) -> tuple[Placement, str]:
    """Where contacts are, and the name of the frame that they are given in. outline (n, 2) [m]: the sheet's.

    Raises ConfigError where the sheet does not fit round what it is said to be wrapped round.
    """
    surface: Plane | Cylinder = Plane()
    if skin.surface is not None:
        surface = Cylinder(skin.surface.radius_m, float(np.radians(skin.surface.axis_degrees)))
        reach, room = surface.reach_m(outline), 2 * np.pi * surface.radius_m
        if reach > room * (1 + 1e-6):
            raise ConfigError(
                f"skins.{name}.surface: the sheet reaches {1e3 * reach:.0f} mm round a cylinder of {1e3 * room:.0f} "
                f"mm (radius_m = {surface.radius_m:g}): correct radius_m, or axis_degrees"
            )
    if skin.contacts_in == "skin":
        return Placement(surface), skin.frame_id
    pose = skin.pose
    return Placement(surface, rotation(pose.quaternion_xyzw), np.array(pose.position_m)), pose.parent
