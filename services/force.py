"""The force law: from the conductivity drop at a touch's peak [S/m] to its normal force [N]."""

from __future__ import annotations

import json
from dataclasses import dataclass

from models.bundle import Bundle
from services.config import ConfigError, Skin

NEWTONS_PER_SIEMENS = 10.0  # N per S/m: 0.1 to 0.5 S/m are 1 to 5 N
MOST_N = 5.0
BACKGROUND = 1.0  # S/m, of the untouched sheet that the bundles' model has: no drop can be larger
FAR_BEYOND = 2.0  # times most_n: what nobody measured at half of it is no force any more


@dataclass(frozen=True)
class ForceLaw:
    """force = newtons_per_siemens * peak drop. None: this skin has no law, its forces are nil."""

    newtons_per_siemens: float | None
    most_n: float = MOST_N  # beyond it a force is extrapolated
    calibrated: bool = False  # of this very skin, not of its kind

    @classmethod
    def of(cls, skin: Skin, bundle: Bundle) -> ForceLaw:
        """The law of a skin: its calibration file's, else its bundle's, else the default of bundles in S/m.

        Raises ConfigError for a calibration file that is none.
        """
        law = bundle.manifest.get("force_law", {})
        if skin.calibration is not None:
            try:
                found = json.loads(skin.calibration.read_text())
                return cls(float(found["newtons_per_siemens"]), float(found.get("most_n", MOST_N)), calibrated=True)
            except (OSError, ValueError, KeyError, TypeError) as why:
                raise ConfigError(f"{skin.calibration} is no calibration of forces: {why!r}") from None
        if law is None or bundle.manifest["normalisation"] == "measured":
            return cls(None)
        return cls(float(law.get("newtons_per_siemens", NEWTONS_PER_SIEMENS)), float(law.get("most_n", MOST_N)))

    def describe(self) -> dict[str, object] | None:
        """For info/<skin>."""
        if self.newtons_per_siemens is None:
            return None
        return {
            "kind": "linear in the peak drop",
            "newtons_per_siemens": self.newtons_per_siemens,
            "most_n": self.most_n,
            "calibrated": self.calibrated,
        }

    def impossible(self, peak: float) -> bool:
        """Whether no touch can have this peak drop [S/m]. Without a law the drop has no scale: anything goes."""
        if self.newtons_per_siemens is None:
            return False
        return peak >= BACKGROUND or self.newtons_per_siemens * peak > FAR_BEYOND * self.most_n

    def force(self, peak: float, peak_sigma: float) -> tuple[float | None, float | None]:
        """(force, its standard uncertainty) [N] of a peak drop and its standard deviation [S/m]."""
        k = self.newtons_per_siemens
        return (None, None) if k is None else (k * peak, k * peak_sigma if peak_sigma else None)
