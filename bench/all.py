"""The five questions, one page: accuracy, force, trust, latency and reaction; and other programs beside ours.

    skin bench all                      the page, with everything in full: hours on two idle cores
    skin bench all --quick              the short forms
    skin bench all --reuse              the page from the reports that are there; runs nothing

Each runs in a process of its own, one after another, and writes NAME.json; the page, README.md beside the reports, has
each one's command, machine, versions and figures, beside those of the reports before. Where a figure lies outside the
scatter of those by which it is worse, the page says so; nothing fails on it. Exit status 1 where a program failed.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import REPORTS, ROOT, commands
from bench.goals import Goal
from bench.json_file import write_json
from bench.speed.service import end_on_sigterm
from protocol.whole_file import write_whole

KEPT = 5  # reports before, whose figures a new one keeps
SCATTER = 3.0  # standard deviations of those
LONG = 12_000  # characters of its tables beyond which the page only names the file


@dataclass(frozen=True)
class Benchmark:
    """A benchmark that writes NAME.json with `command`, `commit`, `machine`, `versions` and `targets`."""

    name: str
    title: str
    arguments: tuple[str, ...] = ()


BENCHMARKS = (
    Benchmark("accuracy", "Accuracy: the service and other methods on the same frames, other skins, real presses"),
    Benchmark("force", "Force of presses of unknown size"),
    Benchmark("trust", "Trust: what contacts say in worlds that nobody tuned to", ("--minutes", "3")),
    Benchmark("latency", "Latency, CPU and scale"),
    Benchmark("reaction", "Reaction: from a touch to its contact, in simulated time"),
    Benchmark("peers", "Beside others: four hops between processes"),
)


def run(benchmark: Benchmark, folder: Path, quick: bool) -> str:
    """Runs it; its tables go to NAME.txt and to our output. What went wrong, or ""."""
    path = folder / f"{benchmark.name}.json"
    before = history(read(path))
    path.unlink(missing_ok=True)  # what an earlier run left is not this one's
    module = commands().get(benchmark.name, f"bench.{benchmark.name}")
    words = [*(("--quick",) if quick else benchmark.arguments), "--out", os.path.relpath(folder, ROOT)]
    print(f"\n=== {benchmark.title}: {module} {' '.join(words)}", flush=True)
    began, tables = time.monotonic(), folder / f"{benchmark.name}.txt"
    with tables.open("wb") as kept:
        command = [sys.executable, "-m", module, *words]
        status = subprocess.run(command, cwd=ROOT, stdout=kept, env=os.environ | {"COLUMNS": "150"}).returncode
    print(tables.read_text(encoding="utf-8", errors="replace"), end="")
    print(f"--- {(time.monotonic() - began) / 60:.1f} minutes", flush=True)
    report = read(path)
    if report:
        write_json(path, {**report, "before": before})
    return f"{benchmark.name} ended with exit status {status}" if status else "" if report else f"no {path.name}"


def read(path: Path) -> dict[str, Any]:
    """A report; {} where there is none that can be read."""
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found if "targets" in found else {}
    except (OSError, ValueError):
        return {}


def history(report: Mapping[str, Any]) -> dict[str, list[float]]:
    """Each figure of a report and of those before it, the oldest first."""
    before = report.get("before", {})
    found = {goal["figure"]: goal["value"] for goal in report.get("targets", []) if goal["value"] is not None}
    return {figure: [*before.get(figure, []), value][-KEPT:] for figure, value in found.items()}


def judged(goal: Goal, before: Sequence[float]) -> str:
    """What the page says of a figure beside those of the reports before."""
    met = {True: "met", False: "**missed**", None: ""}[goal.met]
    if goal.value is None or len(before) < 2 or (goal.at_most is None and goal.at_least is None):
        return met
    middle, spread = statistics.mean(before), SCATTER * statistics.stdev(before)
    worse = goal.value > middle + spread if goal.at_most is not None else goal.value < middle - spread
    return f"{met}, worse than before" if worse else met


def section(benchmark: Benchmark, folder: Path) -> list[str]:
    """Lines of the page."""
    report = read(folder / f"{benchmark.name}.json")
    lines = [f"## {benchmark.title}", ""]
    if not report:
        return [*lines, f"Not run: `skin bench {' '.join((benchmark.name, *benchmark.arguments))}`.", ""]
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    lines += [f"`{report['command'].strip()}` at commit {report['commit']} on {report['machine']}; {versions}.", ""]
    lines += ["| | measured | before | target | |", "|---|---|---|---|---|"]
    for goal in map(Goal.from_dict, report["targets"]):
        before = report.get("before", {}).get(goal.figure, [])
        last = f"{before[-1]:.3g}" if before else ""
        lines.append(f"| {goal.figure} | {goal.measured} | {last} | {goal.wanted} | {judged(goal, before)} |")
    lines += [line for note in report.get("left_out", []) for line in ("", note)]
    tables = folder / f"{benchmark.name}.txt"
    printed = tables.read_text(encoding="utf-8").rstrip() if tables.is_file() else ""
    if len(printed) > LONG:
        lines += ["", f"[All it printed]({tables.name})"]
    elif printed:
        lines += ["", "<details><summary>All it printed</summary>", "", "```", printed, "```", "", "</details>"]
    if (folder / f"{benchmark.name}.png").is_file():
        lines += ["", f"![{benchmark.title}]({benchmark.name}.png)"]
    return [*lines, ""]


def page(chosen: Sequence[Benchmark], folder: Path) -> str:
    """The page in Markdown."""
    top = ["# Benchmarks", "", "`skin bench all`. Each section says its command, its commit and its machine.", ""]
    return "\n".join(top + [line for each in chosen for line in section(each, folder)])


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench all", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="short forms")
    parser.add_argument("--reuse", action="store_true", help="run nothing: the page from the reports there are")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[b.name for b in BENCHMARKS])
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    failed = []
    if not args.reuse:
        end_on_sigterm()
        wanted = [b for b in BENCHMARKS if args.only is None or b.name in args.only]
        failed = [said for each in wanted if (said := run(each, args.out.resolve(), args.quick))]
    write_whole(args.out / "README.md", page(BENCHMARKS, args.out))
    print(f"wrote {args.out / 'README.md'}")
    for problem in failed:
        print(f"FAILED: {problem}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
