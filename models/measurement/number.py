"""A number that decides, with its unit, its meaning and where it comes from."""

from __future__ import annotations

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
