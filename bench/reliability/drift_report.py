"""Tables, targets and gates of `skin bench drift`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from bench.goals import Goal
from bench.reliability.report import Column, console, table_of

Found = Mapping[str, Mapping[str, Mapping[str, Any]]]

STARTS: tuple[Column, ...] = (
    ("starts", "starts", "{:.0f}"),
    ("valid frames without the contact", "without", "{:.0f}"),
    ("with one elsewhere", "phantoms", "{:.0f}"),
    ("starts with either", "started_wrong", "{:.0f}"),
    ("invalid % while touched", "invalid_%", "{:.1f}"),
    ("free after, median scans", "free_median", "{:.0f}"),
    ("most", "free_most", "{:.0f}"),
    ("too late", "late", "{:.0f}"),
    ("reasons", "reasons", ""),
)
GAINS: tuple[Column, ...] = (
    ("steps", "steps", "{:.0f}"),
    ("frames with a false contact", "false", "{:.0f}"),
    ("after its end", "ended_false", "{:.0f}"),
    ("touch unseen", "unseen", "{:.0f}"),
    ("right again, median s", "again_median_s", "{:.2f}"),
    ("most", "again_most_s", "{:.2f}"),
    ("after its end, most", "ended_most_s", "{:.2f}"),
    ("too late", "late", "{:.0f}"),
    ("invalid %", "invalid_%", "{:.1f}"),
)
ROWS: tuple[Column, ...] = (
    ("touches", "touches", "{:.0f}"),
    ("found %", "found_%", "{:.1f}"),
    ("force %, radius 0.2 and 0.3", "force_large_%", "{:.1f}"),
    ("all", "force_%", "{:.1f}"),
    ("rms", "force_rms_%", "{:.0f}"),
    ("floor", "floor_%", "{:.0f}"),
    ("of it", "of_floor", "{:.2f}"),
    ("indenter known", "known_force_%", "{:.1f}"),
    ("contacts elsewhere", "extra", "{:.0f}"),
    ("where nothing touches", "alarms", "{:.0f}"),
    ("invalid %", "invalid_%", "{:.1f}"),
)
HISTORY = tuple(column for column in ROWS if column[1] not in ("floor_%", "of_floor", "known_force_%"))
LEAST_FORCE = 5.0  # %, of a median force error: below it the few touches of a quick run decide, not drift
AS_WITHOUT, AS_FORCE = 2.0, 1.3  # "as without drift": percentage points of touches found, ratio of force errors

# What held in the quick form on 26 November 2026, by the goal's key: to be tightened as the figures get better. Shares
# of invalid frames have no target, and so no gate.
GATES = {
    **{f"{state} {what}": 0 for state in ("cold", "lost", "aged") for what in ("wrong", "late")},
    "aged wrong": 1,  # one frame after a light press was released
    "gains untouched false": 0,
    "gains untouched late": 0,
    "gains held false": 0,
    "gains held late": 0,
    "rows found": 88,  # 89: 0.25 N of 5 mm is drift's where nobody says how old the untouched rows are
    "rows force": 15,
    "rows floor": 1.9,  # 1.76: the same doubt takes from light presses; the image said 1.31
    "rows known": 8,
    "rows false": 0,
    "history found": AS_WITHOUT,
    "history force": AS_FORCE,
    "history false": 0,
}


def goals(found: Found, quick: bool) -> list[Goal]:
    """Gates are of the quick form only."""
    gates = GATES if quick else {}
    made = [*_starts(found.get("starts", {})), *_gains(found.get("gains", {}))]
    made += [*_rows(found.get("rows", {})), *_history(found.get("history", {}))]
    return [replace(goal, gate=gates.get(key)) for key, goal in made]


Keyed = tuple[str, Goal]


def _starts(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[Keyed]:
    for state in ("cold", "lost", "aged"):
        if row := rows.get(state):
            wrong = row["without"] + row["phantoms"]
            figure = f"start under a touch, {state}: valid frames without the contact, or with another"
            yield f"{state} wrong", Goal(figure, wrong, at_most=0)
            figure = f"{state}: starts not valid and empty 96 full scans after release, of {row['starts']}"
            yield f"{state} late", Goal(figure, row["late"], at_most=0)
            yield f"{state} invalid", Goal(f"{state}: frames that are not valid while touched, %", row["invalid_%"])


def _gains(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[Keyed]:
    for situation in ("untouched", "held"):
        if row := rows.get(situation):
            false, key = row["false"] + row["ended_false"], f"gains {situation}"
            yield f"{key} false", Goal(f"gain steps, {situation}: valid frames with a false contact", false, at_most=0)
            figure = f"{situation}: beginnings and ends not right again within 2 s, of {2 * row['steps']}"
            yield f"{key} late", Goal(figure, row["late"], at_most=0)
            yield f"{key} invalid", Goal(f"{situation}: frames that are not valid, %", row["invalid_%"])


def _rows(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[Keyed]:
    drifted = {name: row for name, row in rows.items() if name != "none"}
    if not drifted:
        return

    def worst(key: str, least: bool = False) -> float | None:
        """None where it was not measured for one of the changes: no touch was found."""
        values = [row[key] for row in drifted.values()]
        return None if None in values else (min if least else max)(values)

    found = worst("found_%", least=True)
    false = sum(row["alarms"] + row["extra"] for row in drifted.values())
    for key, goal in (
        ("found", Goal("rows alone, worst drift: touches found within 3 % of the side, %", found, at_least=98)),
        ("force", Goal("force error, median, radius 0.2 and 0.3, %", worst("force_large_%"), at_most=15)),
        ("floor", Goal("force error, rms, all radii, times the floor", worst("of_floor"), at_most=1.3)),
        ("known", Goal("force error, median, indenter declared, %", worst("known_force_%"), at_most=8)),
        ("false", Goal("contacts where nothing touches", false, at_most=0)),
        ("invalid", Goal("rows that are not valid, worst drift, %", worst("invalid_%"))),
    ):
        yield f"rows {key}", goal


def _history(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[Keyed]:
    drifted = [row for name, row in rows.items() if name != "none"]
    if not drifted:
        return
    without = rows["none"]
    lost = without["found_%"] - min(row["found_%"] for row in drifted)
    force = max(row["force_%"] for row in drifted) / max(without["force_%"], LEAST_FORCE)
    false = sum(row["alarms"] + row["extra"] for row in drifted)
    invalid = max(row["invalid_%"] for row in drifted)
    figure = "with history, worst drift: touches found, percentage points fewer than without drift"
    yield "history found", Goal(figure, lost, at_most=AS_WITHOUT)
    yield "history force", Goal("force error, median, over that without drift (or 5 %)", force, at_most=AS_FORCE)
    yield "history false", Goal("contacts where nothing touches", false, at_most=0)
    yield "history invalid", Goal("touches whose last frame is not valid, worst drift, %", invalid)


def show(found: Found) -> None:
    for part, title, first, columns in (
        ("starts", "starts under a touch, contact impedances +-30 %", "start", STARTS),
        ("gains", "gain steps that last 10 s", "situation", GAINS),
        ("rows", "rows alone, drifted since the tare", "drift", ROWS),
        ("history", "the same with the drift's history", "drift", HISTORY),
    ):
        if rows := found.get(part):
            console().print(table_of(title, first, columns, rows.items()))
