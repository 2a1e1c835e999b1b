"""Numerical stability: everything that goes in made worse, step by step, until the answer or the promise breaks.

    skin bench stability [--quick] [--only PART ...] [--out bench/reports]
    skin bench stability --scan rolling    what concerns scans, with scans in parts (stability-rolling.json)

For each case: error against truth where there is one, and whether the promise was kept: no exception, no NaN or
infinity out, never `valid` on garbage, no contact that jumps by more than 2 mm for a change within noise (or by four
times what no estimator can beat, where that is more: a light touch under much noise), no frame to act on that is older
than its `valid_for_s` and 0.1 s; over TCP nobody reads, sends or commands without the key for it. Prints tables, writes
stability.json and stability.png. Exit status 1 where the promise was broken.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import services  # noqa: F401, I001  (one thread for the numerical libraries, before numpy starts them)
from bench import REPORTS
from bench.stability import (
    change,
    changed_bytes,
    garbage,
    key_attacks,
    late_bytes,
    matrices,
    physics,
    precision,
    report,
)
from bench.stability.run import SKIN, Row, Setting
from models.bundle import Bundle
from models.command import whole

PARTS = {
    **matrices.PARTS,
    **physics.PARTS,
    **precision.PARTS,
    **garbage.PARTS,
    **changed_bytes.PARTS,
    **change.PARTS,
    **late_bytes.PARTS,
    **key_attacks.PARTS,
}


def run(setting: Setting, only: Sequence[str] = ()) -> dict[str, list[Row]]:
    """The rows of each part whose name contains one of `only`; all parts where that is empty."""
    found: dict[str, list[Row]] = {}
    for name, part in PARTS.items():
        if only and not any(word in name for word in only):
            continue
        began = time.process_time()
        found[name] = list(part(setting))
        faults = len(report.broken({name: found[name]}))
        took = time.process_time() - began
        print(f"{name}: {len(found[name])} cases, {faults} broken, {took:.1f} s of CPU", file=sys.stderr)
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench stability", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer cases and frames: under a minute on one core")
    parser.add_argument("--only", nargs="*", default=(), metavar="PART", help="parts whose name contains one of these")
    parser.add_argument("--bundle", default=SKIN, help=f"a bundle of the skin {SKIN}")
    parser.add_argument("--scan", choices=("full", "rolling"), default="full", help="whole scans, or scans in parts")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    began, cpu = time.perf_counter(), time.process_time()
    setting, rolling = Setting(Bundle.load(args.bundle), args.quick, args.seed, args.scan), args.scan == "rolling"
    found = run(setting, args.only or (tuple(late_bytes.PARTS) if rolling else ()))
    report.show(found)
    top = report.head(setting, time.perf_counter() - began, time.process_time() - cpu)
    path = args.out / f"stability{'-rolling' * rolling}.json"
    report.write(path, top, found)
    print(f"{top['seconds']:.0f} s ({top['cpu_seconds']:.0f} s of CPU); wrote {path}")
    return 1 if report.broken(found) else 0


if __name__ == "__main__":
    raise SystemExit(main())
