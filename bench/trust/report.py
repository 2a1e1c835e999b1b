"""Tables, targets and gates of `skin bench trust` and `skin bench shadow`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bench.goals import Goal
from bench.reliability.report import console, table_of
from firmware_stub.worlds.table import WORLDS

WRONG = (  # heading, key, format
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
)
ERRORS = (
    ("valid untouched %", "valid untouched %", "{:.1f}"),
    ("touched %", "valid touched %", "{:.1f}"),
    ("in faults %", "valid in faults %", "{:.1f}"),
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
)
GATES: dict[str, float] = {"refused": 0, "aged": 0}
"""What holds today in the short form. Figures that are not here have no gate yet."""


def show(rows: Mapping[str, Mapping[str, Any]], title: str) -> None:
    console().print(table_of(f"{title}: what must not be", "world, scan", WRONG, rows.items()))
    console().print(table_of(f"{title}: what refusing or a wide sigma would hide", "world, scan", ERRORS, rows.items()))


def show_floor(found: Mapping[str, Mapping[float, Mapping[str, Any]]]) -> None:
    """found: by scan and radius [m], as floor.measured gives it."""
    columns = (
        ("shown in 99.9 % from, N", "shown_n", "{:.2f}"),
        ("sigma below a quarter from, N", "sure_n", "{:.2f}"),
    )
    rows = [(f"{scan}, {1e3 * radius:.0f} mm", row) for scan, each in found.items() for radius, row in each.items()]
    console().print(table_of("the skin's own floor, plain world, discs", "scan, radius", columns, rows))


def goals(rows: Mapping[str, Mapping[str, Any]], quick: bool) -> list[Goal]:
    """Over all worlds, but for the shares of the plain one. Gates are of the short form only."""
    total = {key: sum(row[key] for row in rows.values()) for _, key, form in WRONG if form == "{:.0f}"}
    made = [
        ("refused", Goal("valid contacts on a refused image, frames", total["refused"], at_most=0)),
        ("aged", Goal("valid frames that are older than they may be", total["aged"], at_most=0)),
        ("phantom", Goal(f"valid frames with a phantom, of {total['frames']}", total["phantom frames"], at_most=0)),
        ("hidden", Goal(f"touches hidden for more than 0.3 s, of {total['touches']}", total["hidden"], at_most=0)),
        ("unnamed", Goal(f"faults not named, of {total['faults']}", total["faults"] - total["named"], at_most=0)),
    ]
    for name, row in rows.items():
        if name.startswith("plain,"):
            for kind in ("untouched", "touched"):
                share = row[f"valid {kind} %"]
                made.append((kind, Goal(f"{name}: frames valid, {kind}, nothing wrong, %", share, at_least=99.5)))
    return [replace(goal, gate=GATES.get(key) if quick else None) for key, goal in made]


def about_worlds() -> str:
    """The worlds and where their figures come from, for a person."""
    return "\n".join(
        f"{name}: {world.what}{' (reported only)' if world.reported else ''}\n    {world.source}"
        for name, world in WORLDS.items()
    )
