"""The benchmark of forces: what it counts, and that its short form through the real stages meets its gates."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import force
from bench.force_presses import NEWTONS, RADII_MM, PlannedPress, PressRow, planned


def rows(wide: float, off: float) -> list[PressRow]:
    """A press of each radius and force whose error is `off`, of a sigma `wide` times as large."""
    return [
        PressRow("full", r, f, 0.0, 0.0, f * (1 + off), f * off * wide, 1e4, 1e3, False)
        for r in RADII_MM
        for f in NEWTONS
    ]


def goals(wide: float, off: float) -> dict[str, Any]:
    cells = [
        {"ratio": 1 + off, "error": off, "sigma": off * wide, "floor": 0.01, "saturated": False}
        for _ in RADII_MM
        for _ in NEWTONS
    ]
    return {goal.figure.removeprefix("full: "): goal for goal in force.goals("full", rows(wide, off), cells)}


def test_a_sigma_too_narrow_and_one_too_wide_both_fail_a_gate() -> None:
    good = goals(1.2, 0.03)
    assert all(goal.passed for goal in good.values())
    narrow = goals(0.2, 0.03)
    assert not narrow["within one sigma, %"].passed and not narrow["within three sigma, %"].passed
    assert not goals(4.0, 0.03)["median sigma over the floor of one frame"].passed
    assert not goals(1.0, 0.1)["root mean square error from 1 N on, %"].passed


def test_presses_that_nobody_saw_are_missed_goals_not_a_fault() -> None:
    """Where noise hides them all."""
    unseen = [replace(row, said=None, sigma=None, pressure=None, pressure_sigma=None) for row in rows(1.0, 0.03)]
    nothing = {"ratio": None, "error": None, "sigma": None, "floor": 0.01, "saturated": False}
    found = {goal.figure.removeprefix("full: "): goal for goal in force.goals("full", unseen, [nothing])}
    assert found["presses shown, %"].value == 0 and not found["presses shown, %"].passed
    assert {goal.value for name, goal in found.items() if name != "presses shown, %"} == {None}
    half = [row if row.radius_mm < 12 else gone for row, gone in zip(rows(1.0, 0.03), unseen, strict=True)]
    far = next(goal for goal in force.goals("full", half, [nothing]) if "furthest from 1" in goal.figure)
    assert far.value is None and not far.passed


def test_a_press_is_scored_by_the_nearest_contact_of_a_valid_frame() -> None:
    def contact(x: float, newton: float | None, state: str = "ongoing") -> dict[str, Any]:
        said = {"force_n": newton, "force_sigma_n": 0.1, "pressure_pa": 1.0, "pressure_sigma_pa": 0.1}
        return {"state": state, "position": [x, 0.0, 0.0], **said}

    press = PlannedPress(10.0, 2.0, 0.02, 0.0)
    frame = {"valid": True, "reasons": ["extrapolated"], "contacts": [contact(-0.02, 9.0), contact(0.021, 2.1)]}
    row = press.row("full", frame)
    assert (row.said, row.sigma, row.extrapolated) == (2.1, 0.1, True)
    ended = {**frame, "contacts": [contact(0.02, 2.0, "end")]}
    for nothing in (None, {**frame, "valid": False}, ended, {**frame, "contacts": [contact(0.02, None)]}):
        assert press.row("full", nothing).said is None
    plan = list(planned(2, 3))
    assert len(plan) == 40 and plan == list(planned(2, 3)) != list(planned(2, 4))
    assert all(np.hypot(*np.maximum(np.abs([p.x, p.y]) + p.radius_mm * 1e-3 - 0.05, 0)) < 1e-9 for p in plan)


@pytest.mark.release
def test_the_short_form_meets_its_gates(tmp_path: Path) -> None:
    assert force.main(["--quick", "--scan", "full", "--seed", "5", "--out", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "force.json").read_text())
    assert len(report["presses"]) == 20 and all(found["passed"] for found in report["targets"]), report["targets"]


def test_live_presses_are_at_the_stubs_own_noise(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        force.main(["--live", "--snr", "70"])
    assert "--snr 70 with --live" in capsys.readouterr().err
