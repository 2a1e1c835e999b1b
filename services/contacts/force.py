"""The force law: from what an image shows of a touch to its normal force [N] and the force's standard uncertainty.

    force = curve(quantity) * correction(x, y)

The quantity is the touch's peak conductivity drop [S/m] or its integral over the patch [S/m m^2]. The curve is the
kind's default (0.1 to 0.5 S/m are 1 to 5 N), the bundle's own, or the one that a calibration of this very skin fitted
(services/calibration/force_fit.py). An image confounds peak and area. Where the configuration knows the indenter, the
peak follows from the integral and the known area instead (models/uncertainty.py). The quantity's uncertainty was found
on presses that the bundle's network never saw; the bundle holds it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from models import uncertainty
from models.bundle import NETWORKS, Bundle
from models.uncertainty import Map
from protocol.frames import ImageFrame, RefinedTouch
from services.contacts import calibration_file as calibration
from services.contacts.calibration_file import Of
from services.contacts.force_curve import Curve
from services.contacts.segmentation import Segment
from services.runtime.config import ConfigError, Skin

NEWTONS_PER_SIEMENS = 10.0  # N per S/m: 0.1 to 0.5 S/m are 1 to 5 N
MOST_N = calibration.MOST_N
BACKGROUND = 1.0  # S/m, of the untouched sheet that the bundles' model has: no drop can be larger
FAR_BEYOND = 2.0  # times most_n: what nobody measured at half of it is no force any more


@dataclass(frozen=True)
class Look:
    """What an image shows of one touch, in the skin's frame."""

    peak: float  # S/m
    peak_sigma: float  # S/m, the network's own word; 0: it has none
    integral: float  # S/m m^2
    area: float  # m^2, of what exceeds half the peak
    x: float  # m, centroid
    y: float
    noise: float | None  # relative, of the measurements that the image was made of

    @classmethod
    def of(cls, s: Segment, frame: ImageFrame) -> Look:
        m, (x, y) = frame.metres_per_pixel, frame.origin
        place = x + (s.x + 0.5) * m, y + (s.y + 0.5) * m
        return cls(s.peak, s.peak_sigma, s.volume * m * m, s.area * m * m, *place, frame.noise)


class Force(NamedTuple):
    newton: float | None
    sigma: float | None  # N


NOTHING = Force(None, None)


@dataclass(frozen=True)
class ForceLaw:
    """The law of one skin. Where `curve` is None the skin has no law, and its forces are nil."""

    curve: Curve | None
    reads: Of = "peak"
    most_n: float = MOST_N  # beyond it a force is extrapolated
    calibrated: bool = False  # of this very skin, not of its kind
    metres_per_unit: float = 1.0
    half_width: float = 1.0  # model units: where the image ends
    indenter_area: float | None = None  # model units squared
    maps: dict[str, Map] = field(default_factory=dict)
    own_error: float = 0.0  # relative: what the calibration's own presses scatter by beyond what their images explain

    @classmethod
    def of(cls, skin: Skin, bundle: Bundle, name: str = "") -> ForceLaw:
        """The law of a skin: its calibration file's, else its bundle's, else the default of bundles in S/m.

        name: what the skin is called, where that is known.

        Raises ConfigError for a calibration file that is none, or belongs to another skin or bundle, and for an
        indenter that cannot press this skin.
        """
        surroundings = _surroundings(skin, bundle, name)
        if skin.calibration is not None:
            found = calibration.load(skin.calibration, skin, bundle, name)
            return cls(found.curve, found.reads, found.most_n, True, own_error=found.own_error, **surroundings)
        law = bundle.manifest.get("force_law", {})
        if law is None or bundle.manifest["normalisation"] == "measured":
            return cls(None, **surroundings)
        try:
            reads: Of = "integral" if law.get("of", "peak") == "integral" else "peak"
            slope = (
                law["newtons_per_siemens_metre"]
                if reads == "integral"
                else law.get("newtons_per_siemens", NEWTONS_PER_SIEMENS)
            )
            return cls(Curve(float(slope)), reads, float(law.get("most_n", MOST_N)), **surroundings)
        except (KeyError, TypeError, ValueError) as why:
            raise ConfigError(f"{bundle.path}/manifest.json: force_law cannot be used ({why!r})") from None

    @property
    def exists(self) -> bool:
        return self.curve is not None

    def describe(self) -> dict[str, object] | None:
        """For info/<skin>."""
        if self.curve is None:
            return None
        return {
            "kind": f"{self.curve.kind} in the {'peak drop' if self.reads == 'peak' else 'integrated drop'}",
            "of": self.reads,
            **self.curve.to_dict(),
            "most_n": self.most_n,
            "calibrated": self.calibrated,
            "known_indenter": self.indenter_area is not None and self.reads == "peak",
        }

    def __str__(self) -> str:
        """For a person: `8.5 N per S/m, to 5 N`."""
        if self.curve is None:
            return "no force law"
        unit = "S/m" if self.reads == "peak" else "S/m m^2"
        if self.curve.exponent != 1:
            unit = f"({unit})^{self.curve.exponent:.2f}"
        located = "" if self.curve.correction == "none" else ", corrected for the place"
        return f"{self.curve.scale:.4g} N per {unit}, to {self.most_n:g} N{located}"

    def impossible(self, peak: float, newton: float | None) -> bool:
        """Whether no touch can have this peak drop [S/m] or force. Without a law drops have no scale, so nothing is
        impossible.
        """
        if self.curve is None:
            return False
        return peak >= BACKGROUND or (newton or 0.0) > FAR_BEYOND * self.most_n

    def quantity(self, look: Look) -> tuple[float, float | None]:
        """(value of the curve's quantity, its relative standard uncertainty or None)."""
        unit = self.metres_per_unit
        edge = self.half_width - max(abs(look.x), abs(look.y)) / unit
        seen = uncertainty.ImageFeatures(
            np.array([look.peak]),
            np.array([look.peak_sigma]),
            np.array([look.integral / unit**2]),
            np.array([look.area / unit**2]),
            np.array([edge]),
            np.array([look.noise or 0.0]),
        )
        known = self.indenter_area is not None and self.reads == "peak"
        name = "known" if known else self.reads
        value = float(uncertainty.estimate(name, seen, self.indenter_area)[0])
        factor, relative = 1.0, None
        if name in self.maps and look.noise is not None:
            each = self.maps[name](uncertainty.features(name, seen, self.indenter_area))
            factor, relative = float(each[0][0]), float(each[1][0])
        elif look.peak_sigma > 0 and look.peak > 0:  # nothing better is known than what the network says
            relative = look.peak_sigma / look.peak
        return value * factor * (unit**2 if self.reads == "integral" else 1.0), relative

    def of_fit(self, touch: RefinedTouch) -> Force:
        """Force and standard uncertainty of a touch that was fitted to the measurements."""
        peak = self.reads == "peak"
        value, sigma = (touch.drop, touch.drop_sigma) if peak else (touch.integral, touch.integral_sigma)
        if self.curve is None or not value > 0:
            return NOTHING
        newton = self.curve(value, *touch.position)
        spread = math.hypot(self.curve.exponent * sigma / value, self.own_error)
        return Force(newton, newton * spread) if math.isfinite(newton) else NOTHING

    def force(self, look: Look) -> Force:
        """Force and standard uncertainty of one touch."""
        if self.curve is None or not look.peak > 0:
            return NOTHING
        value, relative = self.quantity(look)
        newton = self.curve(value, look.x, look.y)
        if not math.isfinite(newton):
            return NOTHING
        spread = math.hypot(self.curve.exponent * (relative or 0.0), self.own_error)
        return Force(newton, newton * spread if spread > 0 else None)


def known_radius(skin: Skin, bundle: Bundle, name: str = "") -> float | None:
    """Radius [m] of the indenter; None where it is not known. Raises ConfigError where no such indenter can press this
    skin, or an image of it show it.
    """
    radius = None if skin.indenter is None else skin.indenter.radius_m
    if radius is None:
        return None
    outline = np.asarray(bundle.skin.get("outline", ()), float).reshape(-1, 2)
    half = float(np.ptp(outline, axis=0).min()) / 2 if len(outline) else float(bundle.skin.get("radius", 1.0))
    least, most = bundle.metres_per_pixel / 2, half * bundle.metres_per_unit
    if not least <= radius <= most * (1 + 1e-9):
        key = f"skins.{name}.indenter.radius_m" if name else "indenter.radius_m"
        raise ConfigError(
            f"{key}: found {radius:g} m; expected {least:.2g} to {most:.3g} m with bundle {bundle.name}, from half a "
            "pixel of its images to half its shorter side: give the radius in metres, or take `radius_m` away"
        )
    return radius


def _surroundings(skin: Skin, bundle: Bundle, name: str) -> dict[str, Any]:
    """What every law needs to know of the skin. Raises ConfigError."""
    unit, radius = bundle.metres_per_unit, known_radius(skin, bundle, name)
    area = None if radius is None else math.pi * (radius / unit) ** 2
    variant = skin.network if bundle.network_path("full" if skin.network == "none" else skin.network) else "full"
    try:
        maps = {} if variant == "none" else uncertainty.maps(bundle.manifest, variant, NETWORKS[variant])
    except (KeyError, TypeError, ValueError) as why:
        raise ConfigError(
            f"{bundle.path}/manifest.json: its uncertainties cannot be read ({why}); build it again"
        ) from None
    return {"metres_per_unit": unit, "half_width": bundle.half_width, "indenter_area": area, "maps": maps}
