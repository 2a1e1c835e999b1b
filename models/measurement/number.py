"""A number that decides, with its unit, its meaning and where it comes from."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Self


class Number(float):
    """A float that says what it is. origin: "derived: ...", "measured: ...", "data sheet: ..." or "chosen: ..."."""

    unit: str
    meaning: str
    origin: str

    def __new__(cls, value: float, unit: str, meaning: str, origin: str) -> Self:
        made = super().__new__(cls, value)
        made.unit, made.meaning, made.origin = unit, meaning, origin
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[float, str, str, str]]:
        """What a copy is made of."""
        return type(self), (float(self), self.unit, self.meaning, self.origin)


def numbers_of(module: ModuleType) -> Iterator[tuple[str, Number]]:
    """Name and number of each in a module, in the order of the file."""
    for name, value in vars(module).items():
        if isinstance(value, Number):
            yield name, value


def table(*modules: ModuleType) -> str:
    """The numbers of some modules as lines of text: name, value, unit, meaning, origin."""
    rows = [(name, f"{each:g}", each.unit, each.meaning, each.origin) for m in modules for name, each in numbers_of(m)]
    return "\n".join(dict.fromkeys("  ".join(row) for row in rows))  # a module may lend from one before it
