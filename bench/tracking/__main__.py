"""Ten scripted minutes in simulated time, scored against the stub's truth.

    skin bench tracking [--scene ten_minutes] [--seconds 60] [--bundle square16] [--out bench/reports]
    skin bench tracking --scan rolling    the same with scans in parts (tracking-rolling.json)

The stub board plays the scene; its bytes go through link, clock regression and the stages that the services run; every
contact frame is matched with the true touches (bench/tracking/scores.py says how). The frames are simulated once and
kept in bench/work; scoring them takes about two minutes. Prints the tables and writes tracking.json.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench import REPORTS
from bench.tracking import faults, report
from bench.tracking.scene import Recorded, record
from bench.tracking.scores import Scorer, StageOutput, all_of
from models.bundle import Bundle
from models.command import real, whole
from services.pipeline import Pipeline
from services.runtime.config import Skin

HOLD = "hold"  # the section whose touch must not fade
FADE_S = 5.0  # mean of the force over so long, at both ends


def follow(recorded: Recorded, skin: Skin, bundle: Bundle | None = None) -> tuple[Recorded, list[StageOutput]]:
    """What the stages say, and the frames that were measured when it holds: of whole scans all."""
    pipeline = Pipeline(skin, name="palm", bundle=bundle)
    seen, measured, before = list[StageOutput](), list[int](), -1
    for k in range(len(recorded)):
        contact = pipeline.step(recorded.frame(k))
        if contact is not None and pipeline.delta is not None:
            scans, before = min(1.0, (k - before) / int(recorded.parts[k])), k
            seen.append(StageOutput.of(pipeline.delta, contact, scans))
            measured.append(recorded.measured_at(k, contact.stamps["sample"]))
        if k % 1000 == 999:
            print(f"followed {recorded.seconds[k]:.0f} of {recorded.seconds[-1]:.0f} s", file=sys.stderr)
    return recorded.only(measured), seen


def score(recorded: Recorded, seen: list[StageOutput]) -> dict[str, Any]:
    """Figures by section and in all, faults, notes."""
    scorer = Scorer(recorded)
    for k, said in enumerate(seen):
        scorer.add(k, said)
    scorer.finish()
    sections = {name: tally.row() for name, tally in scorer.tallies.items()}
    off_ns = recorded.sample_ns - recorded.seconds * 1e9
    return {
        "sections": sections,
        "all": all_of(scorer.tallies).row(),
        "faults": faults.rows(recorded, seen),
        "false_alarms": faults.false_alarms(recorded, seen),
        "fade_%": fade(recorded, seen),
        "sample_time_p95_ms": float(np.percentile(np.abs(off_ns), 95) * 1e-6),
        "notes": [[float(recorded.seconds[k]), section, text] for k, section, text in sorted(scorer.notes)],
    }


def fade(recorded: Recorded, seen: list[StageOutput]) -> float | None:
    """How much less the held touch's force is at its end than at its beginning, %."""
    rows = [
        (recorded.seconds[k], seen[k].contacts[0][3])
        for k in np.flatnonzero(recorded.sections == HOLD)
        if seen[k].contacts and seen[k].contacts[0][3] is not None and len(recorded.truth(int(k))) == 1
    ]
    if len(rows) < 10:
        return None
    t, force = np.array(rows, float).T
    first = force[(t > t[0] + 1) & (t < t[0] + 1 + FADE_S)].mean()
    last = force[(t > t[-1] - 1 - FADE_S) & (t < t[-1] - 1)].mean()
    return float(100 * (1 - last / first))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench tracking", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--scene", default="ten_minutes", help="a scene of the stub, or a .toml file")
    parser.add_argument("--seconds", type=real(), default=None, help="only the scene's beginning")
    parser.add_argument("--snr", type=real(), default=80.0, help="the stub's signal over noise, dB")
    parser.add_argument("--bundle", default="square16")
    parser.add_argument("--scan", choices=("full", "rolling"), default="full", help="whole scans, or scans in parts")
    parser.add_argument("--network", choices=("full", "fast", "int8", "none"), help="default: the services'")
    parser.add_argument("--seed", type=whole(0), default=4, help="of the noise")
    parser.add_argument("--notes", action="store_true", help="also say what went wrong when")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    recorded, simulated_s = record(args.scene, args.snr, args.seed, args.seconds, args.scan)
    began = time.perf_counter()
    bundle = Bundle.load(args.bundle)
    skin = Skin(port="stub", bundle=args.bundle, scan=args.scan)
    followed, seen = follow(recorded, skin.model_copy(update={"network": args.network or skin.network}), bundle)
    found = score(followed, seen)
    head = report.head(args, bundle, followed, simulated_s, time.perf_counter() - began)
    report.show(head, found, args.notes)
    report.write(args.out / f"tracking{'-rolling' * (args.scan == 'rolling')}.json", head, found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
