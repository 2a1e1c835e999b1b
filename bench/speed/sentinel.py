"""Adaptive scan: how the sentinel list was chosen, what it detects, and what it saves from touch to contact.

    skin bench sentinel [--presses 40] [--touches 100] [--minutes 30] [--quick]

Everything in simulated time: the stub's board behind its line, acquisition and the stages, on presses at random phases
of the scan. Prints the tables, writes sentinel.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed import sentinel_studies as studies
from bench.speed.sentinel_timing import latencies
from models.bundle import Bundle
from models.sentinel import design

FASTER = 3.0  # target: full scans' mean time to a contact over the adaptive one's


def timing(presses: int, seed: int, light: bool) -> list[dict[str, Any]]:
    rows = []
    for scan in ("full", "adaptive"):
        found = latencies(scan, presses, seed, light)
        for kind in ("any", "full", "release"):
            ms = 1e3 * found[kind]
            seen = ms[np.isfinite(ms)]
            rows.append(
                {"scan": scan, "to": {"any": "first contact", "full": "full contact"}.get(kind, kind)}
                | {"seen": f"{len(seen)}/{len(ms)}"}
                | {name: float(of(seen)) for name, of in STATISTICS.items()}
            )
        rows[-3] |= {"false": found["false"], "counts": found["counts"]}
        if found["errors"]["coarse"]:
            error, off = 1e3 * np.array(found["errors"]["coarse"]), np.abs(found["off"])
            rows[-3] |= {"coarse_mm_p50": float(np.median(error)), "coarse_mm_p95": float(np.percentile(error, 95))}
            rows[-3] |= {"force_within_1_sigma": float((off < 1).mean()), "within_2": float((off < 2).mean())}
    return rows


STATISTICS: dict[str, Callable[[Any], Any]] = {
    "mean_ms": np.mean,
    "p50_ms": np.median,
    "p95_ms": lambda v: np.percentile(v, 95),
    "max_ms": np.max,
}


def report(options: argparse.Namespace) -> dict[str, Any]:
    bundle = Bundle.load("square16")
    found = design(bundle.matrices)
    timed = {name: timing(options.presses, options.seed, name == "light") for name in ("ordinary", "light")}
    first = {row["scan"]: row["mean_ms"] for row in timed["ordinary"] if row["to"] == "first contact"}
    return {
        "list": bundle.pattern[found.rows][:, :2].tolist(),
        "smallest": bundle.pattern[found.smallest][:, :2].tolist(),
        "lengths": studies.lengths(bundle),
        "power": studies.power(bundle, options.touches, 200, options.seed),
        "false_alarms": studies.false_alarms(bundle, options.minutes, options.seed),
        "timing": timed,
        "faster": first["full"] / first["adaptive"],
        "hold_floor": studies.hold(),
        "averaged": studies.averaged(bundle, 10 if options.quick else 100),
        "partial": studies.partial(),
        "patterns": studies.d_optimal(),
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench sentinel", description=__doc__.splitlines()[0])
    parser.add_argument("--presses", type=int, default=40)
    parser.add_argument("--touches", type=int, default=100, help="solved for the power")
    parser.add_argument("--minutes", type=float, default=30.0, help="simulated untouched, for false alarms")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a short form: 6 presses, 10 touches, 1 minute")
    parser.add_argument("--out", type=Path, default=REPORTS)
    options = parser.parse_args(argv)
    if options.quick:
        options.presses, options.touches, options.minutes = 6, 10, 1.0
    found = provenance("sentinel", argv) | report(options)
    wanted = goals(found)
    found["targets"] = [goal.to_dict() for goal in wanted]
    write_json(options.out / "sentinel.json", found)
    _print(found)
    Console(width=150).print(_goals.table(wanted))
    return 0 if all(goal.passed for goal in wanted) else 1


def goals(found: dict[str, Any]) -> list[Goal]:
    times = {(row["scan"], row["to"]): row for row in found["timing"]["ordinary"]}
    ours, plain = times["adaptive", "full contact"], times["full", "full contact"]
    full, late = (ours[key] / plain[key] for key in ("mean_ms", "p95_ms"))
    power, alarms = found["power"], found["false_alarms"]
    return [
        Goal("first contact so many times sooner than with full scans", found["faster"], at_least=FASTER, gate=FASTER),
        Goal("time to the full contact, of that with full scans", full, at_most=1.0, gate=1.05),
        Goal("the same, 95th percentile", late),
        Goal("1 N presses of radius 0.2 seen at 70 dB, share", power["seen"], at_least=0.999, gate=0.999),
        Goal("false wake-ups a minute", alarms["hits_per_minute"], at_most=1.0),
    ]


def _print(found: dict[str, Any]) -> None:
    console = Console(width=150)
    console.print(f"smallest list that detects: {found['smallest']}; list in use: {found['list']}")
    for title, rows in (
        ("lists of other lengths; 1 N, radius 0.2, 70 dB, worst position", found["lengths"]),
        ("power, presses solved on the stub's mesh, first scan", [found["power"]]),
        ("untouched, drifting", [found["false_alarms"]]),
        ("touch to contact, 1 to 5 N, radius 10 mm", found["timing"]["ordinary"]),
        ("touch to contact, 1 N, radius 5 mm: the least that full scans see", found["timing"]["light"]),
        ("held: floor of the position, % of the side, by DFT points", found["hold_floor"]),
        ("held: errors on means of frames, position % of the side, peak and integrated drop %", found["averaged"]),
        ("the best n of 120 pairs for one known touch: floor; and at equal time, of all pairs'", found["partial"]),
        ("floor of the position by pattern, % of the side", found["patterns"]),
    ):
        console.print(_table(title, rows))


def _table(title: str, rows: Iterable[dict[str, Any]]) -> Table:
    rows = [{k: v for k, v in row.items() if not isinstance(v, dict)} for row in rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table(*names, title=title, title_justify="left")
    for row in rows:
        cells = [row.get(name, "") for name in names]
        table.add_row(*(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells))
    return table


if __name__ == "__main__":
    sys.exit(main())
