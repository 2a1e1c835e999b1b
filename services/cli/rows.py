"""What commands that read rows of a file share: options that say how, what was understood, verdicts."""

from __future__ import annotations

import sys
from collections import Counter
from typing import Annotated, Any

import typer

ColumnsOption = Annotated[
    str,
    typer.Option(
        "--columns",
        metavar="WHICH",
        help="magnitude-phase or real-imaginary (in turn), magnitude-then-phase, real-then-imaginary, transposed; or "
        "which of them hold measurements, as 1: or 0:240:2.",
    ),
]
PatternOption = Annotated[
    str,
    typer.Option(
        "--pattern",
        metavar="ORDER",
        help="Order of the columns: sense-first, drive-reversed, rotated, skin; or a file of it: drive+, drive-, "
        "sense+, sense-.",
    ),
]
UntouchedOption = Annotated[
    str, typer.Option("--untouched", metavar="FILE|N", help="A file of untouched rows, or how many come first in IN.")
]

DO = {
    "stale_baseline": "what is said above of `untouched` or `reference`; else give 16 or more rows of `untouched` of "
    "just before, with nothing on the skin",
    "touched_at_start": "something stood on the skin in `untouched`: give rows without it",
    "out_of_distribution": "see that --skin and the order of columns (--pattern) are those measured, and that "
    "`untouched` is of just before",
    "gain": "the amplification changed after `untouched`: give a `reference` (n, k), one for each row",
    "electrode_drift": "give `untouched` of just before, or a `reference` (n, k), one for each row",
    "uncalibrated_force": "give `measurements` with `untouched`, not `delta`, and a skin with a force law",
    "changing": "give more rows of `untouched`",
    "extrapolated": "nothing: the force is a lower bound",
}
"""About rows of a file, for which there is no board to look at and no tare."""
MEANS = {
    "changing": "something may touch, and where is known roughly or not at all",
    "uncalibrated_force": "no force: its law or the unit of `delta` is not known",
}
"""Of reasons that mean something else in a running service."""


def say_understood(text: str) -> None:
    if text:
        print(f"skin: read as: {text}", file=sys.stderr)


def counts(reasons: Any, valid: Any) -> tuple[Counter[str], Counter[str]]:
    """How many rows that are not valid give each reason, and how many valid ones."""
    each = [(str(text).split(), bool(ok)) for text, ok in zip(reasons, valid, strict=True)]
    refused = Counter(reason for said, ok in each if not ok for reason in said or ["unknown"])
    return refused, Counter(reason for said, ok in each if ok for reason in said)


def verdicts(reasons: Any, valid: Any) -> list[str]:
    """A line for each reason: how many rows, what it means, what to do."""
    from protocol.frame_types import REASONS

    refused, noted = counts(reasons, valid)
    lines = []
    for rows, what in ((refused, "not valid"), (noted, "valid, but")):
        for reason, count in rows.most_common():
            do = f": {DO[reason]}" if reason in DO else ""
            meaning = MEANS.get(reason) or REASONS.get(reason, "no check decided")
            lines.append(f"{count} {'row' if count == 1 else 'rows'} {what} {reason} ({meaning}){do}")
    return lines
