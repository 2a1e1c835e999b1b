"""What a touch is to the measurements: a disc that acts, moves and changes, with its outline's, edge's and direction's
own ways to differ from one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from models.measurement import numbers as n
from models.measurement.arrays import Array

# Numbers of a disc's state. X, Y: centre at the reference instant [unit]. LOG_RADIUS. ACTION: drop / (1 - drop / 2)
# times the area [unit^2]: the measurements are linear in it, and tell it best. RATE: of ACTION [unit^2/s]. VX, VY
# [unit/s].
STATES = 7
X, Y, LOG_RADIUS, ACTION, RATE, VX, VY = range(STATES)
PLACE, VELOCITY = slice(X, Y + 1), slice(VX, VY + 1)

# Directions in which a touch of that area differs from a disc, as multiples of its action: outline's harmonics 2, 3
# and 4 (cosine and sine, relative to the radius), the square of the edge's width, the drop along x less that along y,
# and the drop that turns x into y.
PLAIN = 1e-3  # of what shapes differ by
MOST_ACTS = float(n.MOST_STRENGTH * np.pi * n.MOST_RADIUS**2)  # unit^2: nothing conducts in the largest
ANYWHERE_SD = 2.0  # unit: the sheet's width
EDGE = 2 * len(n.HARMONIC_SDS)
SHAPE_SDS: Array = np.array([*np.repeat(n.HARMONIC_SDS, 2), 1.0, n.TENSOR_SD, n.TENSOR_SD])
SHAPES = len(SHAPE_SDS)


@dataclass(frozen=True)
class TouchPrior:
    """What is known of a touch before a scan: a Gaussian of its state and of its shape, and its course.

    It acts from `since_s` to `until_s` only, and how strongly may change at once about `turns_s`, in seconds from the
    reference instant. grows: its action is that after `turns_s`, before which it was another; else it is that before.
    """

    start: Array  # (7,) where the search begins
    mean: Array  # (7,)
    sd: Array  # (7,)
    shape: Array = field(default_factory=lambda: np.zeros(SHAPES))
    shape_sd: Array = field(default_factory=lambda: SHAPE_SDS)
    since_s: float = -np.inf
    until_s: float = np.inf
    turns_s: float = np.inf
    grows: bool = False
    found: bool = False  # by a fit: the search begins where that ended


def anywhere(x: float, y: float, action: float, span_s: float) -> TouchPrior:
    """A touch that may be anywhere on the sheet, of any size, begin and move as touches do. span_s: of the scan."""
    action = max(action, n.LEAST_ACTION)
    start = np.array([x, y, np.log(n.TYPICAL_RADIUS), action, 0.0, 0.0, 0.0])
    mean = np.array([0.0, 0.0, np.log(n.TYPICAL_RADIUS), 0.0, 0.0, 0.0, 0.0])
    rate_sd, way_sd = n.BEGINS_WITHIN * action / span_s, n.NEW_WAY / span_s
    sd = np.array([ANYWHERE_SD, ANYWHERE_SD, n.AREA_LOG_SD, n.MOST_ACTION, rate_sd, way_sd, way_sd])
    return TouchPrior(start, mean, sd)


def acting_steadily(prior: TouchPrior, action: float, span_s: float) -> TouchPrior:
    """The same of a touch that acted so until it ended or changed at once: how it did is in its course's steps, for
    which a few values would mistake its action and rate.
    """
    start, mean, sd = prior.start.copy(), prior.mean.copy(), prior.sd.copy()
    start[ACTION] = mean[ACTION] = action
    start[RATE] = mean[RATE] = 0.0
    sd[ACTION] = n.STEADY * max(action, n.LEAST_ACTION)
    sd[RATE] = sd[ACTION] / span_s
    return replace(prior, start=start, mean=mean, sd=sd)


def plain(prior: TouchPrior) -> TouchPrior:
    """The same of a touch that is a disc, or whatever outline is known of it, and nothing else."""
    return replace(prior, shape_sd=PLAIN * SHAPE_SDS)


def is_anywhere(prior: TouchPrior) -> bool:
    """Whether nothing is known of its place."""
    return bool((prior.sd[PLACE] >= ANYWHERE_SD).all())


def is_plain(prior: TouchPrior) -> bool:
    return bool((prior.shape_sd <= PLAIN * SHAPE_SDS).all())


def is_disc(prior: TouchPrior) -> bool:
    """Whether it is plain, and no outline is known of it: its own directions make no difference."""
    return is_plain(prior) and not prior.shape.any()


def within_limits(states: Array) -> Array:
    """(T, 7) states moved to where touches can be."""
    limited = states.copy()
    limited[:, PLACE] = np.minimum(np.maximum(limited[:, PLACE], -n.SHEET), n.SHEET)
    limited[:, ACTION] = np.minimum(limited[:, ACTION], MOST_ACTS)
    limited[:, RATE] = np.minimum(np.maximum(limited[:, RATE], -MOST_ACTS / n.AT_ONCE_S), MOST_ACTS / n.AT_ONCE_S)
    acts = np.maximum(limited[:, ACTION], n.LEAST_ACTION)
    least = np.maximum(0.5 * np.log(acts / (np.pi * n.MOST_STRENGTH)), np.log(n.LEAST_RADIUS))
    limited[:, LOG_RADIUS] = np.minimum(np.maximum(limited[:, LOG_RADIUS], least), np.log(n.MOST_RADIUS))
    return limited


def area_of(log_radius: float) -> float:
    return float(np.pi * np.exp(2 * log_radius))


def drop_of(action: float, log_radius: float) -> float:
    """Drop of a disc that acts so."""
    strength = action / area_of(log_radius)
    return strength / (1 + strength / 2)
