"""The force law: from what is known of a touch to its normal force [N] and the force's standard uncertainty.

    force = curve(quantity) * correction(x, y)

The quantity is the pressure that the foam's drops stand for, summed over the touch's patch, in newtons of the shipped
foam (models/pressure.py; the default, whose curve changes nothing). Or it is the touch's peak drop [S/m], right for one
fixed indenter, or its integral over the patch [S/m m^2], as a bundle or a calibration of this very skin says
(services/calibration/force_fit.py). A touch is known from the measurements (of_disc.py), or, of a skin whose
measurements do not tell its touches, from its image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from models.bundle import Bundle
from models.pressure import FOAM, disc
from protocol.frames import EstimatedTouch
from services.contacts.force import calibration_file as calibration
from services.contacts.force import of_disc
from services.contacts.force.calibration_file import Of
from services.contacts.force.curve import Curve, Quantity
from services.contacts.force.of_disc import MEASURABLE, SATURATED, flat_drop
from services.runtime.config import ConfigError, Skin

NEWTONS_PER_SIEMENS = 10.0  # N per S/m, of a law that reads the peak: 0.1 to 0.5 S/m are 1 to 5 N
MOST_N = calibration.MOST_N
BACKGROUND = 1.0  # S/m, of the untouched sheet that the bundles' model has: no drop can be larger
FAR_BEYOND = 2.0  # times most_n: what nobody measured at half of it is no force any more
UNITS: dict[Of, str] = {"pressure": "N of pressure over the patch", "peak": "S/m", "integral": "S/m m^2"}
NAMES: dict[Of, str] = {"pressure": "pressure over the patch", "peak": "peak drop", "integral": "integrated drop"}


@dataclass(frozen=True)
class ImagePatch:
    """What an image shows of one touch, on the sheet."""

    peak: float  # S/m
    peak_sigma: float  # S/m, the network's own word; 0: it has none
    integral: float  # S/m m^2
    x: float  # m, centroid
    y: float


class Force(NamedTuple):
    newton: float | None
    sigma: float | None  # N
    pressure: float | None = None  # Pa, where it is highest; None: nobody knows
    pressure_sigma: float | None = None


NOTHING = Force(None, None)


@dataclass(frozen=True)
class ForceLaw:
    """The law of one skin. Where `curve` is None the skin has no law, and its forces are nil."""

    curve: Curve | None
    reads: Of = "pressure"
    most_n: float = MOST_N  # beyond it a force is extrapolated
    calibrated: bool = False  # of this very skin, not of its kind
    indenter_m2: float | None = None  # area of what presses, where it is known
    own_error: float = 0.0  # relative: scatter of the calibration's presses beyond what their uncertainties explain

    @classmethod
    def of(cls, skin: Skin, bundle: Bundle, name: str = "") -> ForceLaw:
        """The law of a skin: its calibration file's, else its bundle's, else the shipped foam's for bundles in S/m.

        name: what the skin is called, where that is known.

        Raises ConfigError for a calibration file that is none, or belongs to another skin or bundle, and for an
        indenter that cannot press this skin.
        """
        radius = known_radius(skin, bundle, name)
        area = None if radius is None else disc(radius)
        if skin.calibration is not None:
            found = calibration.load(skin.calibration, skin, bundle, name)
            area = area if found.tip_m is None else disc(found.tip_m)
            return cls(found.curve, found.reads, found.most_n, True, indenter_m2=area, own_error=found.own_error)
        law = bundle.manifest.get("force_law", {})
        if law is None or bundle.manifest["normalisation"] == "measured":
            if skin.reads is not None:
                raise ConfigError(
                    f"{_key(name, 'reads')}: found {skin.reads!r}, but drops of bundle {bundle.name} have no scale: "
                    "take `reads` out, and calibrate with `skin calibrate force`"
                )
            return cls(None, indenter_m2=area)
        try:
            own = _of_manifest(law)
            return cls(*(own if skin.reads in (None, own[1]) else _of_manifest({"of": skin.reads})), indenter_m2=area)
        except (KeyError, TypeError, ValueError) as why:
            raise ConfigError(f"{bundle.path}/manifest.json: force_law cannot be used ({why!r})") from None

    @property
    def exists(self) -> bool:
        return self.curve is not None

    def describe(self) -> dict[str, object] | None:
        """For info/<skin>."""
        if self.curve is None:
            return None
        described: dict[str, object] = {
            "kind": f"{'linear' if self.curve.exponent == 1.0 else 'power law'} in the {NAMES[self.reads]}",
            "of": self.reads,
            **self.curve.to_dict(),
            "most_n": self.most_n,
            "calibrated": self.calibrated,
            "known_indenter": self.indenter_m2 is not None and self.reads != "integral",
        }
        return {**described, "foam": FOAM.to_dict()} if self.reads == "pressure" else described

    def __str__(self) -> str:
        """For a person: `8.5 N per S/m, to 5 N`."""
        if self.curve is None:
            return "no force law"
        if self.reads == "pressure" and self.curve == Curve(1.0):
            return f"pressure summed over the patch, to {self.most_n:g} N"
        unit = UNITS[self.reads]
        if self.curve.exponent != 1:
            unit = f"({unit})^{self.curve.exponent:.2f}"
        located = "" if self.curve.correction == "none" else ", corrected for the place"
        return f"{self.curve.scale:.4g} N per {unit}, to {self.most_n:g} N{located}"

    def impossible(self, peak: float, newton: float | None) -> bool:
        """Whether no touch can have this peak drop [S/m] or force. Without a law drops have no scale, so nothing is
        impossible; a pressure summed over a broad patch may be any force.
        """
        if self.curve is None:
            return False
        return peak >= BACKGROUND or (self.reads != "pressure" and (newton or 0.0) > FAR_BEYOND * self.most_n)

    def saturates(self, pressure: float | None) -> bool:
        """Whether under this pressure [Pa] the foam tells no more: what presses so hard may press harder."""
        if self.curve is None or self.reads != "pressure" or pressure is None:
            return False
        return pressure >= self.curve.scale * float(FOAM.pressure(SATURATED))

    def quantity(self, patch: ImagePatch) -> Quantity:
        """What the curve takes, of an image's touch with a peak above 0; as sure as the image is of that peak."""
        relative = patch.peak_sigma / patch.peak if patch.peak_sigma > 0 else None
        if self.reads == "integral":
            return Quantity(patch.integral, relative)
        drop = patch.peak
        if self.indenter_m2 is not None:
            drop = flat_drop(patch.integral / (1 - min(drop, MEASURABLE) / 2) / self.indenter_m2)
        if self.reads == "peak":
            return Quantity(drop, relative)
        drop = min(drop, MEASURABLE)
        area = patch.integral / drop if self.indenter_m2 is None else self.indenter_m2
        pressure = float(FOAM.pressure(drop))
        spread = None if relative is None else relative * float(FOAM.gain(drop))
        return Quantity(pressure * area, spread, pressure, None if spread is None else pressure * spread)

    def of_touch(self, touch: EstimatedTouch, classes: Sequence[float] = ()) -> Force:
        """Force and standard uncertainty of a touch as the estimator has it. classes: of its shape, by an image."""
        if self.curve is None or not touch.strength > 0:
            return NOTHING
        return self._force(self._of_estimate(touch, classes), *touch.position)

    def _of_estimate(self, touch: EstimatedTouch, classes: Sequence[float]) -> Quantity:
        area = self.indenter_m2
        if self.reads == "pressure":
            return of_disc.force_of(touch, area, classes)
        relative = touch.strength_sigma / touch.strength
        if self.reads == "integral":
            return Quantity(touch.strength * (1 - min(touch.drop, 1.0) / 2), relative)
        drop = flat_drop(touch.strength / (math.pi * touch.radius_m**2 if area is None else area))
        return Quantity(drop, relative if area is not None else touch.drop_sigma / max(drop, 1e-9))

    def force(self, patch: ImagePatch) -> Force:
        """Force and standard uncertainty of a touch as an image shows it."""
        if self.curve is None or not (patch.peak > 0 and patch.integral > 0):
            return NOTHING
        return self._force(self.quantity(patch), patch.x, patch.y)

    def _force(self, found: Quantity, x: float, y: float) -> Force:
        """A quantity as a force, by the curve; the pressure goes with it."""
        assert self.curve is not None
        newton = self.curve(found.value, x, y)
        if not math.isfinite(newton):
            return NOTHING
        spread = math.hypot(self.curve.exponent * (found.relative or 0.0), self.own_error)
        sigma = newton * spread if spread > 0 else None
        if self.reads == "peak" and self.indenter_m2 is not None:
            return Force(newton, sigma, newton / self.indenter_m2, None if sigma is None else sigma / self.indenter_m2)
        if found.pressure is None or not found.value > 0:
            return Force(newton, sigma)
        grown = newton / found.value  # a foam of its own answers to the same drops by other pressures
        own = None if found.pressure_sigma is None else found.pressure_sigma * grown
        own = own if own is None else math.hypot(own, self.own_error * found.pressure * grown)
        return Force(newton, sigma, found.pressure * grown, own)


def _of_manifest(law: dict[str, Any]) -> tuple[Curve, Of, float]:
    """Curve, quantity and most newtons of what a manifest says. Raises KeyError, TypeError, ValueError."""
    most = float(law.get("most_n", MOST_N))
    reads = law.get("of", "peak" if "newtons_per_siemens" in law else "pressure")
    if reads == "integral":
        return Curve(float(law["newtons_per_siemens_metre"])), "integral", most
    if reads == "peak":
        return Curve(float(law.get("newtons_per_siemens", NEWTONS_PER_SIEMENS))), "peak", most
    if reads != "pressure":
        raise ValueError(f"of {reads!r}: expected pressure, peak or integral")
    return Curve(float(law.get("scale", 1.0))), "pressure", most


def _key(name: str, key: str) -> str:
    return f"skins.{name}.{key}" if name else key


def known_radius(skin: Skin, bundle: Bundle, name: str = "") -> float | None:
    """Radius [m] of the indenter; None where it is not known. Raises ConfigError where no such indenter can press this
    skin, or an image of it show it.
    """
    radius = calibration.indenter_radius(skin)
    if radius is None:
        return None
    outline = np.asarray(bundle.skin.get("outline", ()), float).reshape(-1, 2)
    half = float(np.ptp(outline, axis=0).min()) / 2 if len(outline) else float(bundle.skin.get("radius", 1.0))
    least, most = bundle.metres_per_pixel / 2, half * bundle.metres_per_unit
    if not least <= radius <= most * (1 + 1e-9):
        raise ConfigError(
            f"{_key(name, 'indenter.radius_m')}: found {radius:g} m; expected {least:.2g} to {most:.3g} m with bundle "
            f"{bundle.name}, from half a pixel of its images to half its shorter side: give the "
            "radius in metres, or take `indenter` out"
        )
    return radius
