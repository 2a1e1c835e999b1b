"""The tracking benchmark's tables and JSON."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.goals import Goal, table
from bench.json_file import write_json
from bench.machine import provenance
from bench.tracking.scene import Recorded
from models.bundle import Bundle

COLUMNS = (  # heading, key, format
    ("frames", "frames", "{:.0f}"),
    ("touches", "touches", "{:.0f}"),
    ("valid %", "valid_%", "{:.1f}"),
    ("rough %", "rough_%", "{:.1f}"),
    ("seen %", "seen_%", "{:.1f}"),
    ("position % side", "position_%", "{:.2f}"),
    ("p95", "position_p95_%", "{:.2f}"),
    ("force %", "force_%", "{:.1f}"),
    ("p95", "force_p95_%", "{:.0f}"),
    ("bias", "force_bias_%", "{:+.1f}"),
    ("all forces %", "force_all_%", "{:.1f}"),
    ("in 1 sigma %", "within_1_sigma_%", "{:.0f}"),
    ("switches", "switches", "{:.0f}"),
    ("false", "false_touches", "{:.0f}"),
    ("unseen", "unseen", "{:.0f}"),
    ("wrong %", "wrong_%", "{:.2f}"),
    ("begin", "begin_frames", "{:.1f}"),
    ("most", "begin_most", "{:.1f}"),
    ("end", "end_frames", "{:.1f}"),
    ("most", "end_most", "{:.1f}"),
)
FAULTS = (
    ("frames", "frames", "{:.0f}"),
    ("named after", "named", "{:.0f}"),
    ("named %", "named_%", "{:.0f}"),
    ("marked after", "marked", "{:.0f}"),
    ("well again after", "well_again", "{:.0f}"),
    ("others named", "others_named_frames", "{:.0f}"),
    ("valid %", "valid_%", "{:.0f}"),
)
NAMED_WITHIN = 3  # frames
KEPT_NOTES = 100  # in the report


def goals(found: dict[str, Any]) -> list[Goal]:
    """What the scene must reach."""
    row, faults = found["all"], found["faults"]
    per_100 = 100 * row["switches"] / max(row["touches"], 1)
    late = sum(f["named"] is None or f["named"] > NAMED_WITHIN for f in faults)
    fade = found["fade_%"]
    return [
        Goal("position error, median, % of the side", row["position_%"], at_most=1.5, gate=1.5),
        Goal("force error, median, %", row["force_%"], at_most=7.0, gate=16.0),
        Goal("id switches per 100 touches", per_100, at_most=1.0, gate=10.0),
        Goal("false touches", row["false_touches"], at_most=0, gate=5),
        Goal(f"electrode faults not named within {NAMED_WITHIN} frames, of {len(faults)}", late, at_most=0),
        *([] if fade is None else [Goal("force of the held touch, change, %", abs(fade), at_most=2.0)]),
    ]


def head(args: argparse.Namespace, bundle: Bundle, recorded: Recorded, simulated_s: float, scored_s: float) -> Any:
    return {
        **provenance("tracking", None),
        "bundle": {"name": bundle.name, "hash": bundle.hash, "network": args.network},
        "scene": args.scene,
        "scan": args.scan,
        "seed": args.seed,
        "snr_db": args.snr,
        "frames": len(recorded),
        "simulated_s": round(simulated_s, 1),  # 0: read from bench/work
        "scored_s": round(scored_s, 1),
    }


def show(head: dict[str, Any], found: dict[str, Any], notes: bool) -> None:
    console = Console(width=220) if not sys.stdout.isatty() else Console()
    title = f"{head['scene']}, {head['scan']} scans, {head['frames']} frames, {head['snr_db']:g} dB"
    title += f", {head['bundle']['name']}"
    rows = [*found["sections"].items(), ("all", found["all"])]
    console.print(_table(title, "section", COLUMNS, rows))
    named = [(f"{f['fault']} {_brief(f['args'])} at {f['at_s']:.0f} s", f) for f in found["faults"]]
    console.print(_table("injected faults: frames", "fault", FAULTS, named))
    console.print(table(goals(found)))
    print(
        f"frames that name a healthy electrode: {found['false_alarms']}; sample time off by at most "
        f"{found['sample_time_p95_ms']:.2f} ms in 95 %; simulated in {head['simulated_s']:g} s, scored in "
        f"{head['scored_s']:g} s, {head['machine']}"
    )
    for seconds, section, text in found["notes"] if notes else []:
        print(f"{seconds:7.2f} s  {section}: {text}")


def write(path: Path, head: dict[str, Any], found: dict[str, Any]) -> None:
    content = {
        **head,
        "targets": [goal.to_dict() for goal in goals(found)],
        **found,
        "notes": found["notes"][:KEPT_NOTES],
    }
    write_json(path, content)
    print(f"wrote {path}")


def _table(title: str, first: str, columns: Any, rows: Any) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(first)
    for heading, _, _ in columns:
        table.add_column(heading, justify="right")
    for name, row in rows:
        shown = [(row[key], form) for _, key, form in columns]
        table.add_row(name, *("" if value is None else form.format(value) for value, form in shown))
    return table


def _brief(args: dict[str, Any]) -> str:
    return " ".join(str(v) for k, v in args.items() if k != "second" or v >= 0).replace(", ", "+")
