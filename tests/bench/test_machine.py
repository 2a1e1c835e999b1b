"""What a report says of how it was made."""

from __future__ import annotations

import sys

import pytest

from bench.machine import provenance


@pytest.mark.parametrize("typed", [["skin", "bench", "tracking"], ["bench/tracking"]], ids=["skin", "module"])
def test_the_command_is_the_one_that_was_typed(typed: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [*typed, "--seconds", "60", "--out", "elsewhere"])
    assert provenance("tracking", None)["command"] == "skin bench tracking --seconds 60"
    assert provenance("tracking", ["--quick"])["command"] == "skin bench tracking --quick"
