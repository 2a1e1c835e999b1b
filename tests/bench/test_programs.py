"""The page of reports, the presses of the force benchmark, and every program's command line."""

import importlib
import json

import pytest

import bench
from bench import all as page
from bench.force_presses import PlannedPress, planned
from bench.goals import Goal


@pytest.mark.parametrize("name", sorted({each.name for each in page.BENCHMARKS} | {"refined"}))
def test_each_program_refuses_what_is_no_number(name, capsys):
    with pytest.raises(SystemExit):
        option = {"latency": "--seconds", "peers": "--rounds", "trust": "--minutes"}.get(name, "--seed")
        importlib.import_module(bench.commands()[name]).main([option, "nan"])
    assert "found" in capsys.readouterr().err


def test_a_figure_is_held_against_its_goal_and_the_reports_before(tmp_path):
    head = {"command": "skin bench force", "commit": "c0ffee", "machine": "2 x one", "versions": {"python": "3"}}
    goals = [Goal("error, %", 9.0, at_most=7.0), Goal("ratio", 1.5), Goal("shown, %", 99.0, at_least=98.0)]
    before = {"error, %": [4.0, 4.1, 4.2], "ratio": [1.4], "shown, %": [99.0, 98.9]}
    report = {**head, "targets": [goal.to_dict() for goal in goals], "before": before, "left_out": []}
    (tmp_path / "force.json").write_text(json.dumps(report))
    assert page.main(["--reuse", "--out", str(tmp_path)]) == 0
    written = (tmp_path / "README.md").read_text()
    assert "| error, % | 9 | 4.2 | at most 7 | **missed**, worse than before |" in written
    assert "| ratio | 1.5 | 1.4 |  |  |" in written and "| shown, % | 99 | 98.9 | at least 98 | met |" in written
    assert page.history(report)["error, %"] == [4.0, 4.1, 4.2, 9.0]


def test_a_press_is_scored_by_the_nearest_contact_of_a_valid_frame():
    def contact(x, newton, state="ongoing"):
        said = {"force_n": newton, "force_sigma_n": 0.1, "pressure_pa": 1.0, "pressure_sigma_pa": 0.1}
        return {"state": state, "position": [x, 0.0, 0.0], **said}

    press = PlannedPress(10.0, 2.0, 0.02, 0.0)
    frame = {"valid": True, "reasons": ["extrapolated"], "contacts": [contact(-0.02, 9.0), contact(0.021, 2.1)]}
    row = press.row("full", frame)
    assert (row.said, row.sigma, row.extrapolated) == (2.1, 0.1, True)
    for change in ({"valid": False}, *({"contacts": [contact(0.02, *c)]} for c in ((2.0, "end"), (None,)))):
        assert press.row("full", {**frame, **change}).said is press.row("full", None).said is None
    assert list(planned(2, 3)) == list(planned(2, 3)) != list(planned(2, 4))
