"""Where a place on the flat sheet is in space: point, normal and directions, for a skin that lies flat or is wrapped
round a cylinder (a forearm, a finger), in the skin's own frame or in that of the link that carries it.

The sheet is bent, not stretched, so lengths, areas and angles on it stay what they are, and its image with them. The
skin's frame has its origin at the sheet's centre, x and y along it there, and z out of it; a sheet of another shape
that can be unrolled needs a class like `Cylinder`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.runtime.config import ConfigError, Skin

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placed:
    """point [m], unit normal out of the skin, unit vectors along the sheet's x and y: (3,) each."""

    point: Array
    normal: Array
    along_x: Array
    along_y: Array


class Plane:
    """The sheet as it is."""

    def __call__(self, x: float, y: float) -> Placed:
        return Placed(np.array([x, y, 0.0]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0, 0]), np.array([0.0, 1.0, 0]))


class Cylinder:
    """The sheet round the outside of a cylinder. axis_rad: angle of the cylinder's axis to the sheet's x; at pi/2 the
    sheet's x runs round it and y along it. Its axis lies `radius_m` below the sheet's centre.
    """

    def __init__(self, radius_m: float, axis_rad: float) -> None:
        self.radius_m = radius_m
        c, s = float(np.cos(axis_rad)), float(np.sin(axis_rad))
        self._along, self._across = np.array([c, s, 0.0]), np.array([s, -c, 0.0])

    def __call__(self, x: float, y: float) -> Placed:
        along, across, up = self._along, self._across, np.array([0.0, 0.0, 1.0])
        r, flat = self.radius_m, np.array([x, y, 0.0])
        angle = float(flat @ across) / r
        c, s = np.cos(angle), np.sin(angle)
        round_ = c * across - s * up  # the direction in which `across` goes on here
        return Placed(
            (flat @ along) * along + r * s * across + r * (c - 1) * up,
            s * across + c * up,
            along[0] * along + across[0] * round_,
            along[1] * along + across[1] * round_,
        )

    def reach_m(self, outline: Array) -> float:
        """How far an outline (n, 2) goes round."""
        return float(np.ptp(outline @ self._across[:2]))


def rotation(quaternion_xyzw: Sequence[float]) -> Array:
    """(3, 3) of a unit quaternion."""
    x, y, z, w = (float(v) for v in quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class Placement:
    """From a place on the sheet to where it is; `flat`: they are the same numbers.

    pose: rotation (3, 3) and offset (3,) [m] of the frame that contacts are given in: p' = turn p + offset.
    """

    def __init__(self, surface: Plane | Cylinder, pose: tuple[Array, Array] | None = None) -> None:
        self._surface, self._pose = surface, pose
        self.flat = isinstance(surface, Plane) and pose is None

    def __call__(self, x: float, y: float) -> Placed:
        found = self._surface(x, y)
        if self._pose is None:
            return found
        turn, offset = self._pose
        return Placed(turn @ found.point + offset, turn @ found.normal, turn @ found.along_x, turn @ found.along_y)


def placement(skin: Skin, outline: Array, name: str) -> tuple[Placement, str]:
    """Where contacts are, as skin.toml says, and the name of the frame that they are given in. outline (n, 2) [m]: the
    sheet's. Raises ConfigError where the sheet does not fit round what it is said to be wrapped round.
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
    return Placement(surface, (rotation(pose.quaternion_xyzw), np.array(pose.position_m))), pose.parent
