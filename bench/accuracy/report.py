"""The accuracy benchmark's table, JSON and plot."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.accuracy.frames import REFERENCE, Frames, Level
from bench.accuracy.scores import Row
from bench.goals import Goal, table
from bench.json_file import drawn, write_json
from bench.machine import machine, provenance
from models.bundle import Bundle
from services.runtime.config import Reads

COLUMNS = (  # heading, key, format
    ("ms", "ms", "{:.2f}"),
    ("IoU", "mean_iou", "{:.3f}"),
    ("contact IoU", "contact_iou", "{:.3f}"),
    ("LDCI", "ldci-0.2-0.15", "{:.3f}"),
    ("wide", "ldci-0.25-0.15", "{:.3f}"),
    ("0.15 S/m", "ldci-0.2-0.85", "{:.3f}"),
    ("position % side", "position_%", "{:.2f}"),
    ("p95", "position_p95_%", "{:.2f}"),
    ("force %", "force_%", "{:.1f}"),
    ("integral %", "integral_%", "{:.1f}"),
    ("corr.", "correlation", "{:.3f}"),
    ("SSIM", "ssim", "{:.3f}"),
    ("count %", "count_%", "{:.0f}"),
    ("shape %", "shape_%", "{:.0f}"),
    ("frames", "frames", "{:.0f}"),
)
# key, figure, target noise-free, at 70 dB: at least (>=) or at most (<=) so much, or so many Bayesian floors.
TARGETS = (
    ("mean_iou", "mean IoU, five shapes", ">= 0.955", ">= 0.882"),
    ("contact_iou", "contact IoU", ">= 0.91", ">= 0.775"),
    ("ldci-0.2-0.15", "LDCI, 0.85 S/m inside", "<= 0.012", ""),
    ("force_%", "force, size unknown, %", "<= 3", "1.3 floors"),
    ("known_force_%", "force, known indenter, %", "<= 2", "<= 3"),
    ("force_within_%", "presses within one sigma of force, %", "", ""),
    ("integral_%", "integrated drop, %", "<= 2", "1.3 floors"),
    ("position_%", "position, % of side", "<= 0.3", "1.05 floors"),
    ("position_p95_%", "position, p95, % of side", "", "<= 2"),
    ("shape_%", "shape class, radius >= 0.25, %", ">= 98.5", ">= 77"),
    ("count_%", "two or three touches counted right, %", ">= 97", ">= 93"),
    ("false_touches_h", "false touches an hour", "", ""),
    ("network_ms", "network alone, ms", "<= 1", "<= 1"),
)
SIXTY_DB = 0.828  # mean IoU wanted there
CLASSICAL = ("NOSER", "total variation", "Gauss-Newton", "GREIT", "pyEIT")
OF_CLASSICAL = 0.75  # the short form's gate: mean IoU missed, of what the best classical method misses
RMS = {
    "position_%": "position_rms_%",
    "force_%": "force_rms_%",
    "known_force_%": "known_force_rms_%",
    "integral_%": "integral_rms_%",
}


def progress(row: Row) -> None:
    """A line on standard error as each row is done."""
    print(f"{row['level']:>5} {row['method']}: IoU {row['mean_iou']:.3f}, {row['ms']:.2f} ms", file=sys.stderr)


def text(row: Row, key: str, form: str) -> str:
    """The figure, and its standard error where the row has one."""
    value, error = row.get(key), row.get(f"{key}_se")
    if value is None or not np.isfinite(value):
        return ""
    spread = f" +-{form.format(error)}" if error is not None and np.isfinite(error) else ""
    return form.format(value) + spread


@dataclass(frozen=True, eq=False)
class Report:
    rows: list[Row]
    floors: dict[str, Row]
    frames: Frames
    mesh: str
    seed: int
    bundle: Bundle
    reads: Reads = "pressure"  # what the shipped rows' forces are read from; the others' from the peak drop

    @property
    def head(self) -> dict[str, object]:
        names, counts = np.unique(self.frames.group, return_counts=True)
        return {
            **provenance("accuracy", None),
            "bundle": {"name": self.bundle.name, "hash": self.bundle.hash},
            "mesh": self.mesh,
            "seed": self.seed,
            "reads": self.reads,
            "frames": {str(name): int(count) for name, count in zip(names, counts, strict=True)},
            "eidors": REFERENCE.exists(),
            "time": "CPU time of one thread per frame, median; shipped: the whole pipeline, mean",
        }

    def print(self) -> None:
        console = Console(width=200) if not sys.stdout.isatty() else Console()
        for level in dict.fromkeys(row["level"] for row in self.rows):
            made = Table(title=f"{Level(level).title}, {self.mesh} mesh, {machine()}", title_justify="left")
            made.add_column("method")
            for heading, _, _ in COLUMNS:
                made.add_column(heading, justify="right")
            for row in (r for r in self.rows if r["level"] == level):
                name = row["method"] + (f" ({row['value']:g})" if row["value"] is not None else "")
                made.add_row(name, *(text(row, key, form) for _, key, form in COLUMNS))
            floor = self.floors.get(level)
            if floor:
                shown = {key: floor.get(rms) for key, rms in RMS.items()}
                made.add_row("Bayesian floor (rms)", *(text(shown, key, form) for _, key, form in COLUMNS), style="dim")
            console.print(made)
        console.print(table(self.goals()))

    def goals(self) -> list[Goal]:
        """The shipped network against its targets, and against the best of the classical methods."""
        found = []

        def shipped(method: str, level: str) -> Row:
            return next((r for r in self.rows if r["method"] == method and r["level"] == level), {})

        for level, column in (("none", 2), ("70", 3)):
            title = Level(level).title
            row = shipped("shipped, full", level)
            for target in TARGETS:
                found.append(self._goal(target[0], f"{target[1]}, {title}", target[column], row, level))
            others = [r["mean_iou"] for r in self.rows if r["method"].startswith(CLASSICAL) and r["level"] == level]
            if row and others:
                missed = (1 - row["mean_iou"]) / (1 - max(others))
                figure = f"mean IoU missed, of the best classical method's, {title}"
                found.append(Goal(figure, missed, gate=OF_CLASSICAL))
        if (ldci := shipped("shipped, int8", "none").get("ldci-0.2-0.15")) is not None:
            found.append(Goal("LDCI, 0.85 S/m inside, int8 as it runs by default, noise-free", ldci, at_most=0.012))
        for level, wanted in (("50", None), ("60", SIXTY_DB)):
            if row := shipped("shipped, full", level):
                title = Level(level).title
                found.append(Goal(f"mean IoU, five shapes, {title}", row["mean_iou"], at_least=wanted))
                found.append(Goal(f"touches that are not shown, {title}", row["missed"]))
                found.append(Goal(f"touches shown over 10 % of the side away, {title}", row["far"], at_most=0))
        return [goal for goal in found if goal.value is not None or goal.wanted]

    def _goal(self, key: str, figure: str, target: str, row: Row, level: str) -> Goal:
        if target.endswith("floors"):
            rms, floor = row.get(RMS[key]), self.floors.get(level, {}).get(RMS[key])
            ratio = rms / floor if rms is not None and floor else None
            return Goal(f"{figure}: rms over its floor", ratio, at_most=float(target.split()[0]))
        value = row.get(key)
        if not target:
            return Goal(figure, value)
        sign, bound = target.split()
        return Goal(figure, value, **{"at_least" if sign == ">=" else "at_most": float(bound)})

    def write(self, folder: Path) -> None:
        """accuracy.json and accuracy.png in `folder`."""
        targets = [goal.to_dict() for goal in self.goals()]
        write_json(
            folder / "accuracy.json", {**self.head, "targets": targets, "floors": self.floors, "rows": self.rows}
        )
        drawn(folder / "accuracy.json")
