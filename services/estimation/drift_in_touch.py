"""Drift that is read from a touched frame: how the frame is explained, and how the baseline moves by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import PreReconstructor
from services.estimation.drift import DriftProcess
from services.estimation.evidence import Explanation, TouchEvidence
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]


def explain(
    evidence: TouchEvidence, d: Array, variance: Array, live: NDArray[np.bool_], since_s: float, creep: Array | None
) -> Explanation:
    """A difference (K,) of this variance (K,), by touches and by as much drift as `since_s` seconds permit. creep (K,):
    d of a touch that may have left something behind.
    """
    physics = evidence.physics
    prior = DriftProcess.of_skin(physics.electrodes, creep=False).value_covariance(since_s)
    columns = physics.columns(d)
    if creep is not None:
        columns = np.column_stack([columns, creep])
        prior = np.pad(prior, (0, 1))
        prior[-1, -1] = TUNING.creep_sd**2
    error = np.diag(np.where(live, variance, 0.0) + TUNING.absolute**2)
    return evidence(d, error, columns, prior, live)


def drifted(
    z0: Array, normaliser: NDArray[np.floating], pre: PreReconstructor, drift: Array, creep: Array | None
) -> Array:
    """|Z0| (K,) after a drift in the order of `explain`'s columns."""
    change = pre.m.contact @ drift[1 : 1 + pre.m.contact.shape[1]]
    if creep is not None:
        change = change + creep * drift[-1]
    moved = (z0 + normaliser * change) / (1 - drift[0])
    return np.where(z0 > 0, np.maximum(moved, 0.0), 0.0)
