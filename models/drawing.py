"""A skin's outline and electrodes from a drawing: DXF (ezdxf) or SVG (svgpathtools), both in the extra `offline`.

The outline is the one closed line of the drawing (or the largest: others lie inside it and are said). Electrodes are
points or small circles on a layer, in a group or with an id or class whose name begins with "electrode"; without any,
they are spaced evenly. y is up, as in DXF; SVG's y, which is down, is turned.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from models import not_installed
from models.outline import Array, GeometryError, Outline

SUFFIXES = (".dxf", ".svg")
FLAT = 1e-3  # of the drawing's size: how far a curve may be from the polygon that stands for it
ROUND = 2e-3  # of its radius: how far a closed line's corners may be from a circle that it is taken for
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254, "in": 0.0254, "px": 0.0254 / 96, "pt": 0.0254 / 72}
DXF_LINES = ("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE", "SPLINE", "HATCH", "REGION")
DXF_MARKS = {"POINT": "location", "CIRCLE": "center"}  # of electrodes: which attribute is the place
DXF_UNITS = {1: "inch", 4: "mm", 5: "cm", 6: "m"}


@dataclass(frozen=True, eq=False)
class Drawing:
    """Metres. A disc where `radius` is above 0 (then `corners` is empty), else a polygon, counter-clockwise.

    electrodes (n, 2): centres in the order of the drawing's first one and then counter-clockwise; empty where none is
    drawn. Disc and electrodes have the disc's centre as origin.
    """

    corners: Array
    radius: float
    electrodes: Array
    ignored: int = 0  # closed lines inside the outline

    @property
    def perimeter(self) -> float:
        if self.radius:
            return 2 * np.pi * self.radius
        return float(np.hypot(*(np.roll(self.corners, -1, axis=0) - self.corners).T).sum())

    def nearest(self, n: int) -> float:
        """The least distance of two of its electrodes; where none is drawn, of n evenly spaced ones."""
        if not len(self.electrodes):
            return self.perimeter / n
        apart = np.hypot(*(self.electrodes[:, None] - self.electrodes).transpose(2, 0, 1))
        return float((apart + np.diag(np.full(len(apart), np.inf))).min())


def disc(radius: float) -> Drawing:
    """A disc of this radius in metres."""
    return Drawing(np.zeros((0, 2)), radius, np.zeros((0, 2)))


def read(path: Path, unit: str = "") -> Drawing:
    """Outline and electrodes of a .dxf or .svg file. unit: of METRES, where the drawing does not say its own.

    Raises GeometryError.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise GeometryError(f"found {path.name}, expected a drawing: {' or '.join(SUFFIXES)}")
    if not path.is_file():
        raise GeometryError(f"no file {path}: expected a drawing ({' or '.join(SUFFIXES)})")
    if unit and unit not in METRES:
        raise GeometryError(f"unit: found {unit!r}, expected one of {', '.join(METRES)}")
    try:
        lines, points, scale = (_dxf if path.suffix.lower() == ".dxf" else _svg)(path, unit)
    except ImportError as why:
        raise GeometryError(f"{path} cannot be read: {not_installed(why) or why}") from None
    if not lines:
        raise GeometryError(
            f"{path}: found no closed line, expected the skin's outline: close the polyline or the path (in CAD: join "
            "its pieces to one polyline)"
        )
    lines.sort(key=lambda line: -abs(_area(line)))
    outline, marks = lines[0], np.array(points, dtype=float).reshape(-1, 2)
    if len(lines) > 1 and abs(_area(lines[1])) > 0.98 * abs(_area(outline)):
        raise GeometryError(
            f"{path}: found two closed lines of the same size, expected one outline: delete the one that is not it"
        )
    outline = outline if _area(outline) > 0 else outline[::-1]
    centre, radius = _circle(outline)
    if radius:
        corners, origin = np.zeros((0, 2)), centre
    else:
        corners, origin = _simpler(outline), np.zeros(2)
    electrodes = _in_order(marks, outline) if len(marks) else marks
    return Drawing((corners - origin) * scale, radius * scale, (electrodes - origin) * scale, len(lines) - 1)


# --- DXF ---


def _dxf(path: Path, unit: str) -> tuple[list[Array], list[Any], float]:
    """Closed lines, electrodes' centres, metres of a unit."""
    from ezdxf.filemanagement import readfile
    from ezdxf.lldxf.const import DXFError

    try:
        document = readfile(path)
    except (OSError, DXFError, UnicodeDecodeError) as why:
        raise GeometryError(f"{path}: is no DXF file that can be read: {why}") from None
    units = DXF_UNITS.get(int(document.header.get("$INSUNITS", 0)), "")
    lines, points = list[Array](), list[Any]()
    for entity in document.modelspace():
        kind = entity.dxftype()
        if not entity.dxf.layer.lower().startswith("electrode"):
            lines += _corners(entity) if kind in DXF_LINES else []
        elif kind in DXF_MARKS:
            place = entity.dxf.get(DXF_MARKS[kind])
            points.append((place.x, place.y))
    lines += _joined(document.modelspace())
    return lines, points, METRES[_unit(path, units, unit)]


def _corners(entity: Any) -> list[Array]:
    """The corners of an entity's closed line; nothing where it has none."""
    from ezdxf import path as paths

    try:
        made = paths.make_path(entity)
    except TypeError:  # a kind that has no path
        return []
    shape = np.array([(p.x, p.y) for p in made.control_vertices()])
    size = float(np.ptp(shape, axis=0).max()) if len(shape) else 0.0
    if not 0 < size < np.inf:
        return []
    corners = np.array([(p.x, p.y) for p in made.flattening(FLAT * size / 4, segments=16)])
    return list(_closed(corners, bool(made.is_closed or getattr(entity, "closed", False))))


def _joined(space: Any) -> Iterator[Array]:
    """Closed lines made of separate LINE and ARC entities, as CAD programs export sketches."""
    from ezdxf import edgeminer, edgesmith

    edges = list(edgesmith.edges_from_entities_2d(e for e in space if e.dxftype() in ("LINE", "ARC")))
    if not edges:
        return
    try:
        loops = edgeminer.find_all_loops(edgeminer.Deposit(edges))
    except TimeoutError:  # a hatching of thousands of lines that cross
        return
    for loop in loops:
        corners = [(v.x, v.y) for v in edgesmith.path2d_from_chain(loop).flattening(1e-3, segments=16)]
        yield from _closed(np.array(corners), True)


# --- SVG ---


def _svg(path: Path, unit: str) -> tuple[list[Array], list[Any], float]:
    """Closed lines, electrodes' centres, metres of a unit. y is turned up."""
    from xml.etree.ElementTree import ParseError

    from svgpathtools import Document

    try:
        document = Document(str(path))
        found = document.paths()
    except (OSError, ParseError, ValueError, KeyError, AttributeError, IndexError) as why:
        raise GeometryError(f"{path}: is no SVG file that can be read: {why}") from None
    order = {element: k for k, element in enumerate(document.root.iter())}  # groups come after single shapes else
    found.sort(key=lambda one: order.get(one.element, 0))
    marked = {id(element) for element in _marked(document.root)}
    lines, points = list[Array](), list[Any]()
    for one in found:
        if not len(one):
            continue
        if id(one.element) in marked:
            x0, x1, y0, y1 = one.bbox()
            points.append(((x0 + x1) / 2, -(y0 + y1) / 2))
            continue
        for line in one.continuous_subpaths():  # a path may lift its pen
            x0, x1, y0, y1 = line.bbox()
            lines += _closed(_flat(line, max(x1 - x0, y1 - y0)), line.isclosed())
    return lines, points, _svg_unit(path, document.root, unit)


def _marked(root: Any) -> Iterator[Any]:
    """Elements that are electrodes: by their own id or class, or by a group's."""
    names = ("id", "class", "{http://www.inkscape.org/namespaces/inkscape}label")
    for element in root.iter():
        if any(word.lower().startswith("electrode") for n in names for word in element.get(n, "").split()):
            yield from element.iter()


def _flat(one: Any, size: float) -> Array:
    """(n, 2) points of a path: straight pieces by their ends, curves close enough."""
    points: list[complex] = []
    for piece in one:
        straight = type(piece).__name__ == "Line"
        n = 1 if straight else max(8, int(np.ceil(np.sqrt(piece.length() / max(size, 1e-12) / FLAT))))
        points += [piece.point(k / n) for k in range(n)]
    points.append(one[-1].end)
    return np.array([(p.real, -p.imag) for p in points])


def _svg_unit(path: Path, root: Any, unit: str) -> float:
    """Metres of a user unit: from width and viewBox, where width has a physical unit."""
    width = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|in|pt|px)?\s*", root.get("width", ""))
    box = re.split(r"[\s,]+", root.get("viewBox", "").strip())
    if width and width[2] and width[2] != "px":
        across = float(box[2]) if len(box) == 4 else float(width[1]) * METRES[width[2]] / METRES["px"]
        if across > 0 and float(width[1]) > 0:
            return float(width[1]) * METRES[width[2]] / across
    return METRES[_unit(path, "", unit)]


# --- both ---


def _unit(path: Path, said: str, given: str) -> str:
    """The drawing's own unit before the one that is given. Raises GeometryError where nobody says."""
    if not (said or given):
        raise GeometryError(
            f"{path}: does not say in which unit it is drawn: give --unit, one of {', '.join(METRES)} (a DXF says it "
            "as $INSUNITS, an SVG by its width in mm)"
        )
    if said and given and METRES[said] != METRES[given]:
        raise GeometryError(
            f"{path}: is drawn in {said}, --unit says {given}: leave --unit out, or correct the drawing"
        )
    return said or given


def _closed(corners: Array, closed: bool) -> list[Array]:
    """The line without its repeated last corner, if it is closed; else nothing."""
    if len(corners) < 3:
        return []
    size = float(np.ptp(corners, axis=0).max())
    if not closed and np.hypot(*(corners[-1] - corners[0])) > 1e-6 * size:
        return []
    apart = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T) > 1e-6 * size
    return [corners[apart]] if apart.sum() >= 3 else []


def _area(line: Array) -> float:
    x, y = line.T
    return 0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _circle(line: Array) -> tuple[Array, float]:
    """Centre and radius, where the line is a circle; else radius 0."""
    centre = (line.min(axis=0) + line.max(axis=0)) / 2
    far = np.hypot(*(line - centre).T)
    rounded = len(line) >= 12 and np.ptp(far) < ROUND * far.mean()
    return centre, float(far.min()) if rounded else 0.0  # Bezier curves for a circle lie on it or just outside


def _simpler(line: Array) -> Array:
    """The polygon without corners that are no farther than FLAT from the line without them (Douglas, Peucker 1973)."""
    first = int(np.argmin(line.sum(axis=1)))  # a corner that stays
    line = np.vstack([np.roll(line, -first, axis=0), line[first]])
    most, keep = FLAT * float(np.ptp(line, axis=0).max()), np.zeros(len(line), dtype=bool)
    far = int(np.argmax(np.hypot(*(line - line[0]).T)))
    keep[[0, far, -1]] = True
    todo = [(0, far), (far, len(line) - 1)]
    while todo:
        a, b = todo.pop()
        if b - a < 2:
            continue
        along = (line[b] - line[a]) / max(float(np.hypot(*(line[b] - line[a]))), 1e-300)
        off = line[a + 1 : b] - line[a]
        distance = np.abs(off[:, 0] * along[1] - off[:, 1] * along[0])
        if distance.max() > most:
            k = a + 1 + int(distance.argmax())
            keep[k] = True
            todo += [(a, k), (k, b)]
    return np.asarray(line[keep][:-1])


def _in_order(points: Array, outline: Array) -> Array:
    """Counter-clockwise along the outline from the first: how electrodes are numbered."""
    centre, half = outline.mean(axis=0), float(np.ptp(outline, axis=0).max())
    curve = Outline((outline - centre) / half)
    arc = curve.arc((points - centre) / half)
    return np.asarray(points[np.argsort(np.mod(arc - arc[0] + 1e-9, curve.perimeter))])


def toml(name: str, drawing: Drawing, electrodes: dict[str, Any], contact_impedance: float, pattern: str) -> str:
    """The text of models/skins/NAME.toml, in millimetres."""
    if drawing.radius:
        shape = f"radius = {1e3 * drawing.radius:.6g}\n"
    else:
        shape = "outline = [                 # corners, counter-clockwise\n" + _rows(drawing.corners) + "]\n"
    if len(drawing.electrodes):
        places = "centre = [                  # electrode 0 first, then counter-clockwise\n"
        places += _rows(drawing.electrodes) + "]\n"
    else:
        places = f"count = {electrodes['count']:<22}# evenly spaced, counter-clockwise\n"
        places += f"first = {1e3 * electrodes['first']:<22.6g}# how far along the outline electrode 0 is\n"
    return (
        "# Written by `skin new`; every length is in `unit`. The skin's frame has its origin at the outline's middle.\n"
        f'name = "{name}"\n'
        'unit = "mm"\n'
        f"{shape}"
        f"contact_impedance = {contact_impedance:g}    # of an electrode: ohm m of a skin 2 m wide and of 1 S; "
        "`skin tare` finds it\n"
        f'pattern = "{pattern}"\n\n'
        "[electrodes]\n"
        f"width = {1e3 * electrodes['width']:<22.4g}# along the outline\n"
        f"{places}"
    )


def _rows(points: Iterable[Any]) -> str:
    return "".join(f"  [{1e3 * float(x):.6g}, {1e3 * float(y):.6g}],\n" for x, y in points)
