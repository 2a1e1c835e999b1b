"""A skin as data: outline, electrodes, contact impedance, drive pattern. Read from TOML, checked, and nothing computed by hand.

Lengths are in model units (the skin fits the square [-1, 1] x [-1, 1]); `metres_per_unit` turns them into metres.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models import patterns

SKINS = Path(__file__).parent / "skins"
ON_OUTLINE = 1e-6  # how far from the outline an electrode's centre may be given, model units


class GeometryError(ValueError):
    """A skin that cannot exist; the message says which part and what was expected."""


@dataclass(frozen=True, eq=False)
class Skin:
    """outline (m, 2): corners counter-clockwise, or None for a disc of `radius` round the origin.

    electrodes (n,): arc length of each centre along the outline, counter-clockwise from the first corner (polygon) or from
    angle 0 (disc). widths, contact_impedance (n,). pattern (K, 4). All lengths in model units.
    """

    name: str
    outline: NDArray[np.float64] | None
    radius: float
    electrodes: NDArray[np.float64]
    widths: NDArray[np.float64]
    contact_impedance: NDArray[np.float64]
    metres_per_unit: float
    pattern_name: str
    pattern: NDArray[np.int64]

    def __post_init__(self) -> None:
        self._check()

    # --- the outline as a curve ---

    @property
    def n_electrodes(self) -> int:
        return len(self.electrodes)

    @property
    def perimeter(self) -> float:
        return 2 * np.pi * self.radius if self.outline is None else float(self._sides().sum())

    @property
    def corners(self) -> NDArray[np.float64]:
        """Arc length of each corner; empty for a disc."""
        return np.zeros(0) if self.outline is None else np.concatenate([[0.0], np.cumsum(self._sides())[:-1]])

    @property
    def edges(self) -> NDArray[np.float64]:
        """(n, 2) arc length where each electrode begins and ends (the first may be negative, the last beyond the perimeter)."""
        return self.electrodes[:, None] + self.widths[:, None] * np.array([-0.5, 0.5])

    def point(self, arc: ArrayLike) -> NDArray[np.float64]:
        """(..., 2) points of the outline at the given arc lengths (taken modulo the perimeter)."""
        s = np.mod(np.asarray(arc, dtype=float), self.perimeter)
        if self.outline is None:
            return self.radius * np.stack([np.cos(s / self.radius), np.sin(s / self.radius)], axis=-1)
        start = self.corners
        side = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(start) - 1)
        along = (s - start[side]) / self._sides()[side]
        return self.outline[side] + along[..., None] * (np.roll(self.outline, -1, axis=0) - self.outline)[side]

    def arc(self, points: ArrayLike) -> NDArray[np.float64]:
        """(N,) arc length of the outline's point nearest to each of the points (N, 2)."""
        p = np.atleast_2d(np.asarray(points, dtype=float))
        if self.outline is None:
            return np.mod(np.arctan2(p[:, 1], p[:, 0]), 2 * np.pi) * self.radius
        distance, along = self._project(p)
        side = distance.argmin(axis=1)
        return np.asarray(self.corners[side] + along[np.arange(len(p)), side])

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """(N,) distance of points (N, 2) to the outline."""
        p = np.atleast_2d(np.asarray(points, dtype=float))
        if self.outline is None:
            return np.abs(self.radius - np.hypot(p[:, 0], p[:, 1]))
        return np.asarray(self._project(p)[0].min(axis=1))

    def inside(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which of the points (..., 2) lie on the skin."""
        p = np.asarray(points, dtype=float)
        x, y = p[..., 0], p[..., 1]
        if self.outline is None:
            return np.hypot(x, y) <= self.radius
        odd = np.zeros(x.shape, dtype=bool)
        for (x0, y0), (x1, y1) in zip(self.outline, np.roll(self.outline, -1, axis=0), strict=True):
            if y0 != y1:
                odd ^= ((y0 > y) != (y1 > y)) & (x < (x1 - x0) * (y - y0) / (y1 - y0) + x0)
        return odd

    def polygon(self, n: int = 128) -> NDArray[np.float64]:
        """(m, 2) corners of the outline; a disc as n of them."""
        return self.point(np.arange(n) / n * self.perimeter) if self.outline is None else self.outline.copy()

    # --- variations and storage ---

    def moved(self, shift: ArrayLike, contact_impedance: ArrayLike | None = None) -> Skin:
        """A copy whose electrodes are shifted along the outline by `shift` (n,) model units: a mounting error."""
        contact = self.contact_impedance if contact_impedance is None else contact_impedance
        return replace(
            self,
            electrodes=self.electrodes + np.broadcast_to(np.asarray(shift, dtype=float), self.electrodes.shape),
            contact_impedance=np.broadcast_to(np.asarray(contact, dtype=float), self.electrodes.shape).copy(),
        )

    def with_pattern(self, spec: str | ArrayLike) -> Skin:
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

    # --- internals ---

    def _sides(self) -> NDArray[np.float64]:
        assert self.outline is not None
        return np.asarray(np.linalg.norm(np.roll(self.outline, -1, axis=0) - self.outline, axis=1))

    def _project(self, p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance of each point to each side, and how far along the side its foot is: both (N, m)."""
        assert self.outline is not None
        length = self._sides()
        direction = (np.roll(self.outline, -1, axis=0) - self.outline) / length[:, None]
        offset = p[:, None] - self.outline
        along = np.clip(np.einsum("nmk,mk->nm", offset, direction), 0, length)
        return np.linalg.norm(offset - along[..., None] * direction, axis=2), along

    def _check(self) -> None:
        where = f"skin '{self.name}': "
        if self.outline is not None:
            if self.outline.ndim != 2 or self.outline.shape[1] != 2 or len(self.outline) < 3:
                raise GeometryError(
                    f"{where}an outline is at least three corners [x, y], found shape {self.outline.shape}"
                )
            x, y = self.outline.T
            if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() <= 0:
                raise GeometryError(f"{where}the outline's corners must run counter-clockwise; they run clockwise")
            if self._sides().min() < 1e-9:
                raise GeometryError(f"{where}corner {int(self._sides().argmin())} of the outline is given twice")
            crossing = _self_crossing(self.outline)
            if crossing:
                raise GeometryError(f"{where}sides {crossing[0]} and {crossing[1]} of the outline cross")
        elif self.radius <= 0:
            raise GeometryError(f"{where}the radius must be positive, found {self.radius}")
        if np.abs(self.polygon()).max() > 1 + 1e-9:
            raise GeometryError(f"{where}the outline must fit -1..1 in x and y (scale with metres_per_unit)")
        n = self.n_electrodes
        if n < 4:
            raise GeometryError(f"{where}at least four electrodes are needed, found {n}")
        for values, what in ((self.widths, "width"), (self.contact_impedance, "contact_impedance")):
            if values.shape != (n,):
                raise GeometryError(f"{where}{what} has {values.size} entries for {n} electrodes")
            if not (values > 0).all():
                bad = int(np.flatnonzero(~(values > 0))[0])
                raise GeometryError(f"{where}{what} of electrode {bad} must be positive, found {values[bad]}")
        if self.metres_per_unit <= 0:
            raise GeometryError(f"{where}metres_per_unit must be positive, found {self.metres_per_unit}")
        order = np.argsort(np.mod(self.electrodes, self.perimeter))
        for a, b in zip(order, np.roll(order, -1), strict=True):
            gap = (
                np.mod(self.electrodes[b] - self.electrodes[a], self.perimeter) - (self.widths[a] + self.widths[b]) / 2
            )
            if gap <= 1e-9:
                raise GeometryError(f"{where}electrodes {min(a, b)} and {max(a, b)} overlap by {-gap:.3g} model units")


def load(name: str | Path) -> Skin:
    """A shipped skin by name ("square16", "disc16") or any TOML file by path. Raises GeometryError, PatternError."""
    path = Path(name) if str(name).endswith(".toml") else SKINS / f"{name}.toml"
    if not path.is_file():
        shipped = ", ".join(sorted(p.stem for p in SKINS.glob("*.toml")))
        raise GeometryError(f"no skin {str(name)!r}: expected one of {shipped}, or the path of a .toml file")
    try:
        return from_dict(tomllib.loads(path.read_text()))
    except tomllib.TOMLDecodeError as error:
        raise GeometryError(f"{path}: not valid TOML: {error}") from None


def from_dict(data: dict[str, Any]) -> Skin:
    """The skin of a TOML's content (see skins/square16.toml). Raises GeometryError, PatternError."""
    known = {"name", "outline", "radius", "metres_per_unit", "contact_impedance", "pattern", "electrodes"}
    name = str(data.get("name", "unnamed"))
    unknown = sorted(set(data) - known)
    if unknown:
        raise GeometryError(f"skin '{name}': unknown key {unknown[0]!r}, expected {', '.join(sorted(known))}")
    if ("outline" in data) == ("radius" in data):
        raise GeometryError(f"skin '{name}': give either outline (a polygon) or radius (a disc)")
    for key in ("metres_per_unit", "contact_impedance", "electrodes"):
        if key not in data:
            raise GeometryError(f"skin '{name}': {key} is missing")
    outline = np.array(data["outline"], dtype=float) if "outline" in data else None
    radius = float(data.get("radius", 0.0))
    spec = data["electrodes"]
    if "width" not in spec or ("centre" in spec) == ("count" in spec):
        raise GeometryError(
            f"skin '{name}': electrodes need width, and either centre (points) or count (evenly spaced)"
        )
    bare = _Outline(name, outline, radius)
    if "count" in spec:
        centres = np.arange(int(spec["count"])) * bare.perimeter / int(spec["count"])
    else:
        points = np.array(spec["centre"], dtype=float).reshape(-1, 2)
        off = bare.distance(points)
        if off.max() > ON_OUTLINE:
            bad = int(off.argmax())
            raise GeometryError(
                f"skin '{name}': electrode {bad} at {points[bad].tolist()} is {off[bad]:.3g} from the outline"
            )
        centres = bare.arc(points)
    n = len(centres)
    spread = {
        key: np.full(n, float(value)) if np.ndim(value) == 0 else np.array(value, dtype=float)
        for key, value in (("width", spec["width"]), ("contact", data["contact_impedance"]))
    }
    drive = data.get("pattern", "pairs")
    return Skin(
        name=name,
        outline=outline,
        radius=radius,
        electrodes=centres,
        widths=spread["width"],
        contact_impedance=spread["contact"],
        metres_per_unit=float(data["metres_per_unit"]),
        pattern_name=drive if isinstance(drive, str) else "custom",
        pattern=patterns.pattern(drive, n),
    )


class _Outline(Skin):
    """Only the curve, before the electrodes on it are known."""

    def __init__(self, name: str, outline: NDArray[np.float64] | None, radius: float) -> None:
        for key, value in (("name", name), ("outline", outline), ("radius", radius)):
            object.__setattr__(self, key, value)


def _self_crossing(corners: NDArray[np.float64]) -> tuple[int, int] | None:
    """Two sides of a polygon that cross each other, if any."""

    def turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    m = len(corners)
    for i in range(m):
        for j in range(i + 2, m if i else m - 1):
            a, b, c, d = corners[i], corners[(i + 1) % m], corners[j], corners[(j + 1) % m]
            if turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0:
                return i, j
    return None
