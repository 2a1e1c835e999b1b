"""`skin new`: a skin of one's own as a TOML file, from a few numbers or a drawing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.whole_file import write_whole
from services.cli.common import ROOT, USAGE, JsonOption, emit, fail

if TYPE_CHECKING:
    from models.drawing import Drawing
    from models.geometry import SkinGeometry

SHARE = 0.3  # of the electrodes' spacing that each covers, unless told
CONTACT_IMPEDANCE = 0.01  # as that of the shipped skins
SCANS_HZ = 22.9 * 120  # measurements a second at 128 DFT points


def register(app: typer.Typer) -> None:
    app.command("new")(new)


def new(
    name: Annotated[str, typer.Argument(help="The skin's name: lower-case letters, digits, - and _.")],
    disc: Annotated[float, typer.Option(metavar="METRES", min=0, help="A disc of this diameter.")] = 0.0,
    outline: Annotated[
        Path | None, typer.Option(metavar="FILE", readable=False, help="A drawing, .dxf or .svg.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Of the drawing, where it does not say: mm, cm, m, inch.")] = "",
    electrodes: Annotated[int, typer.Option(help="How many, evenly spaced; where the drawing has none.")] = 16,
    width: Annotated[float, typer.Option(metavar="METRES", help="Of an electrode; default: 0.3 of the spacing.")] = 0.0,
    first: Annotated[float, typer.Option(metavar="METRES", help="Along the outline to the first electrode.")] = 0.0,
    pattern: Annotated[str, typer.Option(help="pairs, adjacent or opposite.")] = "pairs",
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Default: models/skins of the checkout.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a skin of this name.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Describe a skin of your own: its outline, its electrodes. `make train SKIN=NAME` then makes it usable."""
    import tomllib

    from models import drawing, geometry
    from models.meshing import MeshError, build
    from models.patterns import NAMES, PatternError
    from services.runtime.config import SKIN_NAME

    if not SKIN_NAME.fullmatch(name):
        fail(f"found the name {name!r}, expected lower-case letters, digits, - and _, at most 32", USAGE)
    if (disc > 0) == (outline is not None):
        fail("give either --disc METRES (its diameter) or --outline FILE (.dxf or .svg)", USAGE)
    if pattern not in NAMES:
        fail(f"--pattern: found {pattern!r}, expected one of {', '.join(NAMES)}", USAGE)
    path = (out or ROOT / "models" / "skins") / f"{name}.toml"
    if path.exists() and not overwrite:
        fail(f"{path} is there already: choose another name, or give --overwrite", USAGE)
    if not path.parent.is_dir():
        fail(f"no folder {path.parent}: make it first", USAGE)
    try:
        found = drawing.read(outline, unit) if outline else drawing.disc(disc / 2)
        text = _text(name, found, electrodes, width, first, pattern)
        data = tomllib.loads(text)
        skin = geometry.from_dict(data)
        geometry.check_size(skin, "say with --unit how the drawing is drawn" if outline else "--disc takes metres")
        build(skin, "inverse")  # whether its features can be meshed
    except (geometry.GeometryError, PatternError, MeshError) as why:
        fail(str(why), USAGE)
    write_whole(path, text)
    said = _said(skin, found, path)
    emit(said) if as_json else print(_sentence(said))


def _text(name: str, found: Drawing, count: int, width: float, first: float, pattern: str) -> str:
    from models import drawing
    from models.outline import GeometryError
    from models.skin_limits import LEAST_ELECTRODES, MOST_ELECTRODES

    perimeter = found.perimeter
    n = len(found.electrodes) or count
    if not LEAST_ELECTRODES <= n <= MOST_ELECTRODES:
        where = "the drawing has" if len(found.electrodes) else "--electrodes"
        raise GeometryError(f"{where} {n} electrodes: expected {LEAST_ELECTRODES} to {MOST_ELECTRODES}")
    if not 0 <= width < perimeter:
        raise GeometryError(f"--width {width:g}: expected metres, less than the outline's {perimeter:.3g} m")
    if len(found.electrodes) and first:
        raise GeometryError(
            "--first is for evenly spaced electrodes: the drawing has electrodes of its own; leave it out"
        )
    chosen = {"count": n, "width": width or SHARE * found.nearest(n), "first": first}
    return drawing.toml(name, found, chosen, CONTACT_IMPEDANCE, pattern)


def _said(skin: SkinGeometry, found: Drawing, path: Path) -> dict[str, Any]:
    scale = 1e3 * skin.metres_per_unit
    low, high = skin.polygon().min(axis=0) * scale, skin.polygon().max(axis=0) * scale
    width, height = (round(float(v), 2) for v in high - low)
    return {
        "file": str(path),
        "name": skin.name,
        "shape": f"a disc of {width:g} mm" if skin.outline is None else f"a polygon of {len(skin.polygon())} corners",
        "size_mm": [width, height],
        "electrodes": skin.n_electrodes,
        "electrode_width_mm": [round(float(skin.widths.min()) * scale, 2), round(float(skin.widths.max()) * scale, 2)],
        "measurements": len(skin.pattern),
        "scans_per_s": round(SCANS_HZ / len(skin.pattern), 1),
        "lines_ignored": found.ignored,
    }


def _sentence(said: dict[str, Any]) -> str:
    across, up = said["size_mm"]
    size = "" if str(said["shape"]).startswith("a disc") else f", {across:g} x {up:g} mm"
    left, right = said["electrode_width_mm"]
    wide = f"{left:g} mm" if math.isclose(left, right) else f"{left:g} to {right:g} mm"
    more = f"\n{said['lines_ignored']} closed lines inside the outline were left out" if said["lines_ignored"] else ""
    return (
        f"{said['name']}: {said['shape']}{size}, {said['electrodes']} electrodes {wide} wide, "
        f"{said['measurements']} measurements, {said['scans_per_s']:g} scans a second{more}\n"
        f"wrote {said['file']}; next: make train SKIN={said['name']} QUICK=1"
    )
