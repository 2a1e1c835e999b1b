"""The file that holds a skin's own force law: JSON, versioned, hashed, naming the skin and the bundle it belongs to.

    {"schema": "eitskin.force/2", "skin", "frame_id", "bundle", "bundle_hash", "indenter_radius_m", "of", "tip_m",
     "curve", "most_n", "own_error", "error", "presses", "made", "sha256"}

`skin calibrate force` writes it (calibration/force_fit.py fits). `of` says what the curve takes: "pressure", newtons of
the shipped foam; "peak" or "integral", of the drop. `tip_m`: the radius [m] over which that pressure is summed,
whatever size each touch has, or null. A file written by hand may hold a linear law of the peak drop,
right for one fixed indenter: {"newtons_per_siemens": 10.0, "most_n": 5.0}.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from models.bundle import Bundle
from models.files import FileError, read_text
from protocol.whole_file import write_whole
from services.contacts.force.curve import Curve
from services.runtime.config import ConfigError, Skin

SCHEMA = "eitskin.force/2"  # 1: fitted to what an image shows, which is not what a touch of the measurements shows
MOST_BYTES = 1024 * 1024
MOST_N = 5.0

Of = Literal["pressure", "peak", "integral"]


@dataclass(frozen=True)
class Calibration:
    """The force law of one skin."""

    curve: Curve
    reads: Of = "peak"
    most_n: float = MOST_N
    own_error: float = 0.0  # relative: scatter of the presses beyond what their own uncertainties explain
    tip_m: float | None = None  # radius of the one tip that presses tell; None: sizes are told by the touches
    origin: dict[str, Any] = field(default_factory=dict)  # where it comes from: see the module's text


def save(path: Path, found: Calibration, name: str, skin: Skin, bundle: Bundle) -> str:
    """Writes the file and returns the sha256 of its bytes, which info/<skin> names as `calibration_hash`.

    Raises OSError.
    """
    content = {
        "schema": SCHEMA,
        "skin": name,
        "frame_id": skin.frame_id,
        "bundle": bundle.name,
        "bundle_hash": bundle.hash,
        "indenter_radius_m": indenter_radius(skin),
        "of": found.reads,
        "tip_m": found.tip_m,
        "curve": found.curve.to_dict(),
        "most_n": found.most_n,
        "own_error": found.own_error,
        **found.origin,
    }
    text = json.dumps({**content, "sha256": _digest(content)}, indent=1, allow_nan=False) + "\n"
    write_whole(path, text)
    return hashlib.sha256(text.encode()).hexdigest()


def load(path: Path, skin: Skin, bundle: Bundle, name: str = "") -> Calibration:
    """Reads a calibration and checks that it belongs to this skin and bundle. Raises ConfigError."""
    try:
        found = json.loads(read_text(path, MOST_BYTES))
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected a map")
        if "schema" not in found:
            return _by_hand(found)
        if found["schema"] != SCHEMA:
            raise ConfigError(f"{path}: schema {found['schema']!r}, this program reads {SCHEMA}: {AGAIN}")
        content = {k: v for k, v in found.items() if k != "sha256"}
        if _digest(content) != found["sha256"]:
            raise ConfigError(f"{path}: its sha256 is not that of its content, so it was changed or damaged: {AGAIN}")
        _belongs(path, found, skin, bundle, name)
        if found["of"] not in get_args(Of):
            raise ValueError(f"of {found['of']!r}")
        numbers = float(found["most_n"]), float(found["own_error"])
        if not (0 < numbers[0] < math.inf and 0 <= numbers[1] < math.inf):
            raise ValueError("most_n and own_error")
        tip_m = None if found["tip_m"] is None else float(found["tip_m"])
        if tip_m is not None and not 0 < tip_m < math.inf:
            raise ValueError(f"tip_m {tip_m}")
        return Calibration(Curve.from_dict(found["curve"]), found["of"], *numbers, tip_m, origin=content)
    except FileError as why:
        raise ConfigError(f"{why}: correct `calibration` in skin.toml") from None
    except (ValueError, KeyError, TypeError, RecursionError) as why:
        raise ConfigError(f"{path} is no calibration of forces: {why!r:.200}") from None


AGAIN = "calibrate again with `skin calibrate force`, or take `calibration` out of skin.toml"


def _by_hand(found: dict[str, Any]) -> Calibration:
    slope, most = float(found["newtons_per_siemens"]), float(found.get("most_n", MOST_N))
    if not (0 < slope < math.inf and 0 < most < math.inf):
        raise ValueError(f"newtons_per_siemens {slope} and most_n {most} must be above 0")
    return Calibration(Curve(slope), "peak", most)


def _belongs(path: Path, found: dict[str, Any], skin: Skin, bundle: Bundle, name: str) -> None:
    if name and name not in (found["skin"], found["frame_id"]):
        raise ConfigError(f"{path}: belongs to skin {found['skin']!r}, not to {name!r}: {AGAIN}")
    if found["bundle_hash"] != bundle.hash:
        raise ConfigError(
            f"{path}: was made with bundle {found['bundle']} {found['bundle_hash'][:12]}, "
            f"skin.toml names {bundle.name} {bundle.hash[:12]}, whose images differ: {AGAIN}"
        )
    if found["indenter_radius_m"] != indenter_radius(skin):
        raise ConfigError(
            f"{path}: was made with an indenter of radius {found['indenter_radius_m']} m, "
            f"skin.toml says {indenter_radius(skin)}: {AGAIN}"
        )


def indenter_radius(skin: Skin) -> float | None:
    """Of what presses this skin [m]; None where nobody says."""
    return None if skin.indenter is None else skin.indenter.radius_m


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()
