"""Hypotheses and forward filter in the shadow of the checks that decide: who names which fault, and who names none?

    python -m bench.reliability.shadow --places 2

Cases are those of the fault matrix. Every STRIDE-th frame is judged by both. "right": the share of frames while the
fault was in force that name its kind; "false": of frames without a fault, the share that name any.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field

import numpy as np

from bench.reliability import matrix, workers
from bench.reliability.report import console, table_of
from bench.reliability.scenes import script
from bench.reliability.session import Session
from firmware_stub.world import Touch
from protocol.frames import ELECTRODE_STATES, DeltaFrame
from services.estimation.drift import DriftProcess
from services.estimation.hypotheses import Hypotheses
from services.estimation.posterior import ForwardFilter

STRIDE = 3
SINCE_S = 0.25  # the baseline's age, for the prior of drift
EDGE_S = 0.1  # around a fault's begin and end, in which nothing is counted
KINDS = {  # row: (kinds of hypotheses, names of the checks) that are right
    "electrode_open": ({"open", "contact"}, {"open"}),
    "electrodes_shorted": ({"short"}, {"short"}),
    "electrodes_swapped": ({"swapped"}, {"swapped"}),
    "contact rises": ({"contact", "open"}, {"drifting", "open", "electrode_drift"}),
    "mux_stuck": ({"multiplexer"}, {"stuck"}),
    "gain": ({"gain"}, {"gain"}),
    "stale_rtia": ({"gain"}, {"gain"}),
    "frozen": ({"frozen"}, {"frozen"}),
}
WELL = {"untouched", "touched"}
NAMES = ("gain", "frozen", "electrode_drift")


@dataclass
class Count:
    faulty: int = 0
    checks: int = 0  # frames under the fault that the checks name rightly
    posterior: int = 0
    single: int = 0  # the same without the filter: the frame's likeliest hypothesis
    well: int = 0
    checks_false: int = 0
    posterior_false: int = 0
    single_false: int = 0
    said: dict[str, int] = field(default_factory=dict)
    ms: list[float] = field(default_factory=list)

    def row(self) -> dict[str, object]:
        share = [100 * n / max(self.faulty, 1) for n in (self.checks, self.posterior, self.single)]
        false = [100 * n / max(self.well, 1) for n in (self.checks_false, self.posterior_false, self.single_false)]
        told = ", ".join(f"{k} {n}" for k, n in sorted(self.said.items(), key=lambda each: -each[1])[:3])
        keys = ("checks", "posterior", "single", "checks_f", "posterior_f", "single_f")
        return dict(zip(keys, [*share, *false], strict=True)) | {"ms": np.median(self.ms or [0.0]), "said": told}


COLUMNS = (
    ("right %: checks", "checks", "{:.0f}"),
    ("posterior", "posterior", "{:.0f}"),
    ("frame alone", "single", "{:.0f}"),
    ("false %: checks", "checks_f", "{:.1f}"),
    ("posterior", "posterior_f", "{:.1f}"),
    ("frame alone", "single_f", "{:.1f}"),
    ("ms a frame", "ms", "{:.0f}"),
    ("posterior said while faulty", "said", "{}"),
)


def shadow(row: matrix.Row, situation: str, touch: Touch, seed: int, count: Count) -> None:
    args = row.draw(np.random.default_rng([seed, *row.title.encode()]))
    scene = script(matrix.tracks_of(situation, touch), matrix.cues_of(row, args), matrix.contact_of(row, args))
    session = Session(workers.sheet(), scene, seed, workers.pipeline())
    pre = session.pipeline.pre
    judge, forward = Hypotheses(pre.baseline_estimator.evidence), ForwardFilter()
    prior = DriftProcess.of_skin(16, creep=False).value_covariance(SINCE_S)
    before, at = None, 0.0
    right, names = KINDS[row.title]
    n = 0
    while session.host.now < matrix.RELEASE_S + 1:
        for raw, felt in session.host.step():
            known = pre.baseline_estimator.baseline
            middle = felt.middle
            delta: DeltaFrame = session.pipeline.run(raw).delta
            z = np.abs(raw.z.astype(complex))
            n += 1
            if known is None or middle < matrix.PRESS_S or n % STRIDE:
                before = z
                continue
            sigma = known.sigma / np.maximum(known.z0, 1e-12)
            began = time.perf_counter()
            failed = (raw.status != 0) | ~np.isfinite(z)
            evidence = judge(z, known.z0, sigma, prior, before, ~failed if failed.mean() < 0.5 else None)
            chance = forward(evidence, middle - at if at else 0.05)
            count.ms.append((time.perf_counter() - began) * 1e3)
            before, at = z, middle
            alone = str(max(evidence, key=lambda name: evidence[name])[0])
            likely = str(max(chance, key=lambda name: chance[name])[0])
            told = {ELECTRODE_STATES[e] for e in delta.electrodes if e} | {r for r in delta.reasons if r in NAMES}
            edges = (matrix.FAULT_S, matrix.FAULT_END_S)
            if any(abs(middle - edge) < EDGE_S for edge in edges):
                continue
            if edges[0] < middle < edges[1]:
                count.faulty += 1
                count.checks += bool(told & names)
                count.posterior += likely in right
                count.single += alone in right
                count.said[likely] = count.said.get(likely, 0) + 1
            else:
                count.well += 1
                count.checks_false += bool(told)
                count.posterior_false += likely not in WELL
                count.single_false += alone not in WELL
    session.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=2)
    parser.add_argument("--only", nargs="+")
    args = parser.parse_args()
    found: dict[str, Count] = {}
    for row in matrix.ROWS:
        if row.title not in KINDS or (args.only and row.title not in args.only):
            continue
        for situation in matrix.SITUATIONS:
            for k, touch in enumerate(matrix.places(args.places, 5)):
                shadow(row, situation, touch, 5 + k, found.setdefault(f"{row.title}, {situation}", Count()))
        print(f"{row.title} done", file=sys.stderr, flush=True)
        workers.sheet().close()
    console().print(table_of("shadow", "fault", COLUMNS, [(name, each.row()) for name, each in found.items()]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
