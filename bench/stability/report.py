"""The stability benchmark's tables, JSON and plots."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.accuracy.report import text
from bench.goals import Goal
from bench.json_file import drawn, write_json
from bench.machine import provenance
from bench.stability.run import Row, Setting

COLUMNS = (  # heading, key, format
    ("frames", "frames", "{:.0f}"),
    ("valid %", "valid_%", "{:.0f}"),
    ("refused %", "refused_%", "{:.0f}"),
    ("missed", "missed", "{:.0f}"),
    ("position % side", "position_%", "{:.2f}"),
    ("worst", "position_max_%", "{:.2f}"),
    ("force %", "force_%", "{:.1f}"),
    ("mean IoU", "mean_iou", "{:.3f}"),
    ("size", "size", "{:.0f}"),
    ("condition", "condition", "{:.1e}"),
    ("of the covariance", "condition_covariance", "{:.1e}"),
    ("rank", "rank", "{:.0f}"),
    ("effective", "effective_rank", "{:.1f}"),
    ("at the scale's rung", "effective_rank_sharp", "{:.1f}"),
    ("error", "error", "{:.1e}"),
    ("at the scale's rung", "error_scale_rung", "{:.1e}"),
    ("of the noise", "of_noise", "{:.1e}"),
    ("log sigma", "log_sigma_error", "{:.1e}"),
    ("classes", "classes_error", "{:.1e}"),
    ("moved mm", "moved_mm", "{:.2g}"),
    ("force changed N", "force_changed_N", "{:.2g}"),
    ("IoU changed", "mean_iou_change", "{:+.4f}"),
    ("difference %", "difference_%", "{:.3f}"),
    ("off the finest mm", "against_finest_mm", "{:.3f}"),
    ("touch N", "newtons", "{:.1f}"),
    ("lost", "lost", "{:.0f}"),
    ("median mm", "median_mm", "{:.2f}"),
    ("most mm", "max_mm", "{:.2f}"),
    ("allowed mm", "allowed_mm", "{:.2f}"),
    ("most N", "max_N", "{:.2f}"),
    ("mm per 1 of |d|", "mm_per_share", "{:.0f}"),
    ("N per 1 of |d|", "N_per_share", "{:.0f}"),
    ("rms mm", "rms_mm", "{:.2f}"),
    ("worst direction mm", "worst_direction_mm", "{:.2f}"),
    ("oldest ms", "oldest_ms", "{:.0f}"),
    ("stamp off ms", "stamp_off_ms", "{:.1f}"),
    ("scans refused", "refused", "{:.0f}"),
)
Found = Mapping[str, list[Row]]


def broken(found: Found) -> list[str]:
    """Every broken promise in a line: part, case, how, how often."""
    return [
        f"{part}: {row['case']}: {how} ({count} of {row.get('frames', 1)})"
        for part, rows in found.items()
        for row in rows
        for how, count in row.get("broken", {}).items()
    ]


def show(found: Found) -> None:
    console = Console(width=200) if not sys.stdout.isatty() else Console()
    for part, rows in found.items():
        table = Table(title=part, title_justify="left")
        table.add_column("case")
        shown = [c for c in COLUMNS if any(row.get(c[1]) is not None for row in rows)]
        for heading, _, _ in shown:
            table.add_column(heading, justify="right")
        table.add_column("broken")
        for row in rows:
            cells = [text(row, key, form) for _, key, form in shown]
            table.add_row(
                row["case"], *cells, "; ".join(row.get("broken", {})), style="red" if row.get("broken") else ""
            )
        console.print(table)
    faults = broken(found)
    console.print(f"[bold]{len(faults)} broken promises[/bold]" if faults else "[bold]the promise was kept[/bold]")
    for fault in faults:
        console.print(f"  {fault}", highlight=False)


def head(setting: Setting, seconds: float, cpu_seconds: float) -> dict[str, Any]:
    return {
        **provenance("stability", None),
        "bundle": {"name": setting.bundle.name, "hash": setting.bundle.hash},
        "scan": setting.scan,
        "seed": setting.seed,
        "quick": setting.quick,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(cpu_seconds, 1),
    }


def goals(found: Found) -> list[Goal]:
    return [
        Goal("cases where the promise broke", len(broken(found)), at_most=0, gate=0),
        Goal("cases", sum(map(len, found.values()))),
    ]


def write(path: Path, top: Mapping[str, Any], found: Found) -> None:
    """The report; of whole scans also stability.png beside it. Scans in parts have no curves."""
    targets = [goal.to_dict() for goal in goals(found)]
    content = {**top, "targets": targets, "broken": broken(found), "parts": dict(found)}
    write_json(path, content)
    if top["scan"] == "full":
        drawn(path)
