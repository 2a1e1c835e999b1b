"""How foam answers to being pressed: conductivity drop from local pressure, and back (numpy only).

    drop = g(p):    slope * p                                    up to `knee`
                    1 - (1 - knee) exp(-(slope p - knee) / (1 - knee))   beyond: no pressure takes all of it away

Slope and value agree at the knee. The force of a touch is the pressure that its drops stand for, summed over its patch:
integral of g^-1(drop), whatever its size and shape. The shipped foam is anchored at the published press: a flat disc of
10 mm radius lowers the conductivity by 0.1 S/m for each newton.

Drops are of a sheet of 1 S/m, pressures Pa, lengths and areas metres unless a name says otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ANCHOR_M = 0.01  # radius of the disc that the published slope is of
ANCHOR_DROP = 0.1  # S/m that a newton on it makes
MOST_DROP = 1 - 1e-9  # S/m: beyond it pressure means nothing any more


@dataclass(frozen=True)
class Foam:
    """slope [S/m per Pa] up to `knee` [S/m], from where it saturates.

    Raises ValueError for a slope or a knee that no foam has.
    """

    slope: float = ANCHOR_DROP * math.pi * ANCHOR_M**2
    knee: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.slope < math.inf or not 0 < self.knee < MOST_DROP:
            raise ValueError(
                f"foam of slope {self.slope} S/m per Pa and knee {self.knee} S/m: expected a slope above 0 and a knee "
                f"above 0, below {MOST_DROP}"
            )

    def drop(self, pressure: ArrayLike) -> Array:
        """Drop [S/m] under pressures [Pa]; none under a pull."""
        linear = self.slope * np.maximum(np.asarray(pressure, dtype=float), 0.0)
        left = 1 - self.knee
        beyond = 1 - left * np.exp(np.minimum((self.knee - linear) / left, 0.0))
        return np.asarray(np.where(linear <= self.knee, linear, beyond))

    def pressure(self, drop: ArrayLike) -> Array:
        """Pressure [Pa] that makes a drop; of a drop beyond MOST_DROP, that of MOST_DROP."""
        seen = np.clip(np.asarray(drop, dtype=float), 0.0, MOST_DROP)
        left = 1 - self.knee
        beyond = self.knee - left * np.log((1 - np.maximum(seen, self.knee)) / left)
        return np.asarray(np.where(seen <= self.knee, seen, beyond) / self.slope)

    def gain(self, drop: ArrayLike) -> Array:
        """d log pressure / d log drop at a drop: by how much more uncertain the pressure is than its drop."""
        seen = np.clip(np.asarray(drop, dtype=float), 1e-9, MOST_DROP)
        left = 1 - self.knee
        steep = np.where(seen <= self.knee, 1.0, left / (1 - np.maximum(seen, self.knee)))
        return np.asarray(steep * seen / (self.slope * self.pressure(seen)))

    # -- flat contacts, and balls -----------------------------------------------------------------------------------
    def flat_drop(self, force: float, area: float) -> float:
        """Drop [S/m] of a flat contact of this area [m^2] under a force [N]."""
        return float(self.drop(force / area))

    def peak_drop(self, kind: str, force: float, area: float) -> float:
        """Of a contact of one of shapes.KINDS; in the middle of a Hertz contact pressure is 3/2 of the mean."""
        return self.flat_drop(1.5 * force if kind == "hertz" else force, area)

    def force(self, kind: str, drop: float, area: float) -> float:
        """Force [N] of a contact of one of shapes.KINDS, of this peak drop [S/m] and area [m^2]."""
        mean = 2 / 3 if kind == "hertz" else 1.0
        return mean * area * float(self.pressure(drop))

    def ball(self, drop: float, depth: ArrayLike) -> Array:
        """Drop, over that of the middle, where a Hertz contact's pressure is `depth` of the middle's (0 to 1)."""
        share = np.asarray(depth, dtype=float)
        if drop <= self.knee:
            return share
        return self.drop(share * self.pressure(drop)) / drop

    def ball_mean(self, drop: float) -> float:
        """Mean drop of a Hertz contact over that of its middle: 2/3 up to the knee."""
        return _ball_mean(self, float(drop)) if drop > self.knee else 2 / 3

    def to_dict(self) -> dict[str, float]:
        return {"slope_s_per_m_pa": self.slope, "knee_s_per_m": self.knee}


@lru_cache(maxsize=4096)
def _ball_mean(foam: Foam, drop: float) -> float:
    """integral of 2 s g(s p0) ds / g(p0), s = sqrt(1 - (r/R)^2) from 0 to 1, in closed form."""
    most = float(foam.slope * foam.pressure(drop))  # S/m, had the foam stayed linear
    knee, left = foam.knee / most, 1 - foam.knee
    rate = most / left
    linear = 2 / 3 * most * knee**3

    def antiderivative(s: float) -> float:  # of 2 s exp((knee - most s) / left)
        return -2 * (s / rate + 1 / rate**2) * math.exp((foam.knee - most * s) / left)

    saturated = (1 - knee**2) - left * (antiderivative(1.0) - antiderivative(knee))
    return (linear + saturated) / drop


FOAM = Foam()
"""What the stub presses, scenes and data are made by, limits are stated for, and forces are read by unless a skin was
calibrated.
"""


def disc(radius: float) -> float:
    """Area of a disc, in the square of the radius's unit."""
    return math.pi * radius**2
