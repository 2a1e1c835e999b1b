"""Force and peak pressure of a touch from its image: the foam's pressure, summed over a patch of unknown size.

An image keeps how strongly a touch acts on the measurements, S = area * drop / (1 - drop / 2) of a flat patch (a
cylinder's polarisability), and confounds area with drop. A patch of radius R that acts so strongly has one drop h(R),
and so one force, pi R^2 g^-1(h(R)). The touch's force is the mean of these over the sizes that it may have: the stated
prior, and how far the image's peak is from what a patch of that size would show,

    log peak = (1 - b) log h(R) + b log h(small) - log(1 + (blur / R)^2) +- t        b, t grow with the peak's sigma^2

because an image cannot be sharper than its blur, and one that noise leaves undecided looks like a small strong touch.
The standard deviation over the sizes is what the unknown size leaves open; the strength's own error adds to it. A patch
that may have saturated has a force from below only: its sigma reaches to where the foam tells nothing any more.

The constants were measured on the mesh "stub" at 80 dB, on discs of 5, 10, 15 and 20 mm; those of the strength's error
are near the likeliest of 3300 presses there (discs at 70, 80 and 90 dB, every kind of shape from 62 dB to none), and
wide enough that each of these kinds has 99.5 % within three sigma: some 80 % then fall within one, since errors have
heavier tails than a normal distribution. What keeps the sigma from the floor of `skin limits` is what a network makes
of a touch: its strength errs by 4 to 5 % (root mean square), however little noise there is, and by another amount at
each place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.pressure import FOAM, Foam, disc

Array = NDArray[np.float64]

SIZES_M = (0.005, 0.02)  # radius: as likely anywhere between in its logarithm
OUTSIDE = 0.15  # standard deviation of the logarithm of a radius beyond
LEAST_M, MOST_M, STEPS = 0.004, 0.025, 41  # radii that are summed over
BLUR_PIXELS = 2.0  # of an image
TOWARDS = 3.0  # b over the square of the peak's relative sigma
MOST_TOWARDS = 0.8
SMALL_M = 0.006  # what an image makes of a touch that noise hides the size of
UNSURE, LEAST_UNSURE = 2.0, 0.1  # t over that square, and at least
OWN = 0.9  # of the word of the bundle's map for the integral's error, which is of all shapes
WEAK = 0.4  # of that square: relative error of the strength beyond the map
FAINT, TRAINED = 0.1, 0.075  # more of it, the further the drop [S/m] is below the least that training shows
STRONG = 0.7  # of the drop times (blur / R)^2: relative error of the strength of a patch whose edge the image blurs
UNMAPPED = 0.04  # relative error of the strength where nobody measured it
UNTOLD = 0.3  # relative sigma of a peak where the network says none
SATURATED = 0.76  # S/m: a touch of such a drop may press harder than it shows
BLIND = 0.82  # S/m: a drop beyond it may as well be any up to FULL
TOLD, FULL = 0.97, 0.995  # S/m: no image tells more; no foam gives more
NODES = ((-math.sqrt(3), 1 / 6), (0.0, 2 / 3), (math.sqrt(3), 1 / 6))  # Gauss and Hermite: a normal variable's


class Shown(NamedTuple):
    """What an image shows of a touch, in metres and S/m."""

    integral: float  # S/m m^2, the faint rest of the image included
    peak: float
    peak_sigma: float  # 0: nobody says
    strength_sigma: float | None  # relative, of the integral; None: nobody measured it
    pixel: float  # m


@dataclass(frozen=True)
class PatchForce:
    """Means and standard deviations over the sizes that the touch may have."""

    force: float  # N
    force_sigma: float
    pressure: float  # Pa, where it is highest
    pressure_sigma: float


def of_image(shown: Shown, foam: Foam = FOAM) -> PatchForce:
    """The force of a touch of unknown size. shown.integral and shown.peak above 0."""
    radius = np.geomspace(LEAST_M, MOST_M, STEPS)
    area = disc(1.0) * radius**2
    relative = shown.peak_sigma / shown.peak if shown.peak_sigma > 0 else UNTOLD
    peak = min(shown.peak, TOLD)
    blurred = (BLUR_PIXELS * shown.pixel / radius) ** 2
    strength = shown.integral / (1 - peak / 2) / area
    drop = _drop(strength)
    weight = _prior(radius) * _likelihood(radius, drop, peak, relative, blurred)
    weight /= weight.sum()
    own = UNMAPPED if shown.strength_sigma is None else OWN * shown.strength_sigma
    faint = FAINT * np.maximum(0.0, 1 - drop / TRAINED)
    unsure = np.sqrt(own**2 + (WEAK * relative**2) ** 2 + faint**2 + (STRONG * drop * blurred) ** 2)
    drops = np.array([_drop(strength * np.exp(z * unsure)) for z, _ in NODES])
    pressure = foam.pressure(drops)
    both = np.outer([share for _, share in NODES], weight)
    most = (float(foam.pressure(FULL)) - foam.pressure(drop)) * (drop > BLIND)
    force, force_sigma = _moments(pressure * area, both, math.sqrt(float(weight @ (most * area) ** 2 / 3)))
    highest, highest_sigma = _moments(pressure, both, math.sqrt(float(weight @ most**2 / 3)))
    highest_sigma = math.hypot(highest_sigma, relative * highest)  # what the network says of the peak counts too
    return PatchForce(force, force_sigma, highest, highest_sigma)


def _drop(strength: Array) -> Array:
    """Drop of a flat patch that acts as strongly, per area."""
    return np.clip(strength / (1 + strength / 2), 1e-9, TOLD)


def _prior(radius: Array) -> Array:
    low, high = (np.log(radius / each) for each in SIZES_M)
    return np.asarray(np.exp(-0.5 * (np.maximum(np.maximum(-low, high), 0.0) / OUTSIDE) ** 2))


def _likelihood(radius: Array, drop: Array, peak: float, relative: float, blurred: Array) -> Array:
    """Of the image's peak, for each size."""
    towards = min(TOWARDS * relative**2, MOST_TOWARDS)
    log = np.log(drop)
    small = float(np.interp(math.log(SMALL_M), np.log(radius), log))
    expected = (1 - towards) * log + towards * small - np.log1p(blurred)
    misfit = ((math.log(peak) - expected) / math.hypot(UNSURE * relative**2, LEAST_UNSURE)) ** 2
    return np.asarray(np.exp(-0.5 * (misfit - misfit.min())))


def _moments(values: Array, weight: Array, beyond: float) -> tuple[float, float]:
    mean = float((weight * values).sum())
    variance = float((weight * (values - mean) ** 2).sum())
    return mean, math.sqrt(variance + beyond**2)
