"""Simulated minutes of a world, judged against the truth: what must not be, and what hiding it would cost.

    skin bench trust --minutes 10 --world plain --scan full
    skin bench trust --minutes 10               every world, both kinds of scan
    skin bench trust --floor                    the smallest forces that are shown, by radius
    skin bench trust --worlds                   the worlds, and where their figures come from
    skin bench trust --quick                    the short form of CI: a session of each, by a fixed seed

A run resumes: minutes of earlier runs with the same seed and code count. The seed is the checked out commit, which is
the parent of the one that publishes the figures; each session's is the sha256 of it, the world's name and the session's
number. The worst failing sessions are kept as recordings that replay. Writes trust.json; the exit status is 1 where a
gate breaks.
"""

from __future__ import annotations

import argparse
import sys
import time

from bench.reliability import report as reports
from bench.speed.service import end_on_sigterm
from bench.trust import floor, kept, options, report, runs
from firmware_stub.worlds.table import WORLDS
from services.recordings.replay_session import private_runtime

QUICK_SEED = "7"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench trust", description=(__doc__ or "").split("\n\n")[0])
    options.add(parser, 10.0)
    parser.add_argument("--quick", action="store_true", help="one short session of each, by a fixed seed")
    parser.add_argument("--floor", action="store_true", help="the smallest forces that are shown, in the plain world")
    parser.add_argument("--worlds", action="store_true", help="list the worlds, and end")
    args = parser.parse_args(argv)
    if args.worlds:
        print(report.about_worlds())
        return 0
    if not 0 < args.minutes <= 1e5:
        parser.error(f"--minutes {args.minutes:g}: expected above 0, up to 100000")
    try:
        args.seed = args.seed or (QUICK_SEED if args.quick else kept.published_seed())
    except ValueError as why:
        parser.error(str(why))
    end_on_sigterm()
    if args.floor:
        with private_runtime():
            found = {scan: floor.measured(scan, kept.session_seed(args.seed, "floor", 0)) for scan in runs.SCANS}
        report.show_floor(found)
        return 0
    began, rows = time.perf_counter(), {}
    session_s = runs.QUICK_S if args.quick else runs.SESSION_S
    minutes = runs.QUICK_S / 60 if args.quick else args.minutes
    with private_runtime():
        for world in args.world or WORLDS:
            for scan in (args.scan,) if args.scan else runs.SCANS:
                score = runs.run(
                    world,
                    scan,
                    args.seed,
                    minutes,
                    session_s=session_s,
                    apart_m=args.apart_mm * 1e-3,
                    bundle=args.bundle,
                    cores=args.cores,
                )["today"]
                rows[f"{world}, {scan}"] = score.row()
    report.show(rows, "trust")
    head = reports.head("trust", argv, args, time.perf_counter() - began)
    goals = report.goals(rows, args.quick)
    reports.show(head, goals)
    reports.write(args.out / "trust.json", head, {"rows": rows}, goals)
    return reports.status(goals, sys.stderr)


if __name__ == "__main__":
    raise SystemExit(main())
