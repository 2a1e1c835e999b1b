"""Starts under a touch, gain steps, and touches on a skin that drifted since its tare: what is said, what is true.

    skin bench drift                      49 places, every case: some minutes on two cores
    skin bench drift --quick              a few places of each: for CI
    skin bench drift --only starts        one part: starts, gains, rows, history

80 dB; every impedance is solved on the stub's mesh, which neither training nor inverse uses, and kept in bench/work.
Prints figures beside targets and writes drift.json. Exit status 1 where what held when the gate was set, a constant
beside each target, does not hold any more.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench import REPORTS
from bench.reliability import drift_report, drifted, gain_steps, report, starts, workers
from bench.reliability.drifted import CHANGES, Change, TouchAnswer
from bench.reliability.scenes import grid, touches_at_random
from bench.speed.service import end_on_sigterm
from firmware_stub.world import Touch
from models.bundle import Bundle
from models.command import whole

PARTS = ("starts", "gains", "rows", "history")


@dataclass(frozen=True)
class DriftSetting:
    """The numbers of cases, and the bundle, seed and cores."""

    bundle: str
    seed: int
    cores: int
    start_places: int  # along the side
    gain_places: int
    row_places: int  # along the side
    history_touches: int
    floor_places: int  # along the side


def setting_of(args: argparse.Namespace) -> DriftSetting:
    counts = (2, 2, 2, 2, 3) if args.quick else (7, 20, 7, 20, 6)
    return DriftSetting(args.bundle, args.seed, args.cores, *counts)


StartTask = tuple[str, str, tuple[float, float], float, float, int]


def _start(task: StartTask) -> tuple[str, tuple[float, float], starts.StartScore]:
    bundle, state, place, newtons, radius, seed = task
    score = starts.start(workers.sheet(), workers.pipeline(bundle), state, place, newtons, radius, seed)
    return state, (newtons, radius), score


def run_starts(setting: DriftSetting) -> dict[str, starts.StartScore]:
    """The starts' scores by state, and by state and press."""
    tasks: list[StartTask] = [
        (setting.bundle, state, place, *press, setting.seed + k)
        for k, place in enumerate(grid(setting.start_places))
        for press in starts.PRESSES
        for state in starts.STATES
    ]
    found: dict[str, starts.StartScore] = {}
    for state, (newtons, radius), score in workers.spread(_start, tasks, setting.cores, "starts"):
        for key in (state, f"{state}, {newtons:g} N, radius {radius:g}"):
            found.setdefault(key, starts.StartScore()).add(score)
    return found


GainTask = tuple[str, float, str, Touch, int]


def _gain(task: GainTask) -> tuple[str, float, gain_steps.GainStepScore]:
    bundle, gain, situation, touch, seed = task
    return situation, gain, gain_steps.step(workers.sheet(), workers.pipeline(bundle), gain, situation, touch, seed)


def run_gains(setting: DriftSetting) -> dict[str, gain_steps.GainStepScore]:
    """The gain steps' scores by situation, and by situation and gain."""
    tasks: list[GainTask] = [
        (setting.bundle, gain, situation, touch, setting.seed + k)
        for k, touch in enumerate(gain_steps.places(setting.gain_places, setting.seed))
        for gain in gain_steps.GAINS
        for situation in gain_steps.SITUATIONS
    ]
    found: dict[str, gain_steps.GainStepScore] = {}
    for situation, gain, score in workers.spread(_gain, tasks, setting.cores, "gain steps"):
        for key in (situation, f"{situation}, {100 * gain:+.1f} %"):
            found.setdefault(key, gain_steps.GainStepScore()).add(score)
    return found


RowTask = tuple[str, Change, float, bool, int, int]


def _rows(task: RowTask) -> tuple[Change, bool, list[TouchAnswer], int]:
    bundle, change, radius, indenter, per_side, seed = task
    answers, alarms = drifted.rows_alone(
        workers.sheet(), Bundle.load(bundle), change, grid(per_side), seed, radius, indenter
    )
    return change, indenter, answers, alarms


def run_rows(setting: DriftSetting) -> dict[str, dict[str, Any]]:
    """The scores by change: rows alone, and the same with the indenter declared."""
    tasks: list[RowTask] = [
        (setting.bundle, change, radius, indenter, setting.row_places, setting.seed)
        for change in CHANGES
        for radius in drifted.RADII
        for indenter in (False, True)
    ]
    answers: dict[tuple[str, bool], list[TouchAnswer]] = {}
    alarms: dict[tuple[str, bool], int] = {}
    for change, indenter, some, false in workers.spread(_rows, tasks, setting.cores, "rows alone"):
        key = change.name, indenter
        answers.setdefault(key, []).extend(some)
        alarms[key] = alarms.get(key, 0) + false
    found = {}
    for change in CHANGES:
        floor = drifted.floor_percent(change, setting.floor_places)
        plain, known = (change.name, False), (change.name, True)
        found[change.name] = drifted.row(answers[plain], alarms[plain], floor)
        found[change.name]["known_force_%"] = drifted.row(answers[known], 0)["force_%"]
    return found


HistoryTask = tuple[str, Change, Touch, int]


def _history(task: HistoryTask) -> tuple[Change, TouchAnswer, int]:
    bundle, change, touch, seed = task
    answer, alarms = drifted.with_history(workers.sheet(), workers.pipeline(bundle), change, touch, seed)
    return change, answer, alarms


def run_history(setting: DriftSetting) -> dict[str, dict[str, Any]]:
    touches = touches_at_random(setting.history_touches, setting.seed + 1)
    tasks: list[HistoryTask] = [
        (setting.bundle, change, touch, setting.seed + k) for k, touch in enumerate(touches) for change in CHANGES
    ]
    answers: dict[str, list[TouchAnswer]] = {}
    alarms: dict[str, int] = {}
    for change, answer, false in workers.spread(_history, tasks, setting.cores, "drift with history"):
        answers.setdefault(change.name, []).append(answer)
        alarms[change.name] = alarms.get(change.name, 0) + false
    return {change.name: drifted.row(answers[change.name], alarms[change.name]) for change in CHANGES}


def run(setting: DriftSetting, parts: Sequence[str] = PARTS) -> dict[str, dict[str, dict[str, Any]]]:
    found: dict[str, dict[str, dict[str, Any]]] = {}
    if "starts" in parts:
        found["starts"] = {key: score.row() for key, score in run_starts(setting).items()}
    if "gains" in parts:
        found["gains"] = {key: score.row() for key, score in run_gains(setting).items()}
    if "rows" in parts:
        found["rows"] = run_rows(setting)
    if "history" in parts:
        found["history"] = run_history(setting)
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench drift", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few places: a minute on two cores")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="these parts; writes no report")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--seed", type=whole(0), default=5, help="of contact impedances, electrodes and noise")
    parser.add_argument("--cores", type=whole(), default=workers.cores())
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    began = time.perf_counter()
    found = run(setting_of(args), args.only)
    goals = drift_report.goals(found, args.quick)
    head = report.head("drift", argv, args, time.perf_counter() - began)
    drift_report.show(found)
    report.show(head, goals)
    if len(args.only) == len(PARTS):
        report.write(args.out / "drift.json", head, found, goals)
    return report.status(goals, sys.stderr)


if __name__ == "__main__":
    raise SystemExit(main())
