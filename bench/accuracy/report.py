"""The accuracy benchmark's table and targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.table import Table

from bench.accuracy.compare import SERVICE
from bench.accuracy.frames import Level
from bench.accuracy.scores import Row
from bench.goals import Goal, titled
from bench.machine import machine

COLUMNS = (  # heading, key, format
    ("ms", "ms", "{:.2f}"),
    ("IoU", "mean_iou", "{:.3f}"),
    ("contact IoU", "contact_iou", "{:.3f}"),
    ("LDCI", "ldci-0.2-0.15", "{:.3f}"),
    ("wide", "ldci-0.25-0.15", "{:.3f}"),
    ("0.15 S/m", "ldci-0.2-0.85", "{:.3f}"),
    ("position % side", "position_%", "{:.2f}"),
    ("p95", "position_p95_%", "{:.2f}"),
    ("not shown", "missed", "{:.0f}"),
    ("force %", "force_%", "{:.1f}"),
    ("integral %", "integral_%", "{:.1f}"),
    ("corr.", "correlation", "{:.3f}"),
    ("SSIM", "ssim", "{:.3f}"),
    ("one %", "single_%", "{:.0f}"),
    ("2 or 3 %", "count_%", "{:.0f}"),
    ("four %", "four_%", "{:.0f}"),
    ("shape %", "shape_%", "{:.0f}"),
    ("frames", "frames", "{:.0f}"),
)
TARGETS = (  # of the service: key, figure, at least or at most, noise-free, at 70 dB
    ("mean_iou", "mean IoU, five shapes", "at_least", 0.955, 0.882),
    ("contact_iou", "contact IoU", "at_least", 0.91, 0.775),
    ("ldci-0.2-0.15", "LDCI, 0.85 S/m inside", "at_most", 0.012, None),
    ("force_%", "force, size unknown, %", "at_most", 3.0, None),
    ("position_%", "position of touches that are shown, % of side", "at_most", 0.3, None),
    ("position_p95_%", "the same, p95", "at_most", None, 2.0),
    ("shape_%", "shape class, radius >= 0.25, %", "at_least", 98.5, 77.0),
    ("single_%", "one touch counted right, %", "at_least", None, None),
    ("count_%", "two or three touches counted right, %", "at_least", 97.0, 93.0),
    ("four_%", "four touches counted right, %", "at_least", None, None),
    ("missed", "single touches that are not shown", "at_most", 0.0, 0.0),
    ("far", "single touches shown over 10 % of the side away", "at_most", 0.0, 0.0),
)


def text(row: Mapping[str, float | None], key: str, form: str) -> str:
    """The figure, and its standard error where the row has one."""
    value, error = row.get(key), row.get(f"{key}_se")
    if value is None or not np.isfinite(value):
        return ""
    spread = f" +-{form.format(error)}" if error is not None and np.isfinite(error) else ""
    return form.format(value) + spread


def table(level: str, rows: Sequence[Row], floor: Row, mesh: str, reads: str) -> Table:
    headings = "method", *(heading for heading, _, _ in COLUMNS)
    made = titled(f"{Level(level).title}, {mesh} mesh, {machine()}", headings)
    for row in (r for r in rows if r["level"] == level):
        name = row["method"] + (f" ({row['value']:g})" if row["value"] is not None else "")
        made.add_row(name, *(text(row, key, form) for _, key, form in COLUMNS))
    if floor:
        force = floor["drop_rms_%" if reads == "peak" else "force_rms_%"]
        shown = {
            **floor,
            "force_%": force,
            "position_%": floor["position_rms_%"],
            "integral_%": floor["integral_rms_%"],
        }
        made.add_row("Bayesian floor (rms)", *(text(shown, key, form) for _, key, form in COLUMNS), style="dim")
    return made


def goals(rows: Sequence[Row]) -> list[Goal]:
    """What the service reaches, beside what is wanted of it."""
    found = []
    for row in (r for r in rows if r["method"] == SERVICE):
        for key, figure, bound, *wanted in TARGETS:
            target = dict(zip(("none", "70"), wanted, strict=True)).get(row["level"])
            found.append(Goal(f"{figure}, {Level(row['level']).title}", row.get(key), **{bound: target}))
    return found
