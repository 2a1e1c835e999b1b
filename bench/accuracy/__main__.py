"""Accuracy of the service, and of every other method on the same frames, of mismatched skins and of real presses.

    skin bench accuracy [--quick] [--sections methods mismatch conditions presses]
    skin bench accuracy --sections methods --reads peak --only --levels none 70 --out bench/work/published
    skin bench accuracy --sections presses --real FILE

`eitskin` is what `skin reconstruct` gives of the frames as rows of a file, with default settings; `its network alone`
is the image before the service makes touches of it. The second line is the published test: LDCI, and force from the
peak drop of one indenter of 10 mm radius. The third scores real presses (hydrogel_disc16.npz in $EITSKIN_REFERENCE).

methods: frames are solved on the reference mesh, which no training and no inverse uses, and read from bench/work where
they are there. Noise: |Z| 10^(-dB/20) on each measurement, and on the 64 untouched frames of the tare; "70f" is the
same ohm on all. Hyperparameters of the classical methods are chosen for each noise level on frames of their own.
Prints tables, writes accuracy.json and draws accuracy.png.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console

from bench import REPORTS
from bench.accuracy import compare, conditions, mismatch, peers, presses, report
from bench.accuracy import frames as _frames
from bench.accuracy import methods as _methods
from bench.goals import Goal
from bench.goals import table as goal_table
from bench.json_file import drawn, write_json
from bench.machine import provenance
from models.bundle import Bundle, BundleError
from models.command import whole
from services.runtime.config import Reads, Skin

SECTIONS = ("methods", "mismatch", "conditions", "presses")
SINGLES = 100  # of each shape and for force in the full form: 500 frames give the mean IoU to 0.003
LEVELS = ("none", "50", "60", "70", "80", "70f")
QUICK_LEVELS = ("none", "70")


def compared(args: argparse.Namespace, mesh: str, console: Console) -> dict[str, Any]:
    """The section `methods`."""
    bundle = Bundle.load("square16")
    methods = _methods.classical() + _methods.peers() + _methods.published(bundle) + _methods.network_alone(bundle)
    frames = _frames.load(args.seed, 6 if args.quick else 20, mesh, singles=None if args.quick else SINGLES)
    tuning = _frames.load(args.seed + 1000, 4, "stub", ("shapes", "hertz"))
    wanted = [m for m in methods if args.only is None or any(o in m.name for o in args.only)]
    skin = Skin(port="stub", bundle=bundle.name, reads=args.reads)
    rows, floors = [], {}
    for level in args.levels or (QUICK_LEVELS if args.quick else LEVELS):
        rows += compare.run(frames, tuning, wanted, level, args.seed, args.quick, skin)
        floors[level] = compare.floors(frames, level)
        console.print(report.table(level, rows, floors[level], mesh, args.reads))
    names, counts = np.unique(frames.group, return_counts=True)
    said = {"bundle": {"name": bundle.name, "hash": bundle.hash}, "mesh": mesh, "reads": args.reads}
    said["frames"] = {str(name): int(count) for name, count in zip(names, counts, strict=True)}
    return {**said, "rows": rows, "floors": floors}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench accuracy", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few hundred frames of a coarser mesh, two noise levels")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--levels", nargs="+", choices=LEVELS, help="dB; none: noise-free; 70f: fixed in ohm")
    parser.add_argument("--only", nargs="*", help="methods whose name contains one of these; no name: the service")
    parser.add_argument("--reads", choices=get_args(Reads), default="pressure", help="what forces are read from")
    parser.add_argument("--mesh", choices=("reference", "stub"), help="stub: the full form's frames in minutes")
    parser.add_argument("--skins", type=whole(), default=1, help="drawn of each mismatch")
    parser.add_argument("--touches", type=whole(), default=2, help="of each shape on each mismatched skin")
    parser.add_argument("--real", type=Path, default=_frames.DATA / presses.FILE, metavar="FILE", help="real presses")
    parser.add_argument("--splits", type=whole(), default=3, help="random splits of the real presses")
    parser.add_argument("--seed", type=whole(0), default=5, help="of frames and noise")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    console, began = Console(width=200), time.perf_counter()
    mesh = args.mesh or ("stub" if args.quick else "reference")
    found: dict[str, Any] = {}
    goals: list[Goal] = []
    left_out = [] if peers.installed() else ["pyEIT is not installed (`make venv-dev EXTRAS=peers`): left out"]
    if "methods" in args.sections:
        found |= compared(args, mesh, console)
        goals += report.goals(found["rows"])
    if "mismatch" in args.sections:
        names, touches = (mismatch.QUICK, 1) if args.quick else (tuple(mismatch.WANTED), args.touches)
        levels = [level for level in args.levels or mismatch.LEVELS if level in mismatch.LEVELS]
        found["mismatch"] = mismatch.run(names, args.skins, touches, levels, args.mesh or "stub", args.seed)
        console.print(mismatch.table(found["mismatch"]))
        goals += mismatch.goals(found["mismatch"])
    if "conditions" in args.sections:
        found["conditions"] = conditions.run(args.quick, args.seed)
        console.print(conditions.table(found["conditions"]))
    if "presses" in args.sections:
        try:
            found["presses"] = presses.run(args.real, args.splits, args.quick)
        except (OSError, BundleError) as why:
            if args.sections == ["presses"]:
                parser.error(f"{why}: name {presses.FILE} by --real, or set EITSKIN_REFERENCE to its folder")
            left_out.append(f"real presses: {why}: left out")
        else:
            presses.show(found["presses"])
            goals += presses.goals(found["presses"])
    console.print(goal_table(goals))
    for line in left_out:
        print(line)
    head = {**provenance("accuracy", argv), "left_out": left_out, "targets": [goal.to_dict() for goal in goals]}
    write_json(args.out / "accuracy.json", head | found)
    if "rows" in found:
        drawn(args.out / "accuracy.json")
    print(f"{time.perf_counter() - began:.0f} s; wrote {args.out / 'accuracy.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
