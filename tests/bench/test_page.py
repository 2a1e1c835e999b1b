"""Goals, and the page of all benchmarks: what is missed says so, what was not run says so, ratios stop CI."""

import json

import pytest

from bench import all as page
from bench.goals import Goal


@pytest.mark.parametrize(
    ("goal", "met", "passed"),
    [
        (Goal("a", 1.0, at_most=1.0), True, True),
        (Goal("a", 1.1, at_most=1.0), False, True),  # missed, but only gates stop CI
        (Goal("a", 1.1, at_most=1.0, gate=1.2), False, True),
        (Goal("a", 1.3, at_most=1.0, gate=1.2), False, False),
        (Goal("a", 2.9, at_least=3.0, gate=2.0), False, True),
        (Goal("a", 1.9, at_least=3.0, gate=2.0), False, False),
        (Goal("a", 5.0), None, True),
        (Goal("a", 5.0, gate=4.0), None, False),
        (Goal("a", None, at_most=1.0, gate=1.0), False, False),
        (Goal("a", float("nan"), at_most=1.0), False, True),
    ],
)
def test_goal(goal: Goal, met: bool | None, passed: bool) -> None:
    assert (goal.met, goal.passed) == (met, passed)
    assert Goal.from_dict(json.loads(json.dumps(goal.to_dict()))).to_dict()["passed"] == passed


def report(folder, name, *goals, **more):
    content = {
        "command": f"skin bench {name}",
        "commit": "c0ffee",
        "machine": "2 x one",
        "versions": {"python": "3"},
        **more,
    }
    content["targets"] = [goal.to_dict() for goal in goals]
    (folder / f"{name}.json").write_text(json.dumps(content))


def test_the_page_says_what_is_missed_and_what_was_not_run(tmp_path, capsys):
    report(tmp_path, "latency", Goal("p50, ms", 1.5, at_most=2.0), Goal("p99, ms", 7.0, at_most=5.0))
    report(tmp_path, "peers", Goal("ratio", 1.5), left_out=["rospy is not installed: left out"])
    (tmp_path / "latency.png").write_bytes(b"")
    assert page.main(["--reuse", "--out", str(tmp_path)]) == 0
    written = (tmp_path / "README.md").read_text()
    assert written in capsys.readouterr().out
    assert "1 of 2 targets met" in written
    assert "| p99, ms | 7 | at most 5 | **missed** |" in written and "| p50, ms | 1.5 | at most 2 | met |" in written
    assert "| ratio | 1.5 |  |  |" in written and "rospy is not installed" in written
    assert "`skin bench latency` at commit c0ffee on 2 x one; python 3." in written and "(latency.png)" in written
    assert "Not run: `skin bench tracking`." in written


def test_a_report_of_an_older_version_is_not_run(tmp_path):
    (tmp_path / "skip.json").write_text('{"machine": "one"}')
    assert page.main(["--reuse", "--out", str(tmp_path)]) == 0
    assert "Not run: `skin bench skip`." in (tmp_path / "README.md").read_text()


def test_a_benchmark_that_fails_leaves_no_old_figures(tmp_path, monkeypatch, capsys):
    report(tmp_path, "skip", Goal("old", 1.0))
    broken = page.Benchmark("no_such_module", "Broken", ())
    (tmp_path / "no_such_module.json").write_text((tmp_path / "skip.json").read_text())
    monkeypatch.setattr(page, "BENCHMARKS", (broken,))
    assert page.main(["--only", "no_such_module", "--out", str(tmp_path)]) == 1
    assert "old" not in capsys.readouterr().out


def test_a_ratio_beyond_its_gate_fails_the_short_form(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "BENCHMARKS", tuple(b for b in page.BENCHMARKS if b.name == "skip"))
    report(tmp_path, "skip", Goal("untouched, of moving", 0.6, at_most=0.25, gate=0.45))
    assert page.main(["--reuse", "--quick", "--out", str(tmp_path)]) == 1
    assert "untouched, of moving: 0.6, gate 0.45" in capsys.readouterr().err
    assert page.main(["--reuse", "--out", str(tmp_path)]) == 0  # the page itself only says it


@pytest.mark.parametrize("content", [None, '{"machine": "one"}', '{"mach'], ids=["missing", "older", "cut"])
def test_a_gate_that_was_not_tried_is_not_met(tmp_path, monkeypatch, capsys, content):
    """Of a report that is not there, or of which nothing can be read."""
    monkeypatch.setattr(page, "BENCHMARKS", tuple(b for b in page.BENCHMARKS if b.name in ("skip", "peers")))
    report(tmp_path, "peers", Goal("ratio", 1.5, at_most=2.0, gate=3.0))
    if content is not None:
        (tmp_path / "skip.json").write_text(content)
    assert page.main(["--reuse", "--quick", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "FAILED: skip: there is no report of it" in said.err and "Not run: skip." in said.out
    report(tmp_path, "skip", Goal("untouched", 0.2, at_most=0.25, gate=0.45))
    assert page.main(["--reuse", "--quick", "--out", str(tmp_path)]) == 0


def test_a_benchmark_that_ends_well_without_a_report_failed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "BENCHMARKS", (page.Benchmark("skip", "Skip rules", ()),))
    monkeypatch.setattr(page, "commands", lambda: {"skip": "this"})
    assert page.main(["--only", "skip", "--out", str(tmp_path)]) == 1
    assert "FAILED: skip: there is no report of it" in capsys.readouterr().err


def test_the_short_form_says_which_gates_it_leaves_out(tmp_path, monkeypatch, capsys):
    full, quick = tmp_path / "full", tmp_path / "quick"
    full.mkdir()
    quick.mkdir()
    none, short = page.Benchmark("reaction", "Reaction", None), page.Benchmark("scale", "Many skins", ("--skins", "8"))
    monkeypatch.setattr(page, "BENCHMARKS", (none, short))
    monkeypatch.setattr(page, "REPORTS", full)
    report(full, "scale", Goal("8 skins", 1.0, gate=2.0), Goal("32 skins", 1.0, gate=2.0), Goal("ms", 1.0))
    report(quick, "scale", Goal("8 skins", 1.0, gate=2.0))
    assert page.main(["--reuse", "--quick", "--out", str(quick)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("left out of the short form: ")]
    assert [line.partition(": ")[2] for line in lines] == ["reaction: has no short form", "scale: 32 skins"]


def test_every_benchmark_of_the_page_is_there() -> None:
    for benchmark in page.BENCHMARKS:
        assert benchmark.command in page.commands()


def test_nothing_runs_beside_a_benchmark_of_times(monkeypatch):
    class Begun:
        def __init__(self, beside: bool) -> None:
            self.benchmark = page.Benchmark("one", "One", (), beside=beside)

    timed, untimed = Begun(False), Begun(True)
    monkeypatch.setattr(page.os, "sched_getaffinity", lambda _: {0, 1})
    assert page.may_begin(timed.benchmark, []) and page.may_begin(untimed.benchmark, [untimed])
    assert not page.may_begin(timed.benchmark, [untimed]) and not page.may_begin(untimed.benchmark, [timed])
    assert not page.may_begin(untimed.benchmark, [untimed, untimed])
