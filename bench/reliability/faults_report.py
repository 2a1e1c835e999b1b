"""Tables, targets and gates of `skin bench faults`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table

from bench._goals import Goal
from bench.reliability.matrix import ROWS, SITUATIONS, Score
from bench.reliability.report import cell, console

COLUMNS = (  # heading, key, format
    ("cases", "cases", "{:.0f}"),
    ("wrong", "wrong", "{:.0f}"),
    ("of them changing", "wrong_changing", "{:.0f}"),
    ("unseen", "unseen", "{:.0f}"),
    ("named %", "named_%", "{:.0f}"),
    ("again, median s", "again_median_s", "{:.2f}"),
    ("most", "again_most_s", "{:.2f}"),
    ("too late", "late", "{:.0f}"),
    ("invalid %", "invalid_%", "{:.1f}"),
    ("during it", "during_invalid_%", "{:.0f}"),
)
# What held on 22 November 2026, in the quick form; raised or lowered to what a change achieves. The targets are beside.
GATES = {"wrong": math.inf, "late": math.inf, "unnamed": math.inf}


def matrix_rows(cells: Mapping[tuple[str, str], Score]) -> dict[str, dict[str, Any]]:
    """ "fault, situation" -> figures; the fault alone: all its situations."""
    found: dict[str, dict[str, Any]] = {}
    for row in ROWS:
        whole = _sum(score for (title, _), score in cells.items() if title == row.title)
        if whole.cases:
            found[row.title] = whole.row() | {"recovery_s": row.recovery_s}
            found |= {f"{row.title}, {s}": cells[row.title, s].row() for s in SITUATIONS if (row.title, s) in cells}
    return found


def matrix_goals(cells: Mapping[tuple[str, str], Score], quick: bool) -> list[Goal]:
    whole = _sum(cells.values())
    unnamed = whole.nameable - whole.named
    gate = {key: value if quick and math.isfinite(value) else None for key, value in GATES.items()}
    return [
        Goal(
            "valid frames with a phantom or a contact more than 15 mm off", whole.wrong, at_most=0, gate=gate["wrong"]
        ),
        Goal(f"faults not named while they lasted, of {whole.nameable}", unnamed, at_most=0, gate=gate["unnamed"]),
        Goal(
            f"cases valid again later than 1 s (measurements), 2 s (gain), 3 s (board), of {whole.cases}",
            whole.late,
            at_most=0,
            gate=gate["late"],
        ),
        Goal("share of frames that are not valid, from the fault's beginning on, %", whole.row()["invalid_%"]),
    ]


def _sum(scores: Any) -> Score:
    whole = Score()
    for score in scores:
        whole.add(score)
    return whole


def show(found: Mapping[str, Any]) -> None:
    if rows := found.get("matrix"):
        console().print(_matrix(rows))
        for row in ROWS:
            if row.title in rows and rows[row.title]["wrong"]:
                print(f"wrong: {'; '.join(rows[row.title]['worst'][:2])}")


def _matrix(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    made = Table(title="faults of the board, all situations", title_justify="left")
    made.add_column("fault")
    for heading, _, _ in COLUMNS:
        made.add_column(heading, justify="right")
    made.add_column("wrong in untouched/held/sliding/begins", justify="right")
    made.add_column("reasons while it lasted")
    for row in ROWS:
        if row.title in rows:
            whole = rows[row.title]
            cells = [cell(whole.get(key), form) for _, key, form in COLUMNS]
            split = "/".join(str(rows[f"{row.title}, {s}"]["wrong"]) for s in SITUATIONS)
            style = "red" if whole["wrong"] or whole["late"] else ""
            made.add_row(row.title, *cells, split, ", ".join(whole["reasons"]), style=style)
    return made
