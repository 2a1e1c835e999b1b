"""Forces of presses of unknown size: said over true, by radius and force; full scans and parts, default settings.

    skin bench force                     100 presses of each scan mode, about five minutes
    skin bench force --scan full --each 2 --snr 70

Board, link, clock and stages in simulated time; each press is held for 1.2 s and its last contact counts. The floor is
that of one frame whose size is unknown, at the press's place (`skin limits --forces` has its prior).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from bench import REPORTS
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.simulated_host import SimulatedHost
from models.command import real, whole
from models.fisher import MeasurementNoise, floors, mean_floor
from models.force_limits import SIZES
from models.pressure import FOAM, disc
from models.shapes import Shape
from services.runtime.config import ScanMode

RADII_MM = (5.0, 10.0, 15.0, 20.0)
NEWTONS = (0.5, 1.0, 2.0, 3.5, 5.0)
METRES, SIDE_M = 0.05, 0.1  # of square16: per model unit; the skin
HELD_S, PAUSE_S, START_S = 1.2, 0.8, 5.0
FROM_N = 1.0  # the root mean square is of presses from here on
SATURATED = 0.76  # S/m: beyond it a force is a lower bound
PATIENCE_S = 0.3  # before the press's end: a contact as old counts


@dataclass(frozen=True)
class PressRow:
    """One press and the last contact while it was held; None: nothing was shown."""

    scan: str
    radius_mm: float
    newtons: float
    x: float
    y: float
    said: float | None
    sigma: float | None
    pressure: float | None
    pressure_sigma: float | None
    extrapolated: bool

    @property
    def drop(self) -> float:
        return FOAM.flat_drop(self.newtons, disc(self.radius_mm * 1e-3))


def presses(scan: ScanMode, snr_db: float, each: int, seed: int) -> Iterator[PressRow]:
    """`each` presses of every radius and force, in random order at random places."""
    rng = np.random.default_rng([seed, 36])
    host = SimulatedHost(scan, snr_db, seed)
    host.until(START_S)
    cases = [(r, f) for r in RADII_MM for f in NEWTONS for _ in range(each)]
    for k in rng.permutation(len(cases)):
        radius, newtons = cases[k]
        half = SIDE_M / 2 - radius * 1e-3
        x, y = rng.uniform(-half, half, 2)
        host.press(x=x, y=y, force=newtons, radius=radius * 1e-3, seconds=60.0)
        end = host.now + HELD_S
        host.contacts.clear()
        host.until(end)
        yield _row(host, scan, radius, newtons, float(x), float(y))
        host.release()
        host.until(host.now + PAUSE_S)
    host.rig.close()


def _row(host: SimulatedHost, scan: str, radius: float, newtons: float, x: float, y: float) -> PressRow:
    for when, frame in reversed(host.contacts):
        found = [c for c in frame.contacts if c.state != "end"]
        if when < host.now - PATIENCE_S:
            break
        if frame.valid and found and found[0].force_n is not None:
            c = min(found, key=lambda c: float(np.hypot(c.position[0] - x, c.position[1] - y)))
            much = "extrapolated" in frame.reasons
            return PressRow(
                scan, radius, newtons, x, y, c.force_n, c.force_sigma_n, c.pressure_pa, c.pressure_sigma_pa, much
            )
    return PressRow(scan, radius, newtons, x, y, None, None, None, None, False)


def cells(rows: Sequence[PressRow], snr_db: float) -> list[dict[str, Any]]:
    """A row for every scan mode, radius and force."""
    found = []
    for scan, radius, newtons in dict.fromkeys((r.scan, r.radius_mm, r.newtons) for r in rows):
        own = [r for r in rows if (r.scan, r.radius_mm, r.newtons) == (scan, radius, newtons)]
        shown = [r for r in own if r.said is not None and r.sigma is not None]
        ratio = np.array([(r.said or 0.0) / newtons for r in shown])
        sigma = np.array([(r.sigma or 0.0) / newtons for r in shown])
        pressure = float(FOAM.pressure(own[0].drop))
        at = [Shape("circle", r.x / METRES, r.y / METRES, radius * 1e-3 / METRES, own[0].drop) for r in own]
        noise = MeasurementNoise(snr_db)
        floor = mean_floor(floors("square16", touch, noise, SIZES)["bayes"] for touch in at).force
        found.append(
            {
                "scan": scan,
                "radius_mm": radius,
                "newtons": newtons,
                "presses": len(own),
                "shown": len(shown),
                "ratio": float(np.median(ratio)) if len(shown) else None,
                "spread": float(ratio.std()) if len(shown) else None,
                "sigma": float(np.median(sigma)) if len(shown) else None,
                "floor": floor,
                "pressure_ratio": float(np.median([(r.pressure or 0.0) / pressure for r in shown])) if shown else None,
                "saturated": own[0].drop > SATURATED,
                "extrapolated": float(np.mean([r.extrapolated for r in own])),
            }
        )
    return sorted(found, key=lambda c: (c["scan"], c["radius_mm"], c["newtons"]))


def targets(rows: Sequence[PressRow], table: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """What is wanted of a scan mode's presses, and what they reach."""
    shown = [r for r in rows if r.said is not None and r.sigma]
    plain = [r for r in shown if r.drop <= SATURATED]
    z = np.array([abs((r.said or 0.0) - r.newtons) / (r.sigma or 1.0) for r in shown])
    firm = np.array([(r.said or 0.0) / r.newtons - 1 for r in plain if r.newtons >= FROM_N])
    sizes = {mm: float(np.median([(r.said or 0) / r.newtons for r in plain if r.radius_mm == mm])) for mm in RADII_MM}
    bias = [abs(c["ratio"] - 1) / c["sigma"] for c in table if c["ratio"] is not None]
    over = [c["sigma"] / c["floor"] for c in table if c["sigma"] and not c["saturated"]]
    reached: dict[str, tuple[Any, Any]] = {
        "presses shown, %": (100 * len(shown) / len(rows), 100),
        "median said / true by radius, furthest from 1, %": (100 * max(abs(v - 1) for v in sizes.values()), 5),
        f"root mean square error from {FROM_N:g} N on, %": (100 * float(np.sqrt(np.mean(firm**2))), 7),
        "within one sigma, %": (100 * float(np.mean(z < 1)), 68),
        "within three sigma, %": (100 * float(np.mean(z < 3)), 99.5),
        "bias of a radius and force, over its sigma, at most": (max(bias), 1),
        "median sigma over the floor of one frame": (float(np.median(over)), 1.3),
    }
    return {name: {"reached": value, "target": target} for name, (value, target) in reached.items()}


def draw(table: Sequence[dict[str, Any]], path: Path) -> None:
    """Said over true and sigma over true, by radius and force, a row a scan mode."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    scans = sorted({c["scan"] for c in table})
    figure, axes = plt.subplots(len(scans), 2, figsize=(9, 3.3 * len(scans)), squeeze=False, layout="constrained")
    panels = (("ratio", "median said / true", 0.7, 1.3, "RdBu"), ("sigma", "median sigma / true", 0.0, 0.3, "viridis"))
    for row, scan in zip(axes, scans, strict=True):
        for axis, (key, title, low, high, colours) in zip(row, panels, strict=True):
            image = np.full((len(NEWTONS), len(RADII_MM)), np.nan)
            for c in (c for c in table if c["scan"] == scan and c[key] is not None):
                at = NEWTONS.index(c["newtons"]), RADII_MM.index(c["radius_mm"])
                image[at] = c[key]
                mark = "*" if c["saturated"] else ""
                axis.text(at[1], at[0], f"{c[key]:.2f}{mark}", ha="center", va="center", color="black", fontsize=9)
            axis.imshow(image, origin="lower", vmin=low, vmax=high, cmap=colours, alpha=0.6, aspect="auto")
            axis.set_xticks(range(len(RADII_MM)), [f"{r:g}" for r in RADII_MM])
            axis.set_yticks(range(len(NEWTONS)), [f"{f:g}" for f in NEWTONS])
            axis.set(title=f"{scan}: {title}", xlabel="radius, mm", ylabel="force, N")
    figure.suptitle("*: the foam has saturated, a force is a lower bound")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench force", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scan", nargs="+", choices=get_args(ScanMode), default=["full", "rolling"])
    parser.add_argument("--each", type=whole(), default=5, help="presses of every radius and force")
    parser.add_argument("--snr", type=real(infinite=True), default=80.0, metavar="DB")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    rows: list[PressRow] = []
    for scan in args.scan:
        rows += presses(scan, args.snr, args.each, args.seed)
    table = cells(rows, args.snr)
    goals = {}
    for scan in args.scan:
        own = [c for c in table if c["scan"] == scan]
        goals[scan] = targets([r for r in rows if r.scan == scan], own)
        _print(scan, own, goals[scan])
    args.out.mkdir(parents=True, exist_ok=True)
    report = {
        **provenance("force", argv),
        "snr_db": args.snr,
        "seed": args.seed,
        "cells": table,
        "reached": goals,
        "presses": [asdict(r) for r in rows],
    }
    write_json(args.out / "force.json", report)
    draw(table, args.out / "force.png")
    print(f"wrote {args.out / 'force.json'} and {args.out / 'force.png'}")
    return 0


def _print(scan: str, table: Sequence[dict[str, Any]], goals: dict[str, dict[str, Any]]) -> None:
    print(f"\n{scan}: said / true, median +- spread (median sigma / true; floor of one frame); *: saturated")
    print("radius, mm  " + "".join(f"{f'{f:g} N':>30}" for f in NEWTONS))
    for radius in RADII_MM:
        texts = []
        for c in (c for c in table if c["radius_mm"] == radius):
            mark = "*" if c["saturated"] else " "
            said = (
                f"{c['ratio']:.2f}{mark}+- {c['spread']:.2f} ({c['sigma']:.2f}; {c['floor']:.3f})"
                if c["shown"]
                else "-"
            )
            texts.append(f"{said:>30}")
        print(f"{radius:<12g}" + "".join(texts))
    for name, each in goals.items():
        print(f"  {name:<60} {each['reached']:8.3g}   target {each['target']:g}")


if __name__ == "__main__":
    raise SystemExit(main())
