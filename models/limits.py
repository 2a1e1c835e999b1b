"""What physics allows: floors of a touch's position, size, drop and force for a skin, a pattern and a noise.

    skin limits --skin square16 --snr 70 --map limits.png
    skin limits --forces --snr 80                            the smallest forces, by radius
    skin limits --scan --snr 80                              how soon a touch is known, by the setting of the scan
    skin limits --rank --snr inf --floor-ohm 1e-3

The floors and what they mean: models/fisher.py.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from models import geometry, patterns
from models.bundle import BundleError
from models.command import real, whole
from models.elements import Array
from models.fisher import Floor, MeasurementNoise, SizePrior, floors, mean_floor
from models.force_limits import RADII_MM, places, smallest
from models.forward import shared
from models.prereconstruction import Drift
from models.pressure import FOAM, disc
from models.scan_limits import WANDER_V
from models.scan_table import ScanTable
from models.shapes import Shape
from protocol.whole_file import whole_file

__all__ = ["Floor", "MeasurementNoise", "SizePrior", "floors", "map_floors", "mean_floor", "rank_patterns"]

DEFAULT_RADIUS = 0.2  # of the skin's half width
MAP_SIDE = 12  # positions along the side, at least, in a map
DROPS = (0.1, 0.15, 0.3, 0.5)  # 1, 1.5, 3 and 5 N under a disc of 10 mm radius


@dataclass(frozen=True)
class Case:
    """Everything a floor depends on but the touch."""

    skin: str = "square16"
    pattern: str | None = None
    noise: MeasurementNoise = MeasurementNoise()
    prior: SizePrior = SizePrior()
    drift: Drift = Drift()

    def floor(self, x: float, y: float, radius: float, drop: float) -> dict[str, Floor]:
        touch = Shape("circle", x, y, radius, drop)
        return floors(self.skin, touch, self.noise, self.prior, self.pattern, self.drift)


def map_floors(case: Case, radius: float, drop: float, per_side: int = 9) -> tuple[Array, dict[str, list[Floor]]]:
    """Positions (m, 2) and at each of them the floors, by kind."""
    points = places(case.skin, radius, per_side)
    if not len(points):
        raise ValueError(f"no touch of radius {_mm(case.skin, radius)} fits on skin '{case.skin}'")
    both = [case.floor(x, y, radius, drop) for x, y in points]
    return points, {kind: [f[kind] for f in both] for kind in ("cramer_rao", "bayes")}


def rank_patterns(case: Case, radius: float = 0.2, drop: float = 0.15, per_side: int = 5) -> list[tuple[str, Floor]]:
    """Drive patterns, best first by the Bayesian floor of position, root mean square over the skin."""
    names = patterns.fitting(shared(case.skin, "inverse").skin.n_electrodes)
    found = []
    for name in names:
        _, by_kind = map_floors(Case(case.skin, name, case.noise, case.prior, case.drift), radius, drop, per_side)
        found.append((name, mean_floor(by_kind["bayes"])))
    return sorted(found, key=lambda pair: pair[1].position)


def table(case: Case, radius: float, per_side: int) -> list[dict[str, Any]]:
    """A row a drop: floors over the skin, root mean square."""
    rows = []
    area = disc(radius * shared(case.skin, "inverse").skin.metres_per_unit)
    for drop in DROPS:
        _, by_kind = map_floors(case, radius, drop, per_side)
        for kind, each in by_kind.items():
            mean = mean_floor(each)
            worst = max(each, key=lambda f: f.position).position_percent
            newtons = FOAM.force("circle", drop, area)
            rows.append(
                {"newtons": newtons, "drop": drop, "floor": kind, "worst_position_percent": worst} | _figures(mean)
            )
    return rows


def _figures(floor: Floor) -> dict[str, float]:
    return {
        "position_percent": floor.position_percent,
        "radius_percent": 100 * floor.radius,
        "drop_percent": 100 * floor.drop,
        "integral_percent": 100 * floor.integral,
        "force_percent": 100 * floor.force,
    }


def draw(case: Case, radius: float, drop: float, per_side: int, path: Path) -> None:
    """Maps of the Bayesian floors over the skin, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    points, by_kind = map_floors(case, radius, drop, per_side)
    skin = shared(case.skin, "inverse").skin
    outline = np.vstack([skin.polygon(), skin.polygon()[:1]])
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    panels = {"position": "position_percent", "drop": "drop_percent", "integrated drop": "integral_percent"}
    cell = np.round((points + 1) * per_side / 2 - 0.5).astype(int)
    half_mm = 1e3 * skin.metres_per_unit
    edges = np.linspace(-half_mm, half_mm, per_side + 1)
    for axis, (title, key) in zip(axes, panels.items(), strict=True):
        image = np.full((per_side, per_side), np.nan)
        image[cell[:, 1], cell[:, 0]] = [_figures(f)[key] for f in by_kind["bayes"]]
        unit = "% of the side" if key == "position_percent" else "%"
        figure.colorbar(axis.pcolormesh(edges, edges, image), ax=axis, label=unit)
        axis.plot(*(half_mm * outline).T, color="0.3")
        axis.plot(*(half_mm * skin.point(skin.electrodes)).T, "k.", markersize=8)
        axis.set(title=title, aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
    name = case.pattern or skin.pattern_name
    figure.suptitle(
        f"{case.skin}, {name}, {_noise(case.noise)}: Bayesian floor of a touch, radius "
        f"{_mm(case.skin, radius)}, drop {drop} S/m"
    )
    with whole_file(path) as part:
        figure.savefig(part, dpi=110)
    plt.close(figure)


def _mm(skin: str, radius: float) -> str:
    """A radius in half widths of the skin, as a person reads it."""
    return f"{1e3 * radius * shared(skin, 'inverse').skin.metres_per_unit:.3g} mm"


def _noise(noise: MeasurementNoise) -> str:
    parts = [] if np.isinf(noise.snr_db) else [f"{noise.snr_db:g} dB"]
    return " and ".join(parts + ([f"{noise.floor_ohm:g} ohm"] if noise.floor_ohm else []))


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="skin limits", description="What physics allows: floors of a touch's errors.")
    parser.add_argument("--skin", default="square16", help=f"one of {', '.join(geometry.shipped())}, or a .toml file")
    parser.add_argument("--pattern", choices=patterns.NAMES, help="default: the skin's own")
    parser.add_argument(
        "--snr", type=real(infinite=True), default=70.0, metavar="DB", help="noise relative to each |Z|; inf for none"
    )
    parser.add_argument(
        "--floor-ohm", type=real(itself=True), default=0.0, help="noise of the converter, the same on all channels"
    )
    parser.add_argument(
        "--drift",
        type=real(itself=True, infinite=True),
        default=0.0,
        help="scale and contacts since the tare, relative; inf: lost",
    )
    parser.add_argument(
        "--radius", type=real(), metavar="METRES", help="of the touch; default: a fifth of the skin's half width"
    )
    parser.add_argument("--drop", type=real(), default=0.15, help="S/m, for --map and --rank")
    parser.add_argument("--known-radius", action="store_true", help="the indenter's size is known")
    parser.add_argument("--grid", type=whole(), default=6, help="positions along the skin's side")
    parser.add_argument("--forces", action="store_true", help="the smallest forces that are shown and measured instead")
    parser.add_argument("--rank", action="store_true", help="rank the drive patterns instead")
    parser.add_argument("--scan", action="store_true", help="how soon a touch is known, by the setting of the scan")
    parser.add_argument(
        "--wander-mv",
        type=real(),
        metavar="MV",
        help="with --scan: change of the electrodes' offsets since the tare; default: 1",
    )
    parser.add_argument("--interference", action="store_true", help="with --scan: floors beside mains and a motor")
    parser.add_argument("--map", type=Path, metavar="PNG", help="draw the floors over the skin")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    if options.forces:
        _refuse_beside(parser, options, "forces", ("rank", "map", "known_radius", "radius", "pattern", "drift", "scan"))
    if options.scan:
        _refuse_beside(parser, options, "scan", ("rank", "map", "known_radius", "radius", "pattern", "drift"))
        _refuse_beside(parser, options, "scan", ("floor_ohm",))
        return options
    for name in ("wander_mv", "interference"):
        if getattr(options, name):
            parser.error(f"found --{name.replace('_', '-')} without --scan, to which it belongs")
    return options


def _refuse_beside(
    parser: argparse.ArgumentParser, options: argparse.Namespace, table: str, others: Sequence[str]
) -> None:
    """What a table of the skin's own bundle soon after a tare has no use for."""
    for name in others:
        if getattr(options, name):
            parser.error(f"found --{table} and --{name.replace('_', '-')}, expected one of them: leave the other out")


def main(argv: Sequence[str] | None = None) -> int:
    """`skin limits`: prints a table (or JSON), draws maps. Returns the exit status."""
    options = _arguments(argv)
    try:
        metres_per_unit = shared(options.skin, "inverse").skin.metres_per_unit
        radius = DEFAULT_RADIUS if options.radius is None else options.radius / metres_per_unit
        case = Case(
            options.skin,
            options.pattern,
            MeasurementNoise(options.snr, options.floor_ohm),
            SizePrior(radius=(radius, radius)) if options.known_radius else SizePrior(),
            Drift(options.drift, options.drift),
        )
        if options.scan:
            return _scan_table(options)
        rows = _rows(options, case, radius)
        if options.map:
            draw(case, radius, options.drop, max(options.grid, MAP_SIDE), options.map)
    except (ValueError, BundleError) as error:
        print(f"skin limits: {error}", file=sys.stderr)
        return 2
    if options.json:
        given = json.loads(json.dumps(asdict(case)), parse_constant=str)  # infinities as words: JSON has none
        given["prior"]["radius"] = [each * metres_per_unit for each in case.prior.radius]
        print(json.dumps({"case": given, "radius_m": radius * metres_per_unit, "rows": rows}, indent=1))
        return 0
    if options.forces:
        print(f"{options.skin}, {_noise(case.noise)}, one frame, size unknown; newtons, by radius:")
        print(
            "shown in 99.9 % of whole scans, and from where the force's standard deviation can be below a quarter of it"
        )
    else:
        size = "known" if options.known_radius else "unknown"
        used = options.pattern or shared(options.skin, "inverse").skin.pattern_name
        print(
            f"{options.skin}, {used}, {_noise(case.noise)}, touch of radius {_mm(options.skin, radius)}, size {size};"
        )
        print("standard deviations no estimator beats, root mean square over the skin, position in % of the side")
    _print(rows)
    if options.map:
        print(f"maps: {options.map}")
    return 0


def _rows(options: argparse.Namespace, case: Case, radius: float) -> list[dict[str, Any]]:
    if options.forces:
        return [asdict(smallest(case.skin, case.noise, mm, options.grid)) for mm in RADII_MM]
    if options.rank:
        ranked = rank_patterns(case, radius, options.drop, options.grid)
        return [{"pattern": name} | _figures(floor) for name, floor in ranked]
    return table(case, radius, options.grid)


def _scan_table(options: argparse.Namespace) -> int:
    """Raises ValueError, BundleError."""
    wander_v = WANDER_V if options.wander_mv is None else options.wander_mv * 1e-3
    if np.isinf(options.snr):
        raise ValueError("without noise nothing limits a touch: give a finite SNR")
    made = ScanTable(options.skin, options.snr, options.grid, wander_v, options.interference)
    print(json.dumps(made.json(), indent=1) if options.json else made.text())
    return 0


def _print(rows: list[dict[str, Any]]) -> None:
    names = list(rows[0])
    print("  ".join(f"{name.replace('_percent', ' %').replace('_', ' '):>16}" for name in names))
    for row in rows:
        cells = [f"{value:16.3g}" if isinstance(value, float) else f"{value:>16}" for value in row.values()]
        print("  ".join(cells))


if __name__ == "__main__":
    raise SystemExit(main())
