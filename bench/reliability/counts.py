"""Counts that add up."""

from __future__ import annotations

from typing import Self


class Counts:
    """Base of the scores: dataclasses whose fields are numbers, lists or counters."""

    def add(self, other: Self) -> None:
        """Field by field."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)
