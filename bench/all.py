"""Every benchmark, one page: latency, skip rules, many skins, reaction, peers, forces, tracking, false touches, faults,
drift, stability, accuracy.

    skin bench all                      the page of README: about an hour on two idle cores
    skin bench all --quick              the short form of CI; exit status 1 where a gate is not met, or was not tried
    skin bench all --reuse              the page from the reports that are there; runs nothing
    skin bench all --only latency skip

Each runs in a process of its own: one after another where times are measured, the others one a core. Prints the page
and writes it, as README.md beside the reports: figures beside targets, the command, machine and versions of each.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import REPORTS, ROOT, commands
from bench.goals import Goal
from bench.speed.service import end_on_sigterm

LIMIT_S = 3600.0  # for one benchmark
POLL_S = 0.2
LONG = 12_000  # characters of its tables beyond which the page only names the file


@dataclass(frozen=True)
class Benchmark:
    """A benchmark that writes NAME.json with `command`, `machine`, `versions` and `targets`. quick: the arguments of
    its short form; None: it has none.
    """

    name: str
    title: str
    quick: tuple[str, ...] | None
    pictures: tuple[str, ...] = ()
    limits: str = ""  # why it misses what it misses, for a person
    of: str = ""  # the command that writes it, where that has another name
    arguments: tuple[str, ...] = ()
    beside: bool = False  # it takes one core, and no figure of it depends on how long anything takes

    @property
    def command(self) -> str:
        return self.of or self.name


BENCHMARKS = (
    Benchmark(
        "latency",
        "Latency, outside the processes",
        ("--seconds", "6", "--controllers", "1", "4", "--usual-priority"),
        ("latency",),
        "Processes that slept for 45 ms find their caches empty, and every hop pays for that twice (decode, encode); "
        "of a moving touch the stages alone, in one process, take longer than the target. p99 is waiting for a "
        "processor that the stub's physics or the benchmark has.",
    ),
    Benchmark(
        "skip",
        "Skip rules",
        ("--seconds", "8", "--live", "5"),
        limits="Being woken costs each of four processes a millisecond, whatever there is to do.",
    ),
    Benchmark(
        "scale",
        "Many skins",
        ("--skins", "1", "8", "--seconds", "6", "--touched", "0.25"),
        ("scale",),
        "32 skins need all of two such cores where other machines slow them down. What is lost was overtaken by newer "
        "frames of the same skin, and is counted.",
    ),
    Benchmark(
        "scale_parts",
        "Many skins whose scans come in parts",
        ("--skins", "1", "2", "--seconds", "6"),
        limits="Eight skins need 1.1 of two cores. Preprocessing is one process for all: once it falls behind it reads "
        "the newest part only, and each of those is due as a whole scan. What it leaves out is counted.",
    ),
    Benchmark(
        "reaction",
        "From a touch to its contact",
        None,
        ("reaction",),
        "Full scans are there to compare with: theirs take 45 ms. In parts, the first part of a touch takes 4 to 10 ms "
        "of CPU with cold caches, beside the stub on two cores; a part's bytes take the line 1.4 ms. What is off by "
        "more than three standard deviations are fewer frames than normal errors would have.",
    ),
    Benchmark(
        "reaction_simulated",
        "From a touch to its contact, in simulated time",
        ("--quick", "--simulated"),
        ("reaction_simulated",),
        "Full scans are there to compare with: theirs take 45 ms. A light touch and a force that grows are told later.",
        of="reaction",
        arguments=("--simulated", "--steps", "90"),
        beside=True,
    ),
    Benchmark(
        "peers",
        "Peers",
        ("--frames", "30", "--rounds", "2"),
        limits="Our relay keeps the newest frame, so one that is overtaken is skipped by design.",
    ),
    Benchmark(
        "bridges",
        "Bridges to ROS 2 and Foxglove",
        ("--seconds", "8", "--rounds", "2"),
        limits="p99 is waiting for a processor that the stub's physics, the pipeline or the listeners have.",
    ),
    Benchmark(
        "page",
        "The live page",
        ("--seconds", "8", "--rounds", "2"),
        limits="What viewers cost the pipeline is the processor that ten of them, here on the same cores, have.",
    ),
    Benchmark(
        "trust",
        "Worlds that nobody tuned to",
        ("--quick", "--cores", "1"),
        limits="docs/reliability.md says of each world what is wrong today; tests/services/test_estimator_defects.py "
        "fails of it.",
        arguments=("--minutes", "3", "--cores", "1"),
        beside=True,
    ),
    Benchmark(
        "force",
        "Forces of presses of unknown size",
        ("--quick",),
        ("force",),
        "A network's strength of a touch errs by 4 to 5 %, by another amount at each place, however little noise there "
        "is: the stated sigma covers that, and is several floors of the noise.",
        beside=True,
    ),
    Benchmark("untouched_parts", "False touches of scans in parts", ("--quick",), beside=True),
    Benchmark("tracking", "Ten minutes of contacts", ("--seconds", "60"), beside=True),
    Benchmark(
        "faults",
        "Faults of the board",
        ("--quick",),
        limits="docs/reliability.md says of each row what is wrong today.",
    ),
    Benchmark(
        "drift",
        "Starts under a touch, gain, drift",
        ("--quick",),
        limits="docs/reliability.md says what is wrong today.",
    ),
    Benchmark("stability", "Numerical stability", ("--quick",), ("stability",)),
    Benchmark(
        "accuracy",
        "Accuracy against run time",
        ("--quick",),
        ("accuracy",),
        "At 70 dB an ideal classifier names 78 % of the shapes (`skin bench shape_limit`); the rest is a network small "
        "enough for a millisecond, after three and a half hours of training on one core.",
    ),
    Benchmark(
        "refined",
        "Touches refined by physics",
        ("--quick",),
        limits="The response of a touch without a mesh is known to 0.2 % for round touches and 0.5 % for those with "
        "corners; without noise that is what is left. At 70 dB shapes are what noise lets be told apart.",
    ),
    Benchmark(
        "mismatch",
        "Mismatched skins",
        ("--quick", "--only", "anisotropy5", "mild"),
        limits="A soft edge shows in no untouched frame: networks that are trained with soft edges are to see it.",
        beside=True,
    ),
    Benchmark("memory", "Memory over many frames", ("--frames", "20000"), beside=True),
)


def short_form(name: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a benchmark with its own ones in the place of --quick, where its program has no such option."""
    for benchmark in BENCHMARKS:
        if benchmark.command == name and benchmark.quick is not None and "--quick" not in benchmark.quick:
            return [*benchmark.quick, *(word for word in arguments if word != "--quick")]
    return list(arguments)


def run(chosen: Sequence[Benchmark], folder: Path, quick: bool) -> list[str]:
    """Runs them, those that measure times first and each alone, the others side by side, one a core. Each one's tables
    go to NAME.txt, and to our output when it ends. Returns what went wrong.
    """
    waiting = sorted(chosen, key=lambda benchmark: benchmark.beside)
    running: list[Running] = []
    wrong = []
    try:
        while waiting or running:
            while waiting and may_begin(waiting[0], running):
                running.append(Running(waiting.pop(0), folder, quick))
            time.sleep(POLL_S)
            for each in [each for each in running if each.ended()]:
                running.remove(each)
                wrong += each.told()
    finally:  # they end when we are told to end
        for each in running:
            each.process.kill()
            each.process.wait()
    return wrong


def may_begin(benchmark: Benchmark, running: Sequence[Running]) -> bool:
    """Whether a core is free for it, and no time that is being measured is disturbed."""
    alone = not benchmark.beside or any(not each.benchmark.beside for each in running)
    return len(running) < (1 if alone else len(os.sched_getaffinity(0)))


class Running:
    """A benchmark in a process of its own."""

    def __init__(self, benchmark: Benchmark, folder: Path, quick: bool) -> None:
        module = commands().get(benchmark.command, f"bench.{benchmark.command}")
        arguments = benchmark.quick or () if quick else benchmark.arguments
        command = [sys.executable, "-m", module, *arguments]
        print(f"\n=== {benchmark.title}: {' '.join(command[2:])}", flush=True)
        for suffix in ("json", "txt"):  # what an earlier run left is not this one's
            (folder / f"{benchmark.name}.{suffix}").unlink(missing_ok=True)
        self.benchmark = benchmark
        self.began = time.monotonic()
        self.tables = folder / f"{benchmark.name}.txt"
        with self.tables.open("wb") as kept:
            self.process = subprocess.Popen(
                [*command, "--out", os.path.relpath(folder, ROOT)],  # what it says of it names no place of this machine
                cwd=ROOT,
                stdout=kept,
                env=os.environ | {"COLUMNS": "150"},
            )

    def ended(self) -> bool:
        if time.monotonic() - self.began > LIMIT_S:
            self.process.terminate()
        return self.process.poll() is not None

    def told(self) -> list[str]:
        """Prints what it printed. What went wrong, if anything."""
        minutes = (time.monotonic() - self.began) / 60
        print(f"\n--- {self.benchmark.title}: {minutes:.1f} minutes", flush=True)
        print(self.tables.read_text(encoding="utf-8", errors="replace"), end="", flush=True)
        status = self.process.returncode
        return [f"{self.benchmark.name} ended with exit status {status}"] if status else []


def section(benchmark: Benchmark, folder: Path) -> tuple[list[str], list[Goal], str]:
    """(lines of the page, goals, commit). Raises FileNotFoundError where it was not run, KeyError of an older form."""
    report: dict[str, Any] = json.loads((folder / f"{benchmark.name}.json").read_text(encoding="utf-8"))
    goals = [Goal.from_dict(found) for found in report["targets"]]
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    made = f"`{report['command'].strip()}` at commit {report['commit']} on {report['machine']}; {versions}."
    lines = [f"## {benchmark.title}", "", made]
    if bundle := report.get("bundle"):
        lines[-1] += f" Bundle {bundle['name']} {bundle['hash'][:12]}."
    lines += ["", "| | measured | target | |", "|---|---|---|---|"]
    for goal in goals:
        word = {True: "met", False: "**missed**", None: ""}[goal.met]
        lines.append(f"| {goal.figure} | {goal.measured} | {goal.wanted} | {word} |")
    if benchmark.limits and any(goal.met is False for goal in goals):
        lines += ["", f"What limits it: {benchmark.limits}"]
    tables = folder / f"{benchmark.name}.txt"
    printed = tables.read_text(encoding="utf-8").rstrip() if tables.is_file() else ""
    if len(printed) > LONG:
        lines += ["", f"[All it printed]({tables.name})"]
    elif printed:
        lines += ["", "<details><summary>All it printed</summary>", "", "```", printed, "```", "", "</details>"]
    for note in report.get("left_out", []):
        lines += ["", note] if note not in printed else []
    for picture in benchmark.pictures:
        if (folder / f"{picture}.png").is_file():
            lines += ["", f"![{benchmark.title}]({picture}.png)"]
    return [*lines, ""], goals, report["commit"]


def page(chosen: Sequence[Benchmark], folder: Path) -> tuple[str, list[Goal], list[Benchmark]]:
    """The page in Markdown, all goals on it, and the benchmarks that have no report to read."""
    bodies, every, absent, commits = [], [], [], set()
    for benchmark in chosen:
        try:
            lines, goals, commit = section(benchmark, folder)
        except (FileNotFoundError, KeyError, ValueError):
            command = " ".join(("skin bench", benchmark.command, *benchmark.arguments))
            bodies += [f"## {benchmark.title}", "", f"Not run: `{command}`.", ""]
            absent.append(benchmark)
            continue
        bodies += lines
        every += goals
        commits.add(commit)
    made = "all at one commit" if len(commits) == 1 else f"at {len(commits)} commits, each by a command of its own"
    with_target = [goal for goal in every if goal.met is not None]
    met = sum(bool(goal.met) for goal in with_target)
    lacking = f" Not run: {', '.join(b.name for b in absent)}." if absent else ""
    top = [
        "# Benchmarks",
        "",
        f"`skin bench all`: {met} of {len(with_target)} targets met.{lacking} The parts were run {made}; each section "
        "says its command and machine.",
        "",
    ]
    return "\n".join(top + bodies), every, absent


def gates(benchmark: Benchmark, folder: Path) -> set[str]:
    """The figures with a gate in a report; none where there is no report."""
    try:
        report = json.loads((folder / f"{benchmark.name}.json").read_text(encoding="utf-8"))
        return {found["figure"] for found in report["targets"] if found.get("gate") is not None}
    except (FileNotFoundError, KeyError, ValueError):
        return set()


def left_out(chosen: Sequence[Benchmark], folder: Path) -> list[str]:
    """What the short form does not try: benchmarks that have none, and gates of the full form's reports."""
    lines = []
    for benchmark in chosen:
        if benchmark.quick is None:
            lines.append(f"{benchmark.name}: has no short form")
            continue
        untried = gates(benchmark, REPORTS) - gates(benchmark, folder)
        lines += [f"{benchmark.name}: {figure}" for figure in sorted(untried)]
    return lines


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench all", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="short forms; fails where a ratio is beyond its gate")
    parser.add_argument("--reuse", action="store_true", help="run nothing: the page from the reports there are")
    parser.add_argument("--only", nargs="+", metavar="NAME", choices=[b.name for b in BENCHMARKS])
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    wanted = [b for b in BENCHMARKS if args.only is None or b.name in args.only]
    chosen = [b for b in wanted if b.quick is not None or args.only is not None] if args.quick else wanted
    args.out.mkdir(parents=True, exist_ok=True)
    began, failed = time.perf_counter(), []
    if not args.reuse:
        failed = run(chosen, args.out.resolve(), args.quick)
    whole = not args.quick and (args.only is None or args.reuse)
    text, goals, absent = page(BENCHMARKS if whole else chosen, args.out)
    print("\n" + text)
    if whole:
        (args.out / "README.md").write_text(text, encoding="utf-8")
        print(f"wrote {args.out / 'README.md'}")
    if not args.reuse or args.quick:  # the page alone says it in its own words
        failed += [f"{b.name}: there is no report of it: a gate that was not tried is not met" for b in absent]
    beyond = [f"{goal.figure}: {goal.measured}, gate {goal.gate:g}" for goal in goals if not goal.passed]
    for problem in failed + beyond:
        print(f"FAILED: {problem}", file=sys.stderr)
    for what in left_out(wanted, args.out) if args.quick else ():
        print(f"left out of the short form: {what}")
    print(f"{(time.perf_counter() - began) / 60:.1f} minutes, {os.cpu_count()} cores")
    return 1 if failed or (args.quick and beyond) else 0


if __name__ == "__main__":
    raise SystemExit(main())
