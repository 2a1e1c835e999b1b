"""What an ideal classifier could name: the share of shapes that noise leaves recognisable.

    skin bench shape_limit [--touches 300] [--snr 70]

Touches of the accuracy benchmark's sizes (radius 0.25 and up) make the bundle's linear model's differences, with white
noise and that of a tare; then each of the five kinds is fitted to them, and the likelihoods are integrated over place,
size, drop, rotation and aspect by Laplace's method about every optimum that is found. The kind of greatest posterior
probability is right as often as any classifier can be that knows the physics and the noise exactly. Prints the share,
its standard error and the confusions; writes shape_limit.json.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bench import REPORTS
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from models.bundle import Bundle
from models.command import real, whole
from models.prereconstruction import TARE_FRAMES
from models.scenes import TARGETS, random_shape
from models.shapes import CLASSES, Shape
from models.touch_parameters import PERIOD

Array = NDArray[np.float64]

PRIOR = replace(TARGETS, kinds=CLASSES, radius=(0.25, TARGETS.radius[1]))
ANGLES = {"L": 6}  # rotations that a fit begins at
GRID = 24  # pixels a side, the Jacobian's
# x, y, radius, drop, rotation, aspect: bounds of the fits, and the steps in which they are taken
LOW, HIGH = (-1.0, -1.0, 0.12, 0.05, -20.0, PRIOR.aspect[0]), (1.0, 1.0, 0.5, 0.6, 20.0, PRIOR.aspect[1])
STEP = (0.05, 0.05, 0.05, 0.05, 0.3, 0.1)
SAME = 0.05  # difference of the costs of two fits that found one optimum


def parameters(kind: str) -> int:
    return {"circle": 4, "rectangle": 6}.get(kind, 5)


def difference(bundle: Bundle, kind: str, p: Array) -> Array:
    """(K,) d of a touch; nearly linear in -log(1 - drop), as services/estimation/images/quality.py has it."""
    rotation, aspect = p[4] if len(p) > 4 else 0.0, p[5] if len(p) > 5 else 1.0
    touch = Shape(kind, p[0], p[1], p[2], p[3], rotation, aspect)
    log_drop = -np.log(1 - p[3]) * touch.fraction(GRID, covered=True)
    return np.asarray(bundle.matrices.jacobian @ log_drop.ravel())


def evidence(bundle: Bundle, kind: str, truth: Shape, d: Array, sigma: float) -> float:
    """Logarithm of the likelihood of d (K,), integrated over everything but the kind. truth: where fits begin."""
    n = parameters(kind)
    low, high = np.array(LOW[:n]), np.array(HIGH[:n])
    modes: list[float] = []
    total = -math.inf
    spread = [1.0, 1.0, *(np.ptp(r) / math.sqrt(12) for r in (PRIOR.radius, PRIOR.drop))]
    spread += [PERIOD.get(kind, 1.0) / math.sqrt(12), np.ptp(PRIOR.aspect) / math.sqrt(12)]
    volume = float(np.prod([2, 2, np.ptp(PRIOR.radius), np.ptp(PRIOR.drop)]))
    volume *= PERIOD.get(kind, 1.0) * (float(np.ptp(PRIOR.aspect)) if kind == "rectangle" else 1.0)
    for start in starts(kind, truth):
        fit = least_squares(
            lambda p: (difference(bundle, kind, p) - d) / sigma,
            np.clip(start[:n], low + 1e-3, high - 1e-3),
            bounds=(low, high),
            diff_step=1e-3,
            max_nfev=25,
            x_scale=STEP[:n],
        )
        if any(abs(fit.cost - other) < SAME for other in modes):
            continue
        modes.append(fit.cost)
        information = fit.jac.T @ fit.jac + np.diag(1 / np.array(spread[:n]) ** 2)
        width = 0.5 * n * math.log(2 * math.pi) - 0.5 * float(np.linalg.slogdet(information)[1])
        total = float(np.logaddexp(total, width - fit.cost - math.log(volume)))
    return total


def starts(kind: str, truth: Shape) -> Iterator[Array]:
    """Parameters that fits of a kind begin at: the truth, or the same area about the same centre, turned about."""
    if kind == truth.kind:
        yield np.array([truth.x, truth.y, truth.radius, truth.drop, truth.rotation, truth.aspect])
    covered = truth.fraction(2 * GRID, covered=True)
    axis = -1 + (np.arange(2 * GRID) + 0.5) / GRID
    x, y = (float((covered * a).sum() / covered.sum()) for a in (axis, axis[:, None]))
    turns = ANGLES.get(kind, 4) if kind in PERIOD else 1
    for aspect in (1.7, 2.3) if kind == "rectangle" else (1.0,):
        unit = Shape(kind, 0.0, 0.0, 0.5, 0.1, 0.0, aspect).fraction(2 * GRID, covered=True).sum() / 0.25
        for k in range(turns):
            angle = truth.rotation + k * PERIOD.get(kind, 0.0) / turns
            yield np.array([x, y, math.sqrt(float(covered.sum() / unit)), truth.drop, angle, aspect])


def run(touches: int, snr_db: float, seed: int) -> dict[str, Any]:
    bundle, rng = Bundle.load("square16"), np.random.default_rng(seed)
    sigma = 10 ** (-snr_db / 20) * math.sqrt(1 + 1 / TARE_FRAMES)
    confusion: Counter[tuple[str, str]] = Counter()
    for _ in range(touches):
        truth = random_shape(rng, PRIOR)
        p = np.array([truth.x, truth.y, truth.radius, truth.drop, truth.rotation, truth.aspect])
        d = difference(bundle, truth.kind, p[: parameters(truth.kind)])
        d = d + sigma * rng.standard_normal(len(d))
        found = {kind: evidence(bundle, kind, truth, d, sigma) for kind in CLASSES}
        confusion[truth.kind, max(found, key=lambda kind: found[kind])] += 1
    right = sum(n for (truth, named), n in confusion.items() if truth == named) / touches
    return {
        "touches": touches,
        "snr_db": snr_db,
        "named_right_%": 100 * right,
        "standard_error_%": 100 * math.sqrt(right * (1 - right) / touches),
        "confusion": [
            {"truth": truth, **{named: confusion[truth, named] for named in CLASSES if confusion[truth, named]}}
            for truth in CLASSES
        ],
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench shape_limit", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--touches", type=whole(), default=300)
    parser.add_argument("--snr", type=real(), default=70.0, help="dB")
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    found = run(args.touches, args.snr, args.seed)
    right, error = found["named_right_%"], found["standard_error_%"]
    print(f"an ideal classifier names {right:.0f} +- {error:.0f} % of {args.touches} shapes at {args.snr:g} dB")
    for row in found["confusion"]:
        print("  " + ", ".join(f"{key} {value}" for key, value in row.items()))
    targets = [Goal(f"shapes that an ideal classifier names, %, {args.snr:g} dB", right).to_dict()]
    write_json(args.out / "shape_limit.json", provenance("shape_limit", argv) | {"targets": targets} | found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
