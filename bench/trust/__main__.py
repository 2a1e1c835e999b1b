"""Simulated minutes, judged against the truth: what must not be, and what hiding it would cost.

    skin bench trust                            every world, both kinds of scan, ten minutes of each
    skin bench trust --row plain --scan full    one of them
    skin bench trust --plan faults              every fault of the board; also: starts, drift, tracking
    skin bench trust --against CHECKOUT         the stages of another checkout too, on the same raw frames
    skin bench trust --rows                     the rows of a plan; of the worlds, where their figures come from
    skin bench trust --quick                    the short form of CI: a session of each world, by a fixed seed

The seed is the checked out commit, which is the parent of the one that publishes the figures; each session's is the
sha256 of it, the row's name and the session's number. `--keep FILE`: scores of sessions are kept there, and used again
as long as the code that made them is the same. Writes trust.json (trust-PLAN.json of another plan). The exit status is
1 where a gate breaks, or where more of what must not be is found than in the other checkout, beyond what chance would.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench import REPORTS
from bench.goals import table
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.service import end_on_sigterm
from bench.trust import plans, report, runs
from bench.trust.score import TrustScore
from models.bundle import Bundle
from models.command import real, whole
from services.recordings.replay_session import private_runtime

QUICK_SEED, QUICK_S = "7", 13.0


def parsed(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="skin bench trust", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--plan", choices=tuple(plans.PLANS), default="worlds")
    parser.add_argument("--row", "--world", nargs="+", metavar="ROW", help="of the plan; default: every one")
    parser.add_argument("--minutes", type=real(), help="simulated, of each row and kind of scan; default: the plan's")
    parser.add_argument("--scan", choices=runs.SCANS, help="whole scans, or scans in parts; default: both")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout of the project")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="scores that count again")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="recordings of sessions that fail")
    parser.add_argument("--seed", help="a text instead of the commit")
    parser.add_argument("--session", type=real(), help="seconds of one, of the worlds (60)")
    parser.add_argument("--apart-mm", type=real(itself=True), default=28.0, help="least distance of touches (28)")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--cores", type=whole(), default=runs.usable_cores())
    parser.add_argument("--quick", action="store_true", help="one short session of each, by a fixed seed")
    parser.add_argument("--rows", "--worlds", action="store_true", help="list the rows of the plan, and end")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    plan = plans.PLANS[args.plan]
    if unknown := sorted(set(args.row or ()) - set(plan.rows)):
        parser.error(f"no row {unknown[0]!r} of {args.plan}: expected some of {', '.join(plan.rows)}")
    if args.against and not (args.against / "services" / "pipeline.py").is_file():
        parser.error(f"--against {args.against}: expected a checkout, with services/pipeline.py in it")
    if args.quick:
        args.seed, args.session, args.minutes = args.seed or QUICK_SEED, args.session or QUICK_S, args.minutes or 1 / 60
    args.minutes = args.minutes or plan.minutes
    if args.minutes > 1e5 or (args.session and not 8 <= args.session <= 3600):
        parser.error(f"--minutes {args.minutes:g} --session {args.session}: expected up to 100000, and 8 to 3600")
    try:
        args.seed = args.seed or runs.published_seed()
    except ValueError as why:
        parser.error(str(why))
    return args


def judged(args: argparse.Namespace) -> dict[tuple[str, str], dict[str, TrustScore]]:
    """(row, kind of scan) -> the score of this checkout, and of the other."""
    others = (str(args.against.resolve()),) if args.against else ()
    run = runs.TrustRun(
        args.plan,
        args.seed,
        args.minutes,
        (runs.OURS, *others),
        args.session,
        args.apart_mm * 1e-3,
        args.bundle,
        args.cores,
        args.record,
    )
    scans = (args.scan,) if args.scan else runs.SCANS
    with private_runtime():
        return run.scores(args.row or plans.PLANS[args.plan].rows, scans, runs.KeptScores(args.keep))


def rows_of(found: Mapping[tuple[str, str], Mapping[str, TrustScore]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The table's rows of this checkout, and of the other: by row and kind of scan, and of all."""
    rows: tuple[dict[str, Any], dict[str, Any]] = {}, {}
    totals = TrustScore(), TrustScore()
    for (name, scan), scores in found.items():
        for of, total, score in zip(rows, totals, scores.values(), strict=False):
            of[f"{name}, {scan}"] = score.row()
            total.add(score)
    for of, total in zip(rows, totals, strict=True):
        if of:
            of["all"] = total.row()
    return rows


def main(argv: list[str] | None = None) -> int:
    args = parsed(argv)
    if args.rows:
        print(report.about_worlds() if args.plan == "worlds" else "\n".join(plans.PLANS[args.plan].rows))
        return 0
    end_on_sigterm()
    began = time.perf_counter()
    ours, other = rows_of(judged(args))
    goals = report.goals(ours, args.quick)
    compared = [goal for name in other for goal in report.compared(name, other[name], ours[name])]
    both = {f"{name}{of}": rows[name] for name in ours for of, rows in (("", ours), (", other", other)) if rows}
    report.show(both, args.plan)
    if other:
        report.show_beside(ours["all"], other["all"])
    report.console().print(table([*goals, *(goal for goal in compared if not goal.met)]))
    goals += compared
    bundle = Bundle.load(args.bundle)
    head = provenance("trust", argv) | {"bundle": {"name": bundle.name, "hash": bundle.hash}, "seed": args.seed}
    head |= {"snr_db": 80, "seconds": round(time.perf_counter() - began, 1)}
    path = args.out / ("trust.json" if args.plan == "worlds" else f"trust-{args.plan}.json")
    write_json(path, {**head, "targets": [goal.to_dict() for goal in goals], "rows": ours, "other": other})
    print(f"{head['seconds']:.0f} s, {head['machine']}, bundle {bundle.name} {bundle.hash[:12]}; wrote {path}")
    broken = [goal for goal in goals if not goal.passed]
    for goal in broken:
        print(f"FAILED: {goal.figure}: {goal.measured}, gate {goal.gate:g}", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    raise SystemExit(main())
