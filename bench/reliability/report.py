"""What the reports of `skin bench faults` and `skin bench drift` have in common."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.table import Table

from bench.goals import Goal, table
from bench.json_file import write_json
from bench.machine import provenance
from models.bundle import Bundle

Column = tuple[str, str, str]  # heading, key, format
NEVER = "never"  # what an infinite time or count is shown as


def head(benchmark: str, argv: Sequence[str] | None, args: argparse.Namespace, seconds: float) -> dict[str, Any]:
    bundle = Bundle.load(args.bundle)
    return {
        **provenance(benchmark, argv),
        "bundle": {"name": bundle.name, "hash": bundle.hash},
        "seed": args.seed,
        "snr_db": 80,
        "seconds": round(seconds, 1),
    }


def console() -> Console:
    return Console(width=150) if not sys.stdout.isatty() else Console()


def table_of(title: str, first: str, columns: Sequence[Column], rows: Iterable[tuple[str, Mapping[str, Any]]]) -> Table:
    made = Table(title=title, title_justify="left")
    made.add_column(first)
    for heading, _, _ in columns:
        made.add_column(heading, justify="right")
    for name, row in rows:
        made.add_row(name, *(cell(row.get(key), form) for _, key, form in columns))
    return made


def cell(value: Any, form: str) -> str:
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(value)
    return NEVER if isinstance(value, float) and math.isinf(value) else form.format(value)


def show(head: Mapping[str, Any], goals: Sequence[Goal]) -> None:
    console().print(table(goals))
    print(f"{head['seconds']:.0f} s, {head['machine']}, bundle {head['bundle']['name']} {head['bundle']['hash'][:12]}")


def write(path: Path, head: Mapping[str, Any], found: Mapping[str, Any], goals: Sequence[Goal]) -> None:
    write_json(path, {**head, "targets": [goal.to_dict() for goal in goals], **found})
    print(f"wrote {path}")


def status(goals: Sequence[Goal], errors: TextIO) -> int:
    """1 where a gate is broken."""
    broken = [goal for goal in goals if not goal.passed]
    for goal in broken:
        print(f"FAILED: {goal.figure}: {goal.measured}, gate {goal.gate:g}", file=errors)
    return 1 if broken else 0
