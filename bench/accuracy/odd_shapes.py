"""Touches of shapes that neither the network nor a fit knows: an ellipse, a ring, a crescent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.forward import ForwardModel
from models.shapes import Array

ODD = ("ellipse", "ring", "crescent")
FLAT, HOLE, BITE = 0.45, 0.55, 0.6  # short over long axis; inner over outer radius; how far the bite's centre is off
FINE = 6  # points along an element's side, at which its share is sampled


@dataclass(frozen=True)
class OddShape:
    """Within the circle of `radius` about (x, y), model units; drop S/m."""

    kind: str
    x: float
    y: float
    radius: float
    drop: float
    rotation: float

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Of points (..., 2)."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        x, y = ((points - (self.x, self.y)) / self.radius @ np.array([[c, -s], [s, c]])).transpose(
            -1, *range(points.ndim - 1)
        )
        inside = x**2 + (y / (FLAT if self.kind == "ellipse" else 1.0)) ** 2 < 1
        if self.kind == "ring":
            inside &= x**2 + y**2 > HOLE**2
        if self.kind == "crescent":
            inside &= (x - BITE) ** 2 + y**2 > 0.7
        return np.asarray(inside)

    def fraction(self, n: int, fine: int = 5) -> Array:
        """(n, n) share of each pixel of [-1, 1]^2 that it covers."""
        axis = -1 + 2 * (np.arange(n * fine) + 0.5) / (n * fine)
        points = np.stack(np.meshgrid(axis, axis), axis=-1)
        return np.asarray(self.contains(points).reshape(n, fine, n, fine).mean(axis=(1, 3)))

    def conductivity(self, model: ForwardModel) -> Array:
        """(n_elements,) S of a sheet of 1 S."""
        i, j = np.array([(i, j) for i in range(FINE) for j in range(FINE - i)]).T
        weight = (np.stack([i, j, FINE - 1 - i - j]) + 1 / 3) / FINE
        corners = model.mesh.p.T[model.mesh.t.T]  # (n_elements, 3, 2)
        return np.asarray(1 - self.drop * self.contains(np.einsum("kp,ekc->epc", weight, corners)).mean(axis=1))


def random_odd(rng: np.random.Generator, kind: str) -> OddShape:
    """As training draws its own kinds: wholly on the square skin."""
    radius = float(rng.uniform(0.15, 0.45))
    x, y = rng.uniform(-1 + radius, 1 - radius, 2)
    return OddShape(kind, float(x), float(y), radius, float(rng.uniform(0.1, 0.5)), float(rng.uniform(0, 2 * np.pi)))
