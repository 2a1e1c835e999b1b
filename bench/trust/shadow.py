"""Several estimators in the same sessions: the same raw frames, each judged by the same truth.

    skin bench shadow --candidate without-memory without-rates --minutes 2 --world creep --scan full
    skin bench shadow --candidate "MEMORY_SHARE*0.5" "MEMORY_SHARE*2" --minutes 2
    skin bench shadow --candidate MODULE:CLASS

A candidate is the service's own stages without a part of their model or with some other numbers
(bench/trust/candidates.py), or what bench/trust/candidate.py says: it takes raw frames and gives contact frames.
Writes shadow.json; the exit status is 1 where a candidate does more of what must not be than the service, beyond what
chance would.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping
from typing import Any

from bench.goals import Goal
from bench.reliability import report as reports
from bench.speed.service import end_on_sigterm
from bench.trust import candidates, kept, options, report, runs
from firmware_stub.worlds.table import WORLDS
from models.command import real
from services.recordings.replay_session import private_runtime

COUNTED = (
    "phantom frames", "wrong counts", "hidden", "hidden briefly", "never shown", "ids", "refused", "aged", "force 6",
    "place 6",
)  # fmt: skip
SHARES = ("valid untouched %", "valid touched %", "valid in faults %")
LESS_VALID = 0.1  # percentage points


def more_than(old: float) -> float:
    """How much a count may be where the service's is `old`."""
    return old + 2 * math.sqrt(old + 1) if old else 0.0


def compared(world: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> list[Goal]:
    """The gates of a candidate in one world."""
    made = []
    for key in COUNTED:
        most = more_than(old[key])
        made.append(Goal(f"{world}: {key}, the service {old[key]:g}", new[key], at_most=most, gate=most))
    for key in SHARES:
        if old[key] is not None and new[key] is not None:
            least = old[key] - LESS_VALID
            made.append(Goal(f"{world}: {key}, the service {old[key]:.2f}", new[key], at_least=least, gate=least))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench shadow", description=(__doc__ or "").split("\n\n")[0])
    options.add(parser, 10.0)
    parser.add_argument("--candidate", nargs="+", required=True, metavar="CANDIDATE", help="see above")
    parser.add_argument("--session", type=real(), default=runs.SESSION_S, help="seconds of one (default: 60)")
    args = parser.parse_args(argv)
    if not 0 < args.minutes <= 1e5 or not 8 <= args.session <= 3600:
        parser.error(f"--minutes {args.minutes:g} --session {args.session:g}: expected above 0, and 8 to 3600")
    try:
        for text in args.candidate:
            candidates.kind_of(text)
        args.seed = args.seed or kept.published_seed()
    except ValueError as why:
        parser.error(str(why))
    end_on_sigterm()
    began, rows, goals = time.perf_counter(), dict[str, Any](), list[Goal]()
    everyone = (("today", candidates.TODAY), *((text, text) for text in args.candidate))
    with private_runtime():
        for world in args.world or WORLDS:
            for scan in (args.scan,) if args.scan else runs.SCANS:
                scores = runs.run(
                    world,
                    scan,
                    args.seed,
                    args.minutes,
                    candidates=everyone,
                    session_s=args.session,
                    apart_m=args.apart_mm * 1e-3,
                    bundle=args.bundle,
                    cores=args.cores,
                )
                old = rows[f"{world}, {scan}, the service"] = scores["today"].row()
                for text in args.candidate:
                    new = rows[f"{world}, {scan}, {text}"] = scores[text].row()
                    goals += compared(f"{world}, {scan}, {text}", old, new)
    report.show(rows, "shadow")
    head = reports.head("shadow", argv, args, time.perf_counter() - began)
    reports.show(head, goals)
    reports.write(args.out / "shadow.json", head, {"rows": rows}, goals)
    return reports.status(goals, sys.stderr)


if __name__ == "__main__":
    raise SystemExit(main())
