"""Tables, targets and gates of `skin bench trust`, and its report."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.goals import Goal, titled
from firmware_stub.worlds.table import WORLDS

Column = tuple[str, str, str]  # heading, key, format
Rows = Mapping[str, Mapping[str, Any]]
WRONG: tuple[Column, ...] = (
    ("minutes", "minutes", "{:.1f}"),
    ("frames", "frames", "{:.0f}"),
    ("touches", "touches", "{:.0f}"),
    ("phantom frames", "phantom frames", "{:.0f}"),
    ("incidents", "phantom incidents", "{:.0f}"),
    ("wrong counts", "wrong counts", "{:.0f}"),
    ("hidden", "hidden", "{:.0f}"),
    ("briefly, frames", "hidden briefly", "{:.0f}"),
    ("none shown", "none shown", "{:.0f}"),
    ("never shown", "never shown", "{:.0f}"),
    ("ids changed", "ids", "{:.0f}"),
    ("on a refused image", "refused", "{:.0f}"),
    ("aged", "aged", "{:.0f}"),
    ("faults", "faults", "{:.0f}"),
    ("named", "named", "{:.0f}"),
    ("late", "late", "{:.0f}"),
    ("false frames", "false", "{:.0f}"),
    ("valid again late", "back late", "{:.0f}"),
)
ERRORS: tuple[Column, ...] = (
    ("valid untouched %", "valid untouched %", "{:.1f}"),
    ("touched %", "valid touched %", "{:.1f}"),
    ("in faults %", "valid in faults %", "{:.1f}"),
    ("again after s", "back s", "{:.2f}"),
    ("changing %", "changing %", "{:.1f}"),
    ("coarse %", "coarse %", "{:.1f}"),
    ("force > 3 sigma %", "force 3 %", "{:.2f}"),
    ("> 6", "force 6", "{:.0f}"),
    ("sigma N", "force sigma", "{:.3f}"),
    ("held", "force sigma held", "{:.3f}"),
    ("log score", "force log", "{:.2f}"),
    ("place > 3 sigma %", "place 3 %", "{:.2f}"),
    ("> 6", "place 6", "{:.0f}"),
    ("sigma mm", "place sigma mm", "{:.2f}"),
    ("held", "place sigma held mm", "{:.2f}"),
    ("log score", "place log", "{:.2f}"),
    ("CPU s", "cpu s", "{:.1f}"),
)
GATES: dict[str, float] = {"refused": 0, "aged": 0}
"""What holds today in the short form. Figures that are not here have no gate yet."""
COUNTED = (
    "phantom frames", "phantom incidents", "wrong counts", "hidden", "hidden briefly", "never shown", "ids", "refused",
    "aged", "late", "false", "back late", "force 6", "place 6",
)  # fmt: skip
SHARES = ("valid untouched %", "valid touched %", "valid in faults %")
LESS_VALID = 0.1  # percentage points


def console() -> Console:
    return Console(width=200) if not sys.stdout.isatty() else Console()


def show(rows: Rows, title: str) -> None:
    console().print(table_of(f"{title}: what must not be", WRONG, rows.items()))
    console().print(table_of(f"{title}: what refusing or a wide sigma would hide", ERRORS, rows.items()))


def table_of(title: str, columns: Sequence[Column], rows: Iterable[tuple[str, Mapping[str, Any]]]) -> Table:
    made = Table(title=title, title_justify="left")
    made.add_column("", no_wrap=True)
    for heading, _, _ in columns:
        made.add_column(heading, justify="right")
    for name, row in rows:
        made.add_row(name, *("" if row.get(key) is None else form.format(row[key]) for _, key, form in columns))
    return made


def show_beside(ours: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Every figure over all rows, beside that of the other checkout."""
    made = titled("all rows, beside the other checkout", ("", "here", "other"))
    for _, key, form in (*WRONG, *ERRORS):
        made.add_row(key, *("" if row[key] is None else form.format(row[key]) for row in (ours, other)))
    console().print(made)


def goals(rows: Rows, quick: bool) -> list[Goal]:
    """Over all rows, but for the shares of the plain world. Gates are of the short form only."""
    total = rows["all"]
    made = [
        ("refused", Goal("valid contacts on a refused image, frames", total["refused"], at_most=0)),
        ("aged", Goal("valid frames that are older than they may be", total["aged"], at_most=0)),
        ("phantom", Goal(f"valid frames with a phantom, of {total['frames']}", total["phantom frames"], at_most=0)),
        ("hidden", Goal(f"touches hidden for more than 0.3 s, of {total['touches']}", total["hidden"], at_most=0)),
        ("unnamed", Goal(f"faults not named, of {total['faults']}", total["faults"] - total["named"], at_most=0)),
        ("back late", Goal("troubles after which frames are valid again too late", total["back late"], at_most=0)),
    ]
    for name, row in rows.items():
        if name.startswith("plain,"):
            for kind in ("untouched", "touched"):
                share = row[f"valid {kind} %"]
                made.append((kind, Goal(f"{name}: frames valid, {kind}, nothing wrong, %", share, at_least=99.5)))
    return [replace(goal, gate=GATES.get(key) if quick else None) for key, goal in made]


def compared(name: str, other: Mapping[str, Any], ours: Mapping[str, Any]) -> list[Goal]:
    """The gates against another checkout: no more of what must not be, beyond what chance would."""
    made = []
    for key in COUNTED:
        most = other[key] + 2 * math.sqrt(other[key] + 1) if other[key] else 0.0
        made.append(Goal(f"{name}: {key}, the other {other[key]:g}", ours[key], at_most=most, gate=most))
    for key in SHARES:
        if other[key] is not None and ours[key] is not None:
            least = other[key] - LESS_VALID
            made.append(Goal(f"{name}: {key}, the other {other[key]:.2f}", ours[key], at_least=least, gate=least))
    return made


def about_worlds() -> str:
    """The worlds and where their figures come from, for a person."""
    return "\n".join(
        f"{name}: {world.what}{' (reported only)' if world.reported else ''}\n    {world.source}"
        for name, world in WORLDS.items()
    )
