"""A skin as data: outline, electrodes, contact impedance, drive pattern; read from TOML and checked.

Lengths are in model units (the skin fits the square [-1, 1] x [-1, 1]); `metres_per_unit` turns them into metres. A
TOML with `unit = "mm"` (or m, cm, inch) in its place gives its lengths in that unit, wherever its origin is.
"""

from __future__ import annotations

import json
import logging
import re
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import patterns
from models.outline import Array, GeometryError, Outline
from models.skin_limits import LARGEST_M, LEAST_ELECTRODES, MOST_ELECTRODES, NAME, SMALLEST_M

__all__ = ["GeometryError", "Outline", "SkinGeometry", "from_dict", "load", "shipped"]

SKINS = Path(__file__).parent / "skins"
MANIFEST = "manifest.json"  # of a bundle's folder, which holds its skin too
ON_OUTLINE = 1e-6  # how far from the outline an electrode's centre may be given, model units
DRAWN_ON_OUTLINE = 0.02  # the same where lengths were drawn or measured: 0.6 mm of a disc of 60 mm
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 0.0254}


@dataclass(frozen=True, eq=False)
class SkinGeometry:
    """electrodes (n,): arc length of each centre along the outline; widths, contact_impedance (n,); pattern (K, 4).

    Lengths are model units along the outline, contact impedance is ohm m (2-D: with the sheet's conductivity in S).
    """

    name: str
    curve: Outline
    electrodes: Array
    widths: Array
    contact_impedance: Array
    metres_per_unit: float
    pattern_name: str
    pattern: NDArray[np.int64]

    def __post_init__(self) -> None:
        where = f"skin '{self.name}': "
        n = self.n_electrodes
        if not LEAST_ELECTRODES <= n <= MOST_ELECTRODES:
            raise GeometryError(f"{where}found {n} electrodes, expected {LEAST_ELECTRODES} to {MOST_ELECTRODES}")
        for values, what in ((self.widths, "width"), (self.contact_impedance, "contact_impedance")):
            if values.shape != (n,):
                raise GeometryError(f"{where}{what} has {values.size} entries for {n} electrodes")
            wrong = np.flatnonzero(~(values > 0))
            if wrong.size:
                raise GeometryError(f"{where}{what} of electrode {wrong[0]} must be positive, found {values[wrong[0]]}")
        if not self.metres_per_unit > 0:
            raise GeometryError(f"{where}metres_per_unit must be positive, found {self.metres_per_unit}")
        order = np.argsort(np.mod(self.electrodes, self.perimeter))
        for a, b in zip(order, np.roll(order, -1), strict=True):
            between = np.mod(self.electrodes[b] - self.electrodes[a], self.perimeter)
            gap = between - (self.widths[a] + self.widths[b]) / 2
            if gap <= 1e-9:
                raise GeometryError(
                    f"{where}electrodes {min(a, b)} and {max(a, b)} overlap by {-gap:.3g} model units "
                    f"({-1e3 * gap * self.metres_per_unit:.2g} mm): expected a gap between them; make their width "
                    "smaller, or move them apart"
                )

    # --- the outline ---

    @property
    def outline(self) -> Array | None:
        """(m, 2) corners, None for a disc."""
        return self.curve.corners

    @property
    def radius(self) -> float:
        """Radius of a disc; 0 for a polygon."""
        return self.curve.radius

    @property
    def perimeter(self) -> float:
        return self.curve.perimeter

    def point(self, arc: ArrayLike) -> Array:
        """(..., 2) points of the outline at arc lengths."""
        return self.curve.point(arc)

    def inside(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the points (..., 2) lie on the skin."""
        return self.curve.inside(points)

    def polygon(self, n: int = 128) -> Array:
        """(m, 2) corners of the outline; a disc as n of them."""
        return self.curve.polygon(n)

    # --- the electrodes ---

    @property
    def n_electrodes(self) -> int:
        return len(self.electrodes)

    @property
    def edges(self) -> Array:
        """(n, 2) arc lengths where each electrode begins and ends; may lie below 0 or beyond the perimeter."""
        return np.asarray(self.electrodes[:, None] + self.widths[:, None] * np.array([-0.5, 0.5]))

    # --- variations and storage ---

    def moved(self, shift: ArrayLike, contact_impedance: ArrayLike | None = None) -> SkinGeometry:
        """A copy whose electrodes are shifted along the outline by `shift` (n,) model units: a mounting error."""
        contact = self.contact_impedance if contact_impedance is None else contact_impedance
        return replace(
            self,
            electrodes=self.electrodes + np.broadcast_to(np.asarray(shift, dtype=float), self.electrodes.shape),
            contact_impedance=np.broadcast_to(np.asarray(contact, dtype=float), self.electrodes.shape).copy(),
        )

    def with_pattern(self, spec: str | ArrayLike) -> SkinGeometry:
        """A copy with another drive pattern: a name or a (K, 4) list."""
        name = spec if isinstance(spec, str) else "custom"
        return replace(self, pattern_name=name, pattern=patterns.pattern(spec, self.n_electrodes))

    def to_dict(self) -> dict[str, Any]:
        """The TOML's content as plain values (a bundle's manifest carries it); `from_dict` reads it back."""
        shape = {"radius": self.radius} if self.outline is None else {"outline": self.outline.tolist()}
        return {
            "name": self.name,
            **shape,
            "metres_per_unit": self.metres_per_unit,
            "contact_impedance": self.contact_impedance.tolist(),
            "pattern": self.pattern.tolist() if self.pattern_name == "custom" else self.pattern_name,
            "electrodes": {"width": self.widths.tolist(), "centre": self.point(self.electrodes).tolist()},
        }


def shipped() -> list[str]:
    """Names of the skins that come with the project."""
    return sorted(path.stem for path in SKINS.glob("*.toml"))


def load(name: str | Path) -> SkinGeometry:
    """A shipped skin by name ("square16", "disc16"), any TOML file by path, or that of a bundle's folder. Raises
    GeometryError, PatternError.
    """
    path = Path(name) if str(name).endswith(".toml") else SKINS / f"{name}.toml"
    if is_folder(name):
        return _of_bundle(Path(name, MANIFEST))
    if not path.is_file():
        raise GeometryError(
            f"no skin {str(name)!r}: expected one of {', '.join(shipped())}, the path of a .toml file, or the folder "
            "that `skin register` made"
        )
    try:
        data = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise GeometryError(f"{path}: not valid TOML: {error}") from None
    skin = from_dict(data)
    said = f"unit = {data['unit']!r}" if "unit" in data else "metres_per_unit, half its longer side in metres"
    check_size(skin, f"correct {said} in {path}")
    return skin


def is_folder(name: str | Path) -> bool:
    """Whether a skin is named by the folder of its bundle. A name without a / is a skin's first, whatever lies here."""
    named = "/" not in str(name) and (SKINS / f"{name}.toml").is_file()
    return not named and not str(name).endswith(".toml") and Path(name, MANIFEST).is_file()


def _of_bundle(path: Path) -> SkinGeometry:
    try:
        said = dict(json.loads(path.read_text(encoding="utf-8"))["skin"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as why:
        raise GeometryError(f"{path} says nothing of a skin ({str(why)[:80]}): register or build it again") from None
    return from_dict(said)


def check_size(skin: SkinGeometry, do: str) -> None:
    """Whether the skin is as large as one can be: else lengths were given in another unit. Raises GeometryError, which
    ends with what to `do`.
    """
    width, height = np.ptp(skin.polygon(), axis=0) * skin.metres_per_unit
    if not SMALLEST_M <= max(width, height) <= LARGEST_M:
        raise GeometryError(
            f"skin '{skin.name}': found {width:.4g} m x {height:.4g} m, expected a longer side of {SMALLEST_M:g} to "
            f"{LARGEST_M:g} m: {do}"
        )


def from_dict(data: dict[str, Any]) -> SkinGeometry:
    """The skin of a TOML's content (see skins/square16.toml). Raises GeometryError, PatternError."""
    where = f"skin '{data.get('name', 'unnamed')}': "
    _check_keys(data, where)
    on_outline = DRAWN_ON_OUTLINE if "unit" in data else ON_OUTLINE
    try:
        data = _in_model_units(data) if "unit" in data else data
    except (TypeError, ValueError) as error:
        raise GeometryError(f"{where}{error}") from None
    spec = data["electrodes"]
    if unknown := set(spec) - {"width", "centre", "count", "first"}:
        raise GeometryError(f"{where}[electrodes]: unknown key {min(unknown)!r}; expected width, centre, count, first")
    if "width" not in spec or ("centre" in spec) == ("count" in spec) or ("first" in spec and "centre" in spec):
        raise GeometryError(
            f"{where}[electrodes] needs width, and either centre (points) or count (evenly spaced; with it `first`, "
            "how far along the outline the first one is)"
        )
    try:
        corners = np.array(data["outline"], dtype=float) if "outline" in data else None
        curve = Outline(corners, float(data.get("radius", 0.0)))
        if "count" in spec:
            n = _count(spec["count"])
            centres = float(spec.get("first", 0.0)) + np.arange(n) * curve.perimeter / n
        else:
            points = np.array(spec["centre"], dtype=float).reshape(-1, 2)
            most = on_outline, min(DRAWN_ON_OUTLINE, _rounding(data["electrodes"]["centre"]))
            centres = _on_curve(curve, points, most, float(data["metres_per_unit"]), where)
        widths, contact = (_each(value, len(centres)) for value in (spec["width"], data["contact_impedance"]))
        drive = data.get("pattern", "pairs")
        pattern = patterns.pattern(drive, len(centres))
    except patterns.PatternError:
        raise
    except (TypeError, ValueError) as error:
        raise GeometryError(f"{where}{error}") from None
    return SkinGeometry(
        name=str(data["name"]),
        curve=curve,
        electrodes=centres,
        widths=widths,
        contact_impedance=contact,
        metres_per_unit=float(data["metres_per_unit"]),
        pattern_name=drive if isinstance(drive, str) else "custom",
        pattern=pattern,
    )


def _check_keys(data: dict[str, Any], where: str) -> None:
    needed = {"name", "unit" if "unit" in data else "metres_per_unit", "contact_impedance", "electrodes"}
    known = needed | {"outline", "radius", "pattern"}
    for wrong, what in ((needed - set(data), "missing"), (set(data) - known, "unknown")):
        if wrong:
            raise GeometryError(f"{where}{what} key {min(wrong)!r}; expected {', '.join(sorted(known))}")
    if not re.fullmatch(NAME, str(data["name"])) or not str(data["name"]).strip("."):
        raise GeometryError(f"name: found {data['name']!r:.80}, expected at most 64 letters, digits, - . and _")
    if ("outline" in data) == ("radius" in data):
        raise GeometryError(f"{where}give either outline (a polygon) or radius (a disc)")
    if not isinstance(data["electrodes"], dict):
        raise GeometryError(f"{where}electrodes: found {data['electrodes']!r:.40}, expected a table [electrodes]")


def _in_model_units(data: dict[str, Any]) -> dict[str, Any]:
    """The same skin with its lengths in model units, its bounding box centred. Raises ValueError, TypeError."""
    unit = data["unit"]
    if unit not in UNITS:
        raise ValueError(f"unit: found {unit!r}, expected one of {', '.join(UNITS)}")
    found = {key: value for key, value in data.items() if key != "unit"}
    if "outline" in data:
        corners = np.array(data["outline"], dtype=float)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise ValueError(f"an outline is at least three corners [x, y], found shape {corners.shape}")
        low, high = corners.min(axis=0), corners.max(axis=0)
        centre, half = (low + high) / 2, float((high - low).max()) / 2
        if not 0 < half < np.inf:
            raise ValueError(f"the outline's corners are all at {corners[0].tolist()}: expected an area")
        found["outline"] = ((corners - centre) / half).tolist()
    else:
        centre, half = np.zeros(2), float(data["radius"])
        if not 0 < half < np.inf:
            raise ValueError(f"radius: found {half}, expected a length above 0")
        found["radius"] = 1.0
    spec = dict(data["electrodes"])
    for key in {"width", "first"} & set(spec):
        spec[key] = (np.array(spec[key], dtype=float) / half).tolist()
    if "centre" in spec:
        spec["centre"] = ((np.array(spec["centre"], dtype=float).reshape(-1, 2) - centre) / half).tolist()
    return {**found, "electrodes": spec, "metres_per_unit": half * UNITS[unit]}


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not LEAST_ELECTRODES <= value <= MOST_ELECTRODES:
        raise ValueError(
            f"[electrodes] count: found {value!r}, expected a whole number of {LEAST_ELECTRODES} to {MOST_ELECTRODES}"
        )
    return value


def _rounding(values: Any) -> float:
    """How far from its place a point may be that was rounded to the decimals of these coordinates, the most that any
    has; 0 where all are whole numbers.
    """
    decimals = max(
        len(np.format_float_positional(v, trim="-").partition(".")[2]) for v in np.ravel(np.array(values, dtype=float))
    )
    return 10.0**-decimals / np.sqrt(2) if decimals else 0.0


@cache
def _say(text: str) -> None:
    """Once in a process, however often a skin is loaded."""
    logging.getLogger(__name__).warning(text)


def _on_curve(curve: Outline, points: Array, most: tuple[float, float], metres: float, where: str) -> Array:
    """Arc lengths of electrode centres that must lie on the outline, or no further from it than `most`: in silence, and
    with a word.
    """
    off = curve.distance(points)
    if off.size and most[0] < off.max() <= most[1]:
        _say(
            f"{where}electrode centres up to {1e6 * off.max() * metres:.2g} um beside the outline, as far as they are "
            "rounded, are put on it"
        )
    elif off.size and not off.max() <= max(most):
        bad = int(off.argmax())
        raise GeometryError(
            f"electrode {bad} at {points[bad].tolist()} is {off[bad]:.3g} away from the outline "
            f"({1e3 * off[bad] * metres:.3g} mm): expected its centre on the outline; move it there"
        )
    return curve.arc(points)


def _each(value: ArrayLike, n: int) -> Array:
    """One number for all electrodes, or one for each."""
    array = np.array(value, dtype=float)
    return np.full(n, float(array)) if array.ndim == 0 else array
