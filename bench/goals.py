"""One figure of a report beside what is wanted of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Goal:
    """at_most, at_least: the target, None where there is none. gate: what a program may fail on by itself."""

    figure: str
    value: float | None
    at_most: float | None = None
    at_least: float | None = None
    gate: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the gate, if there is one, lets it through."""
        low = self.at_least is not None
        return self.gate is None or bool(self._within(None if low else self.gate, self.gate if low else None))

    @property
    def met(self) -> bool | None:
        return self._within(self.at_most, self.at_least)

    def _within(self, most: float | None, least: float | None) -> bool | None:
        if most is None and least is None:
            return None
        if self.value is None or not math.isfinite(self.value):
            return False
        return (most is None or self.value <= most) and (least is None or self.value >= least)

    @property
    def wanted(self) -> str:
        if self.at_most is not None:
            return f"at most {self.at_most:g}"
        return "" if self.at_least is None else f"at least {self.at_least:g}"

    @property
    def measured(self) -> str:
        return "not measured" if self.value is None else f"{self.value:.3g}"

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, found: dict[str, Any]) -> Goal:
        return cls(found["figure"], found["value"], found.get("at_most"), found.get("at_least"))


def titled(title: str, headings: Iterable[str], words: int = 1) -> Table:
    """Without rows yet. words: how many columns, the first ones, hold no numbers."""
    made = Table(title=title, title_justify="left")
    for place, heading in enumerate(headings):
        made.add_column(heading, justify="left" if place < words else "right")
    return made


def table(goals: Sequence[Goal]) -> Table:
    made = Table(title="beside targets", title_justify="left")
    for heading in ("figure", "measured", "target", ""):
        made.add_column(heading, justify="right" if heading == "measured" else "left")
    for goal in goals:
        word = {True: "met", False: "[red]missed[/red]", None: ""}[goal.met]
        made.add_row(goal.figure, goal.measured, goal.wanted, word)
    return made
