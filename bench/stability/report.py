"""The stability benchmark's tables, JSON and plots."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.accuracy.report import text
from bench.goals import Goal
from bench.json_file import write_json
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


def write(folder: Path, top: Mapping[str, Any], found: Found) -> None:
    """stability.json in `folder`, and stability.png where there are curves to draw."""
    targets = [goal.to_dict() for goal in goals(found)]
    content = {**top, "targets": targets, "broken": broken(found), "parts": dict(found)}
    write_json(folder / "stability.json", content)
    if any(found.get(part) for part, *_ in PANELS):
        draw(found, folder / "stability.png")


PANELS = (  # part, x axis, log x, curves (key, label), log y
    ("lambda", "lambda", True, ("position_%", "force_%"), True),
    ("signal over noise", "dB", False, ("position_%", "force_%"), True),
    ("a few noisy measurements", "times the others' noise", True, ("position_%", "force_%"), True),
    ("measurement scale", "factor", True, ("position_%", "force_%"), True),
    ("background", "S/m", True, ("position_%", "force_%"), True),
    ("contact impedance", "factor", True, ("position_%", "force_%"), True),
    ("electrode positions", "% of the spacing", False, ("position_%", "force_%"), True),
    ("meshes, coarse to fine", "elements", True, ("difference_%", "position_%", "force_%"), True),
    ("dead electrodes", "electrodes", False, ("valid_%", "position_%"), False),
    ("saturated channels", "channels", False, ("valid_%", "position_%"), False),
    ("not numbers in some channels", "channels", False, ("valid_%", "position_%"), False),
    ("change within noise", "dB", False, ("median_mm", "max_mm"), True),
    ("float32 against float64, by stage", "", False, ("error",), True),
)
LABELS = {
    "position_%": "position, % of side",
    "force_%": "force, %",
    "valid_%": "valid, %",
    "difference_%": "difference, %",
}


def draw(found: Found, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = [p for p in PANELS if found.get(p[0])]
    if not panels:
        return
    figure, axes = plt.subplots(-(-len(panels) // 3), 3, figsize=(15, 3.6 * -(-len(panels) // 3)), squeeze=False)
    for axis in axes.ravel()[len(panels) :]:
        axis.axis("off")
    for axis, (part, label, log_x, keys, log_y) in zip(axes.ravel(), panels, strict=False):
        rows = found[part]
        if not label:
            _bars(axis, rows)
        else:
            _curves(axis, rows, [key for key in keys if key != "valid_%"])
            if "valid_%" in keys:  # its errors have another scale
                other = axis.twinx()
                _curves(other, rows, ["valid_%"], "C2")
                other.legend(fontsize=7, loc="lower right")
                axis.set_ylim(bottom=0)
            axis.set_xlabel(label)
            if axis.lines:
                axis.legend(fontsize=7)
        if log_x:
            axis.set_xscale("log")
        if log_y and label:
            axis.set_yscale("log")
        axis.set_title(part, fontsize=10)
        axis.grid(True, which="major", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _curves(axis: Any, rows: list[Row], keys: Sequence[str], own_colour: str = "") -> None:
    """One curve a figure; a part's noise levels in their own line styles."""
    levels = list(dict.fromkeys(row.get("dB") for row in rows))
    kinds = list(dict.fromkeys(row.get("kind") for row in rows))
    for colour, key in enumerate(keys):
        for style, (level, kind) in enumerate((level, kind) for level in levels for kind in kinds):
            own = [r for r in rows if r.get("dB") == level and r.get("kind") == kind and r.get(key) is not None]
            if not own:
                continue
            x, y = (np.array([row[k] for row in own], float) for k in ("value", key))
            name = LABELS.get(key, key.replace("_", " "))
            if level is not None:
                name += ", noise-free" if np.isinf(level) else f", {level:g} dB"
            if kind is not None:
                name += f", {kind}"
            axis.plot(
                x,
                y,
                marker="o",
                ms=3,
                ls="-" if len(set(x)) == len(x) else "",
                c=own_colour or f"C{colour}",
                alpha=max(0.3, 1 - 0.3 * style),
                label=name,
            )


def _bars(axis: Any, rows: list[Row]) -> None:
    shown = [r for r in rows if r.get("error")]
    values = [min(r["error"], 1.0) for r in shown]
    axis.barh(range(len(shown)), values, color=["C3" if r["error"] > 1e-2 else "C0" for r in shown], log=True)
    axis.set_yticks(range(len(shown)), [r["case"] for r in shown], fontsize=6)
    axis.set_xlabel("largest relative error")
