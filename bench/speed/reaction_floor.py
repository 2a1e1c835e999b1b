"""What held touches of the reaction benchmark can be known to: Bayesian floors (models/fisher.py) of place and force.

The noise is that of the scans that were made of a touch until the middle of the time in which it is scored, averaged,
and of what the bundle's model is wrong by, which no average takes away.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.speed.reaction_events import HELD_S, UNIT_M, TouchEvent
from models.bundle import Bundle
from models.fisher import MeasurementNoise, SizePrior, floors, mean_floor
from models.shapes import Shape
from services.contacts.force import NEWTONS_PER_SIEMENS

SCAN_S = 0.0436
MOST = 40  # touches of a kind: each takes eight solves
PRIOR = SizePrior(radius=(0.05, 0.45))


def held_floor(of: Sequence[TouchEvent], snr_db: float) -> tuple[float, float]:
    """Root mean square over the touches: of place [m], of force [relative], which is as uncertain as the drop."""
    bundle, found = Bundle.load("square16"), []
    for event in of[:MOST]:
        scans = 1 + int((HELD_S + event.released - event.onset) / 2 / SCAN_S)
        relative = np.hypot(10 ** (-snr_db / 20) / np.sqrt(scans), bundle.matrices.model_error)
        touch = Shape(
            "circle",
            event.x / UNIT_M,
            event.y / UNIT_M,
            event.radius_m / UNIT_M,
            event.kind.force / NEWTONS_PER_SIEMENS,
        )
        noise = MeasurementNoise(-20 * float(np.log10(relative)))
        found.append(floors("square16", touch, noise, PRIOR, bundle.pattern)["bayes"])
    floor = mean_floor(found)
    return floor.position * UNIT_M, floor.drop
