"""What touches of the reaction benchmark can be known to, by noise alone.

held_floor: Bayesian floors (models/fisher.py) of place and force of touches that are held. The noise is that of the
scans that were made of a touch until the middle of the time in which it is scored, averaged, and of what the bundle's
model is wrong by, which no average takes away.

growing_floor: when the place of a touch whose force grows is first known to NEAR of the side, from the parts of scans
since it began, by the bundle's linear response and its noise, if the course of its force were known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bench.speed.reaction_events import HELD_S, NEAR, SIDE_M, UNIT_M, TouchEvent
from models.bundle import Bundle
from models.fisher import MeasurementNoise, SizePrior, floors, mean_floor
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.tables import tables_of
from models.pressure import FOAM, disc
from models.scan_limits import SIZES, touch_slopes
from models.shapes import Shape
from services.board.rolling_order import parts_of, rolling_order

SCAN_S = 0.0436
LONGEST_S = 0.3
MOST = 40  # touches of a kind: each takes eight solves
PRIOR = SizePrior(radius=(0.05, 0.45))
UNKNOWN = 1e-9  # information on what no value tells


def held_floor(of: Sequence[TouchEvent], snr_db: float) -> tuple[float, float]:
    """Root mean square over the touches: of place [m], of force [relative]."""
    bundle, found = Bundle.load("square16"), []
    for event in of[:MOST]:
        scans = 1 + int((HELD_S + event.released - event.onset) / 2 / SCAN_S)
        relative = np.hypot(10 ** (-snr_db / 20) / np.sqrt(scans), bundle.matrices.model_error)
        touch = Shape(
            "circle",
            event.x / UNIT_M,
            event.y / UNIT_M,
            event.radius_m / UNIT_M,
            _drop(event),
        )
        noise = MeasurementNoise(-20 * float(np.log10(relative)))
        found.append(floors("square16", touch, noise, PRIOR, bundle.pattern)["bayes"])
    floor = mean_floor(found)
    return floor.position * UNIT_M, floor.force


def _drop(event: TouchEvent) -> float:
    return FOAM.flat_drop(event.kind.force, disc(event.radius_m))


def _slopes(response: DiscResponse, event: TouchEvent) -> NDArray[np.float64]:
    """(K, 4) of log |Z| to x, y, log radius and log drop."""
    log_radius = float(np.log(event.radius_m / UNIT_M))
    return touch_slopes(response, event.x / UNIT_M, event.y / UNIT_M, log_radius, _drop(event))


def growing_floor(of: Sequence[TouchEvent], snr_db: float) -> NDArray[np.float64]:
    """(N * parts,) seconds from the beginning to that part's end, of touches that begin with any part of a scan."""
    bundle = Bundle.load("square16")
    response, order, parts = DiscResponse(tables_of(bundle)), rolling_order(bundle), parts_of(bundle)
    count = len(order) // parts
    noise, found = 10 ** (-snr_db / 20), []
    for event in of:
        slope = _slopes(response, event) / noise
        for first in range(parts):
            information = np.diag([UNKNOWN, UNKNOWN, *np.array(SIZES) ** -2.0])
            for n in range(int(LONGEST_S / SCAN_S * parts)):
                rows = order[(first + n) % parts * count :][:count]
                at = (n + (np.arange(count) + 0.5) / count) * SCAN_S / parts
                felt = slope[rows] * np.array([event.force(event.onset + t) / event.kind.force for t in at])[:, None]
                information = information + felt.T @ felt
                spread = np.linalg.inv(information)[:2, :2]
                if np.sqrt(np.trace(spread)) * UNIT_M <= NEAR * SIDE_M:
                    found.append((n + 1) * SCAN_S / parts)
                    break
            else:
                found.append(np.inf)
    return np.array(found)
