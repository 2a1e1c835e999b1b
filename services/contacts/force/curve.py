"""A monotone curve from a touch's quantity to newtons, with a smooth correction for where it presses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TERMS = {
    "none": (),
    "radius": ("rr",),
    "tilt": ("x", "y"),
    "dish": ("x", "y", "rr"),
    "quadratic": ("x", "y", "xx", "xy", "yy"),
}
"""Location corrections by name: the terms of log(correction), u = x / reach, v = y / reach."""


def columns(names: tuple[str, ...], x: Array, y: Array, reach: float) -> Array:
    """(N, T) values of the terms at places [m]; places beyond `reach` count as those at it."""
    u, v = np.clip(x / reach, -1, 1), np.clip(y / reach, -1, 1)
    values = {"x": u, "y": v, "xx": u * u, "xy": u * v, "yy": v * v, "rr": u * u + v * v}
    return np.column_stack([values[n] for n in names]) if names else np.zeros((len(np.atleast_1d(x)), 0))


class Quantity(NamedTuple):
    """What a law's curve takes."""

    value: float
    relative: float | None  # standard uncertainty
    pressure: float | None = None  # Pa, of the shipped foam, where it is highest
    pressure_sigma: float | None = None


@dataclass(frozen=True)
class Curve:
    """newtons = scale * quantity^exponent * exp(coefficients . terms(x, y)); exponent above 0: monotone."""

    scale: float
    exponent: float = 1.0
    correction: str = "none"
    coefficients: tuple[float, ...] = ()
    reach: float = 1.0  # m from the skin's centre along x or y up to which the correction was fitted

    def __call__(self, quantity: float, x: float = 0.0, y: float = 0.0) -> float:
        if not quantity > 0:
            return 0.0
        log = columns(TERMS[self.correction], np.array([x]), np.array([y]), self.reach) @ np.array(self.coefficients)
        return float(self.scale * quantity**self.exponent * math.exp(float(log[0])))

    def to_dict(self) -> dict[str, Any]:
        return {
            "scale": self.scale,
            "exponent": self.exponent,
            "correction": self.correction,
            "coefficients": list(self.coefficients),
            "reach_m": self.reach,
        }

    @classmethod
    def from_dict(cls, found: Mapping[str, Any]) -> Curve:
        """Raises KeyError, TypeError or ValueError where `found` is no monotone curve."""
        name, given = str(found["correction"]), found["coefficients"]
        made = cls(
            float(found["scale"]), float(found["exponent"]), name, tuple(map(float, given)), float(found["reach_m"])
        )
        numbers = (made.scale, made.exponent, made.reach, *made.coefficients)
        if name not in TERMS or len(TERMS[name]) != len(made.coefficients) or not all(map(math.isfinite, numbers)):
            raise ValueError(f"correction {name!r} with {len(made.coefficients)} coefficients")
        if not (made.scale > 0 and made.exponent > 0 and made.reach > 0):
            raise ValueError("scale, exponent and reach_m must be above 0")
        return made
