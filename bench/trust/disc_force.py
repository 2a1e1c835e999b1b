"""Newtons of a touch that was fitted as a disc, as a mean over the patches that act on the measurements as it does.

The measurements tell how strongly a touch acts, and how far its drops spread about their middle. A patch of area A
spreads as a disc of area `spread` A, and acts as a disc of its own area and drop h and a share `beyond` h^4 more (an
ellipse of aspect 2 by its exact polarisability; the rest were solved by finite elements). An edge that is soft by w
(standard deviation) adds 4 w^2 to the square of a disc's radius and keeps the drop's integral. So the same disc may be
a smaller patch that is pressed harder: little where foam answers linearly, all there is to know where it saturates.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.pressure import FOAM
from services.contacts import patch_force
from services.estimation.values.estimate import TouchEstimate

Array = NDArray[np.float64]


class PatchKind(NamedTuple):
    """What a touch may be."""

    share: float  # of touches
    spread: float  # mean square of its radius over that of a disc of its area
    beyond: float  # relative, of its action, where nothing conducts


PATCHES = (
    PatchKind(0.67, 1.0, 0.0),  # discs
    PatchKind(0.22, 1.25, 0.15),  # triangles, rectangles and ellipses of aspect 2: 1.21 to 1.31, 0.12 to 0.17
    PatchKind(0.11, 1.53, 0.3),  # an L
)
EDGES = ((0.85, 0.0), (0.05, 1.5e-3), (0.05, 2.2e-3), (0.05, 3e-3))  # share of skins, and how soft [m]
ACTION_SIGMA = 0.025  # relative: of the response of discs, 0.98 to 1.04 on another mesh
MOST_ACTS = 2.2  # action over area: 2 where nothing conducts, and that response's error
SPREAD = np.linspace(-2.4, 2.4, 9)  # sigmas of radius and action that are summed over
WEIGHT = np.exp(-(SPREAD**2) / 2) / np.exp(-(SPREAD**2) / 2).sum()
CREEPS, CREEPS_S = 0.05, 20.0  # relative: foam that yields while it is pressed, of a minute, and when


class Discs(NamedTuple):
    """Patches as the fit allows, flat."""

    weight: Array
    area: Array  # unit^2
    drop: Array


def force_of(touch: TouchEstimate, metres_per_unit: float) -> tuple[float, float]:
    """Newtons and their sigma: the foam's pressure at a patch's drop over its area, a mean over the radii and actions
    that the fit leaves, and over PATCHES and EDGES. A patch that may have saturated has a force from below only: its
    sigma reaches to where the foam tells nothing more.
    """
    found = [
        _through(_seen_as(touch, patch), edge / metres_per_unit, share) for patch in PATCHES for share, edge in EDGES
    ]
    weight = np.concatenate([each.weight for each in found])
    if not weight.any():  # more than any patch does: a disc that conducts nothing
        disc = _seen_as(touch, PATCHES[0])
        found, weight = [disc], np.ones(disc.area.size) / disc.area.size
    weight = weight / weight.sum()
    square_metres = np.concatenate([each.area for each in found]) * metres_per_unit**2
    drop = np.minimum(np.concatenate([each.drop for each in found]), patch_force.FULL)
    pressure = FOAM.pressure(drop)
    forces = square_metres * pressure
    most = square_metres * (FOAM.pressure(patch_force.FULL) - pressure) * (drop > patch_force.BLIND)
    mean = float(weight @ forces)
    spread = float(weight @ ((forces - mean) ** 2 + most**2 / 3))
    creeps = CREEPS * (1 - math.exp(-touch.age_s / CREEPS_S))
    return mean, math.sqrt(spread + (creeps * mean) ** 2)


def _seen_as(touch: TouchEstimate, patch: PatchKind) -> Discs:
    """Patches of sharp edges that spread and act as the touch does."""
    radius_sd = math.sqrt(max(touch.covariance[2, 2], 0.0))
    action_sd = math.hypot(touch.strength_sd, ACTION_SIGMA * touch.strength)
    log_radius = touch.log_radius + radius_sd * SPREAD[:, None]
    area = math.pi * np.exp(2 * log_radius) / patch.spread
    seen = np.maximum(touch.strength + action_sd * SPREAD, 0.0) / area
    acts = seen
    for _ in range(2):
        acts = seen / (1 + patch.beyond * np.minimum(_drop(acts), 1.0) ** 4)
    weight = patch.share * WEIGHT[:, None] * WEIGHT * (acts < MOST_ACTS)
    return Discs(weight.ravel(), np.broadcast_to(area, acts.shape).ravel(), np.minimum(_drop(acts), 1.0).ravel())


def _through(seen: Discs, edge: float, share: float) -> Discs:
    """The same whose edges are soft by `edge` [unit]: patches that are smaller, of as much drop in all."""
    if not edge:
        return seen._replace(weight=share * seen.weight)
    area = np.maximum(seen.area - 4 * math.pi * edge**2, 1e-9)
    drop = seen.drop * seen.area / area
    return Discs(share * seen.weight * (drop < 1.0), area, np.minimum(drop, 1.0))


def _drop(acts: Array) -> Array:
    return acts / (1 + acts / 2)
