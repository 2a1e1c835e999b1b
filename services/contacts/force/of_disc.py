"""Newtons of a touch that was fitted as a disc, as a mean over the patches that act on the measurements as it does.

The measurements tell how strongly a touch acts, and how far its drops spread about their middle. A patch of area A
spreads as a disc of area `spread` A, and acts as a disc of its own area and drop h and a share `beyond` h^4 more (an
ellipse of aspect 2 by its exact polarisability; the rest were solved by finite elements). An edge that is soft by w
(standard deviation) adds 4 w^2 to the square of a disc's radius and keeps the drop's integral. So the same disc may be
a smaller patch that is pressed harder: little where foam answers linearly, all there is to know where it saturates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from models.pressure import FOAM
from protocol.frames import SHAPES, EstimatedTouch
from services.contacts.force.curve import Quantity

Array = NDArray[np.float64]
Acts = TypeVar("Acts", float, NDArray[np.float64])


class PatchKind(NamedTuple):
    """What a touch may be."""

    share: float  # of touches
    spread: float  # mean square of its radius over that of a disc of its area
    beyond: float  # relative, of its action, where nothing conducts
    names: tuple[str, ...]  # of SHAPES


PATCHES = (
    PatchKind(0.67, 1.0, 0.0, ("circle", "square")),
    PatchKind(0.22, 1.25, 0.15, ("triangle", "rectangle")),  # 1.21 to 1.31, 0.12 to 0.17, and ellipses of aspect 2
    PatchKind(0.11, 1.53, 0.3, ("L",)),
)
SATURATED = 0.76  # S/m: a touch of such a drop may press harder than it shows
BLIND = 0.82  # S/m: a drop beyond it may as well be any up to FULL
MEASURABLE, FULL = 0.97, 0.995  # S/m: nothing tells more; no foam gives more
IMAGE_SHARE = 0.85  # of what an image says of the shape, against those shares
EDGES = ((0.85, 0.0), (0.05, 1.5e-3), (0.05, 2.2e-3), (0.05, 3e-3))  # share of skins, and how soft [m]
ACTION_SIGMA = 0.025  # relative: of the response of discs, 0.98 to 1.04 on another mesh
MOST_ACTS = 2.2  # action over area: 2 where nothing conducts, and that response's error
SPREAD = np.linspace(-2.4, 2.4, 9)  # sigmas of radius and action that are summed over
WEIGHT = np.exp(-(SPREAD**2) / 2) / np.exp(-(SPREAD**2) / 2).sum()
LEAST_RADIUS_M, LEAST_AREA = 1e-4, 1e-8  # m, m^2: no touch is smaller
CREEPS, CREEPS_S = 0.05, 20.0  # relative: foam that yields while it is pressed, of a minute, and when


class Discs(NamedTuple):
    """Patches as the fit allows, flat."""

    weight: Array
    area: Array  # m^2
    drop: Array


def force_of(touch: EstimatedTouch, area: float | None, classes: Sequence[float]) -> Quantity:
    """Force [N]: the shipped foam's pressure at a patch's drop over its area, a mean over the radii and actions that
    the fit leaves, and over PATCHES and EDGES. A patch that may have saturated has a force from below only: its sigma
    reaches to where the foam tells nothing more. area [m^2]: of what presses, where it is known. classes:
    probabilities of SHAPES by an image; empty: none tells.
    """
    if area is not None:
        each = _of_area(touch.strength, touch.strength_sigma, area)
    else:
        each = _of_any_patch(touch, classes)
    weight = each.weight / each.weight.sum()
    drop = np.minimum(each.drop, FULL)
    pressure = FOAM.pressure(drop)
    beyond = (float(FOAM.pressure(FULL)) - pressure) * (drop > BLIND)
    creeps = CREEPS * (1 - math.exp(-max(touch.age_s, 0.0) / CREEPS_S))
    force, sigma = _moments(each.area * pressure, weight, each.area * beyond, creeps)
    return Quantity(force, sigma / force, *_moments(pressure, weight, beyond, creeps))


def _moments(values: Array, weight: Array, beyond: Array, creeps: float) -> tuple[float, float]:
    """Mean and standard deviation; beyond: by how much more each may be; creeps: relative, of them all."""
    mean = float(weight @ values)
    variance = float(weight @ ((values - mean) ** 2 + beyond**2 / 3))
    return mean, math.sqrt(variance + (creeps * mean) ** 2)


def _of_area(strength: float, sigma: float, area: float) -> Discs:
    """Under an indenter of known area: only how strongly it acts is open."""
    action_sd = math.hypot(sigma, ACTION_SIGMA * strength)
    seen = np.maximum(strength + action_sd * SPREAD, 0.0) / area
    drop = np.minimum(flat_drop(seen), MEASURABLE)
    return Discs(WEIGHT, np.full(drop.shape, area), drop)


def _of_any_patch(touch: EstimatedTouch, classes: Sequence[float]) -> Discs:
    """Under what nobody knows: any of PATCHES, with any of EDGES."""
    patches: tuple[PatchKind, ...] = PATCHES
    if classes:  # what an image shows of the shape
        shown = [sum(classes[SHAPES.index(name)] for name in patch.names) for patch in PATCHES]
        shares = [IMAGE_SHARE * s + (1 - IMAGE_SHARE) * patch.share for s, patch in zip(shown, PATCHES, strict=True)]
        patches = tuple(patch._replace(share=share) for patch, share in zip(PATCHES, shares, strict=True))
    sharp = [_seen_as(touch, patch) for patch in patches]
    found = [_through(seen, edge, share) for seen in sharp for share, edge in EDGES]
    each = Discs(*map(np.concatenate, zip(*found, strict=True)))
    if not each.weight.any():  # more than any patch does: a disc that conducts nothing
        return sharp[0]._replace(weight=np.ones(sharp[0].area.size) / sharp[0].area.size)
    return each


def pressure_under(strength: float, sigma: float, area: float) -> float:
    """Pressure summed over an indenter of this area [m^2] [N], as `force_of` has it; strength and sigma: of how it
    acts, drop times m^2.
    """
    each = _of_area(strength, sigma, area)
    return float(each.weight @ (each.area * FOAM.pressure(each.drop)))


def _seen_as(touch: EstimatedTouch, patch: PatchKind) -> Discs:
    """Patches of sharp edges that spread and act as the touch does."""
    action_sd = math.hypot(touch.strength_sigma, ACTION_SIGMA * touch.strength)
    log_radius = math.log(max(touch.radius_m, LEAST_RADIUS_M)) + touch.radius_sigma * SPREAD[:, None]
    area = math.pi * np.exp(2 * log_radius) / patch.spread
    seen = np.maximum(touch.strength + action_sd * SPREAD, 0.0) / area
    acts = seen
    for _ in range(2):
        acts = seen / (1 + patch.beyond * np.minimum(flat_drop(acts), 1.0) ** 4)
    weight = patch.share * WEIGHT[:, None] * WEIGHT * (acts < MOST_ACTS)
    return Discs(weight.ravel(), np.broadcast_to(area, acts.shape).ravel(), np.minimum(flat_drop(acts), 1.0).ravel())


def _through(seen: Discs, edge: float, share: float) -> Discs:
    """The same whose edges are soft by `edge` [m]: patches that are smaller, of as much drop in all."""
    if not edge:
        return seen._replace(weight=share * seen.weight)
    area = np.maximum(seen.area - 4 * math.pi * edge**2, LEAST_AREA)
    drop = seen.drop * seen.area / area
    return Discs(share * seen.weight * (drop < 1.0), area, np.minimum(drop, 1.0))


def flat_drop(acts: Acts) -> Acts:
    """Drop [S/m] of a flat patch that acts on the measurements so strongly, per area (a cylinder's polarisability)."""
    return acts / (1 + acts / 2)
