"""Faults of the board against what the service says, in simulated time: the matrix, availability, random frames.

    skin bench faults                     every fault x (untouched, held, sliding, begins) x 20 places, and availability
    skin bench faults --quick             two places, and 20 000 frames of random faults and presses: for CI
    skin bench faults --only gain hang    some rows of the matrix, nothing else
    skin bench faults --frames 1000000    that many frames of random faults and presses, nothing else
    skin bench faults --frames 100000 --more    so many more, added to those of the last report
    skin bench faults --scan rolling      any of these with scans in parts (faults-rolling.json, soak-rolling.json)

The stub board's bytes go through line, link, clock regression and the stages that the services run. Prints figures
beside targets and writes faults.json (--frames: soak.json). Exit status 1 where what held when the gate was set, a
constant beside each target, does not hold any more.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from bench import REPORTS
from bench.reliability import availability, faults_report, matrix, report, soak, workers
from bench.reliability.matrix import ROWS, SITUATIONS, FaultScore
from bench.speed.service import end_on_sigterm
from firmware_stub.world import Touch
from models.command import whole
from services.pipeline import Pipeline

PLACES, QUICK_PLACES = 20, 2
SESSIONS, QUICK_SESSIONS = 8, 1  # of each state of availability, soak.CHUNK frames each
QUICK_FRAMES = 20_000  # of random faults and presses
Cells = dict[tuple[str, str], FaultScore]  # (row's title, situation)


class SkinUnderTest(NamedTuple):
    """What a run is of."""

    bundle: str
    scan: str

    def pipeline(self) -> Pipeline:
        return workers.pipeline(self.bundle, scan=self.scan)


def run_place(task: tuple[Touch, int, tuple[str, ...], SkinUnderTest]) -> Cells:
    """All rows and situations at one place: (touch, seed, titles, skin)."""
    touch, seed, titles, skin = task
    sheet, pipeline = workers.sheet(), skin.pipeline()
    return {
        (row.title, situation): matrix.run_case(sheet, pipeline, row, situation, touch, seed)
        for row in ROWS
        if row.title in titles
        for situation in SITUATIONS
    }


def run_matrix(places: int, seed: int, titles: tuple[str, ...], skin: SkinUnderTest, cores: int) -> Cells:
    found: Cells = {}
    tasks = [(touch, seed + k, titles, skin) for k, touch in enumerate(matrix.places(places, seed))]
    for cells in workers.spread(run_place, tasks, cores, "places of the matrix"):
        for key, score in cells.items():
            found.setdefault(key, FaultScore()).add(score)
    return found


def run_chunk(task: tuple[int, int, SkinUnderTest]) -> soak.SoakTally:
    """One start and the scans after it: (scans, seed, skin)."""
    scans, seed, skin = task
    return soak.chunk(workers.sheet(), skin.pipeline(), scans, seed)


def run_soak(frames: int, seed: int, skin: SkinUnderTest, cores: int, so_far: soak.SoakTally) -> soak.SoakTally:
    """Adds so many frames, from starts that `so_far` does not have."""
    counts = [soak.CHUNK] * (frames // soak.CHUNK) + [frames % soak.CHUNK] * (frames % soak.CHUNK > 0)
    tasks = [(count, 1000 * seed + so_far.chunks + k, skin) for k, count in enumerate(counts)]
    for tally in workers.spread(run_chunk, tasks, cores, "random faults and presses"):
        so_far.add(tally)
    return so_far


def reported(path: Path, seed: int, bundle: str) -> tuple[soak.SoakTally, list[dict[str, Any]]]:
    """What an earlier report counted, and the runs that it is of. Raises ValueError where it cannot be added to."""
    try:
        report = json.loads(path.read_text())
        was, runs, tally = (
            (report["seed"], report["bundle"]["name"]),
            list(report["runs"]),
            soak.SoakTally.of(report["soak"]),
        )
    except (OSError, ValueError, KeyError) as why:
        raise ValueError(f"{path} is no report of random frames ({why!r}): run without --more first") from None
    if was != (seed, bundle):
        raise ValueError(f"{path} is of seed {was[0]} and bundle {was[1]}, this run is of {seed} and {bundle}")
    return tally, runs


def run_session(task: tuple[str, int, SkinUnderTest]) -> tuple[str, availability.AvailabilityScore]:
    """One session: (state, seed, skin)."""
    state, seed, skin = task
    sheet, pipeline = workers.sheet(), skin.pipeline()
    return state, availability.session(sheet, pipeline, state, availability.FRAMES, seed)


def run_availability(
    sessions: int, seed: int, skin: SkinUnderTest, cores: int
) -> dict[str, availability.AvailabilityScore]:
    found = {state: availability.AvailabilityScore() for state in availability.STATES}
    tasks = [(state, 1000 * seed + k, skin) for k in range(sessions) for state in availability.STATES]
    for state, score in workers.spread(run_session, tasks, cores, "availability"):
        found[state].add(score)
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench faults", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="two places, fewer frames: two minutes on two cores")
    parser.add_argument("--places", type=whole(), help=f"default: {PLACES}, with --quick {QUICK_PLACES}")
    parser.add_argument("--only", nargs="+", metavar="FAULT", help="rows of the matrix that begin so; writes no report")
    parser.add_argument("--frames", type=whole(), help="random faults and presses instead of the matrix")
    parser.add_argument("--more", action="store_true", help="with --frames: add to what the last report counted")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--scan", choices=("full", "rolling"), default="full", help="whole scans, or scans in parts")
    parser.add_argument("--seed", type=whole(0), default=5, help="of places, arguments and noise")
    parser.add_argument("--cores", type=whole(), default=workers.cores())
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    titles = tuple(r.title for r in ROWS if args.only is None or any(r.title.startswith(word) for word in args.only))
    if not titles:
        parser.error(f"--only {' '.join(args.only)}: expected the beginning of {', '.join(r.title for r in ROWS)}")
    if args.frames is not None and not soak.LEAST <= args.frames <= soak.MOST:
        parser.error(f"--frames {args.frames}: expected {soak.LEAST} to {soak.MOST}")
    skin, of_parts = SkinUnderTest(args.bundle, args.scan), "-rolling" * (args.scan == "rolling")
    so_far, runs = soak.SoakTally(), list[dict[str, Any]]()
    if args.more:
        try:
            so_far, runs = reported(args.out / f"soak{of_parts}.json", args.seed, args.bundle)
        except ValueError as why:
            parser.error(str(why))
    end_on_sigterm()
    began = time.perf_counter()
    found: dict[str, Any] = {}
    if args.frames is None:
        places = args.places or (QUICK_PLACES if args.quick else PLACES)
        found["matrix"] = faults_report.matrix_rows(run_matrix(places, args.seed, titles, skin, args.cores))
    if args.frames is None and args.only is None:
        sessions = QUICK_SESSIONS if args.quick else SESSIONS
        scores = run_availability(sessions, args.seed, skin, args.cores)
        found["availability"] = {state: score.row() for state, score in scores.items()}
    head = report.head("faults", argv, args, 0.0)
    if args.frames or (args.quick and args.only is None):
        tally = run_soak(args.frames or QUICK_FRAMES, args.seed, skin, args.cores, so_far)
        found["soak"] = tally.row()
        found["runs"] = [*runs, {"commit": head["commit"], "frames": tally.frames - sum(r["frames"] for r in runs)}]
    goals = faults_report.goals(found, args.quick)
    head["seconds"] = round(time.perf_counter() - began, 1)
    faults_report.show(found)
    report.show(head, goals)
    if args.only is None:
        report.write(args.out / f"{'soak' if args.frames else 'faults'}{of_parts}.json", head, found, goals)
    return report.status(goals, sys.stderr)


if __name__ == "__main__":
    raise SystemExit(main())
