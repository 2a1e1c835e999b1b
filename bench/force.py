"""Forces of presses of unknown size: said over true, by radius and force; full scans and parts, default settings.

    skin bench force                     100 presses of each scan mode, about five minutes
    skin bench force --live              the same through a running service of its own, about ten minutes
    skin bench force --scan full --each 2 --snr 70

Board, link, clock and stages in simulated time, or real processes; each press is held for 1.2 s and its last contact
counts. The floor is that of one frame whose size is unknown, at the press's place (`skin limits --forces` has its
prior). Writes force.json and force.png, or force_live.json and force_live.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console

from bench import REPORTS
from bench.force_presses import LIVE_SNR_DB, NEWTONS, RADII_MM, SIDE_M, PressRow, live, simulated
from bench.goals import Goal, table
from bench.json_file import write_report
from models.command import real, whole
from models.fisher import MeasurementNoise, floors, mean_floor
from models.force_limits import SIZES
from models.pressure import FOAM
from models.shapes import Shape
from services.contacts.force.of_disc import SATURATED
from services.runtime.config import ScanMode

METRES = SIDE_M / 2  # per model unit
FROM_N = 1.0  # the root mean square is of presses from here on


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
                "error": float(np.sqrt(np.mean((ratio - 1) ** 2))) if len(shown) else None,
                "sigma": float(np.median(sigma)) if len(shown) else None,
                "floor": floor,
                "pressure_ratio": float(np.median([(r.pressure or 0.0) / pressure for r in shown])) if shown else None,
                "saturated": own[0].drop > SATURATED,
                "extrapolated": float(np.mean([r.extrapolated for r in own])),
            }
        )
    return sorted(found, key=lambda c: (c["scan"], c["radius_mm"], c["newtons"]))


def goals(scan: str, rows: Sequence[PressRow], cells: Sequence[dict[str, Any]]) -> list[Goal]:
    """What is wanted of a scan mode's presses, and what they reach: None where too few were shown to say."""
    shown = [r for r in rows if r.said is not None and r.sigma]
    plain = [r for r in shown if r.drop <= SATURATED]
    z = np.array([abs((r.said or 0.0) - r.newtons) / (r.sigma or 1.0) for r in shown])
    firm = np.array([(r.said or 0.0) / r.newtons - 1 for r in plain if r.newtons >= FROM_N])
    by_size = [[(r.said or 0.0) / r.newtons for r in plain if r.radius_mm == mm] for mm in RADII_MM]
    sizes = [float(np.median(ratios)) for ratios in by_size if ratios]
    bias = [abs(c["ratio"] - 1) / c["sigma"] for c in cells if c["ratio"] is not None]
    over = [c["sigma"] / c["floor"] for c in cells if c["sigma"] and not c["saturated"]]
    erring = [c["error"] / c["floor"] for c in cells if c["error"] and not c["saturated"]]
    furthest = 100 * max(abs(size - 1) for size in sizes) if len(sizes) == len(RADII_MM) else None
    rms = 100 * float(np.sqrt(np.mean(firm**2))) if len(firm) else None
    within = [100 * float(np.mean(z < k)) if len(z) else None for k in (1, 3)]
    least = [
        ("presses shown, %", 100 * len(shown) / len(rows), 100.0),
        ("within one sigma, %", within[0], 68.0),
        ("within three sigma, %", within[1], 99.5),
    ]
    most = [
        ("median said / true by radius, furthest from 1, %", furthest, 5.0),
        (f"root mean square error from {FROM_N:g} N on, %", rms, 7.0),
        ("bias of a radius and force, over its sigma, at most", max(bias, default=None), 1.0),
        ("median sigma over the floor of one frame", _median(over), 1.3),
        ("median error (rms) over that floor: what an honest sigma is", _median(erring), None),
    ]
    found = [Goal(f"{scan}: {name}", value, at_least=target) for name, value, target in least]
    return found + [Goal(f"{scan}: {name}", value, at_most=target) for name, value, target in most]


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench force", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="one press of every radius and force")
    parser.add_argument("--live", action="store_true", help="through the processes of a running service, in real time")
    parser.add_argument("--scan", nargs="+", choices=get_args(ScanMode), default=["full", "rolling"])
    parser.add_argument("--each", type=whole(), default=5, help="presses of every radius and force")
    parser.add_argument("--snr", type=real(infinite=True), default=LIVE_SNR_DB, metavar="DB")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    if args.live and args.snr != LIVE_SNR_DB:
        parser.error(f"--snr {args.snr:g} with --live: found both, but the stub of `skin up` has {LIVE_SNR_DB:g} dB")
    each = 1 if args.quick else args.each
    rows: list[PressRow] = []
    for scan in args.scan:
        rows += live(scan, each, args.seed) if args.live else simulated(scan, args.snr, each, args.seed)
    of = cells(rows, args.snr)
    wanted: list[Goal] = []
    for scan in args.scan:
        own = [c for c in of if c["scan"] == scan]
        wanted += goals(scan, [r for r in rows if r.scan == scan], own)
        _print(scan, own)
    Console().print(table(wanted))
    report = {"snr_db": args.snr, "seed": args.seed, "cells": of, "presses": [asdict(r) for r in rows]}
    write_report(args.out / f"force{'_live' if args.live else ''}.json", argv, wanted, report)
    return 0


def _print(scan: str, cells: Sequence[dict[str, Any]]) -> None:
    print(f"\n{scan}: said / true, median +- spread (median sigma / true; floor of one frame); *: saturated")
    print("radius, mm  " + "".join(f"{f'{f:g} N':>30}" for f in NEWTONS))
    for radius in RADII_MM:
        texts = []
        for c in (c for c in cells if c["radius_mm"] == radius):
            mark = "*" if c["saturated"] else " "
            said = (
                f"{c['ratio']:.2f}{mark}+- {c['spread']:.2f} ({c['sigma']:.2f}; {c['floor']:.3f})"
                if c["shown"]
                else "-"
            )
            texts.append(f"{said:>30}")
        print(f"{radius:<12g}" + "".join(texts))


if __name__ == "__main__":
    raise SystemExit(main())
