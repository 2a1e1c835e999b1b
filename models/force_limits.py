"""The smallest forces that a skin shows, and that it measures, by the radius of what presses.

Shown: the best disc of the estimator's grid has z^2 beyond FALSE_ALARM_Z2 in 99.9 % of whole scans soon after a tare,
over places and noise. Measured: from where the Bayesian floor of the force (models/fisher.py), its size unknown, is
below a quarter of it. Both are of one scan; a held touch is averaged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.bundle import Bundle
from models.fisher import MeasurementNoise, SizePrior, floors, mean_floor
from models.forward import shared
from models.measurement.numbers import CONTACT_START, FALSE_ALARM_Z2, FIELD_START
from models.measurement.tables import tables_of
from models.measurement.whitening import Whitening
from models.pressure import FOAM, disc
from models.shapes import Array, Shape

RADII_MM = (5.0, 10.0, 15.0, 20.0)
SIZES = SizePrior(radius=(0.1, 0.4), drop=(0.01, 0.97))  # model units, S/m: 5 to 20 mm on square16, 0.5 to 5 N
SHOWN = 0.999  # of the frames
SIGMA = 0.25  # of the force
LIGHT = 0.02  # S/m: a drop to which everything is linear
FIRST_N = 0.3  # the force that the floor is first looked at
DRAWS, PER_SIDE = 500, 4


@dataclass(frozen=True)
class SmallestForce:
    """Newtons, for one radius."""

    radius_mm: float
    shown_n: float
    measured_n: float


def places(skin: str, radius: float, per_side: int) -> Array:
    """(m, 2) grid points at which a touch of this radius lies wholly on the skin; model units."""
    line = (np.arange(per_side) + 0.5) * 2 / per_side - 1
    points = np.array([(x, y) for y in line for x in line])
    curve = shared(skin, "inverse").skin.curve
    return np.asarray(points[curve.inside(points) & (curve.distance(points) >= radius)])


def smallest(skin: str, noise: MeasurementNoise, radius_mm: float, per_side: int = PER_SIDE) -> SmallestForce:
    """Of a skin that has a bundle. Raises ValueError for a radius with no room, BundleError where there is none."""
    unit = shared(skin, "inverse").skin.metres_per_unit
    radius = radius_mm * 1e-3 / unit
    points = places(skin, radius, per_side)
    if not len(points):
        raise ValueError(f"no touch of radius {radius_mm:g} mm fits on skin '{skin}'")
    area = disc(radius_mm * 1e-3)
    light = FOAM.force("circle", LIGHT, area)
    return SmallestForce(
        radius_mm, light * _shown(skin, noise, radius, points), _measured(skin, noise, radius, points, area)
    )


def _shown(skin: str, noise: MeasurementNoise, radius: float, points: Array) -> float:
    """How many times LIGHT."""
    model, tables = shared(skin, "inverse"), tables_of(Bundle.load(skin))
    z0 = np.abs(model.solve(1.0).impedances())
    touched = [model.solve(model.touched([Shape("circle", x, y, radius, LIGHT)])).impedances() for x, y in points]
    signal = np.log(np.abs(touched) / z0)
    drift = np.hstack([tables.field * FIELD_START, tables.contact * (CONTACT_START / np.sqrt(noise.tare_frames))])
    cov = np.diag((noise.sigma(z0) / z0) ** 2 * (1 + 1 / noise.tare_frames)) + drift @ drift.T
    white, rng = Whitening.of(cov), np.random.default_rng(1)
    each = tables.grid.responses / np.sqrt(tables.grid.information(white))[:, None]
    free = each @ white.w.T @ rng.standard_normal((len(z0), DRAWS))  # z of each disc, untouched
    z = each @ white.solve(signal.T)
    low, high = 1e-3, 1e3
    while high / low > 1.005:
        times = np.sqrt(low * high)
        best = np.array([(times * of[:, None] + free).max(axis=0) for of in z.T])
        seen = float((np.maximum(best, 0) ** 2 > FALSE_ALARM_Z2).mean())
        low, high = (low, times) if seen >= SHOWN else (times, high)
    return float(high)


def _measured(skin: str, noise: MeasurementNoise, radius: float, points: Array, area: float) -> float:
    """Newtons. A light touch's error is the same however light, so the force follows from the error of another."""
    force = FIRST_N
    for _ in range(3):
        drop = FOAM.flat_drop(force, area)
        each = [floors(skin, Shape("circle", x, y, radius, drop), noise, SIZES)["bayes"] for x, y in points]
        force = max(force * mean_floor(each).force / SIGMA, 1e-3 * force)
    return float(force)
