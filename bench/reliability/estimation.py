"""The numbers of services/estimation/tuning.py on scenes: touches on a skin that drifted unseen, and starts.

    ./skin bench estimation drift            odds, what is left of the drift, for other numbers beside
    ./skin bench estimation start            verdicts on |Z0|, electrodes off their place too

Frames of the mesh "inverse", which is neither the bundle's nor the stub's, so that `skin bench drift`, on the stub's,
tests what was chosen here. 80 dB, baselines of 64 frames.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from services.estimation.evidence import TouchEvidence
from services.estimation.physics import SkinPhysics
from services.estimation.start import judge_start
from services.estimation.tuning import TUNING, Tuning

from models import geometry
from models.bundle import Bundle
from models.command import whole
from models.forward import ForwardModel, shared
from models.scenes import Prior, random_scene
from models.shapes import Shape

Array = NDArray[np.float64]

NOISE, FRAMES, MESH = 1e-4, 64, "inverse"
SCENES = Prior(
    radius=(0.1, 0.3), drop=(0.1, 0.5), tail=0.0, touches=(0.7, 0.2, 0.1), kinds=("circle", "hertz"), gap=0.1
)
OTHERS = {
    "as shipped": TUNING,
    **{f"misfit {misfit:g}": dataclasses.replace(TUNING, misfit=misfit) for misfit in (0.02, 0.03, 0.1)},
    "another 10": dataclasses.replace(TUNING, another=10.0),
}
PRESSES = ((0.1, 0.1), (0.3, 0.1), (0.5, 0.1), (0.1, 0.2), (0.3, 0.2), (0.5, 0.2), (0.05, 0.2))  # S/m, radius
SHIFTS = (0.0, 0.001, 0.004)  # model units, standard deviation of an electrode's place: 0, 0.05, 0.2 % of the side


def noisy(z: Array, rng: np.random.Generator, frames: int = 1) -> Array:
    return np.asarray(z * (1 + NOISE / np.sqrt(frames) * rng.standard_normal(z.shape)))


def evidence(tuning: Tuning = TUNING) -> TouchEvidence:
    bundle = Bundle.load("square16")
    skin = bundle.skin
    series = np.array(skin["contact_impedance"], float) / np.array(skin["electrodes"]["width"], float)
    return TouchEvidence(SkinPhysics.of(bundle.matrices, series_ohm=series, tuning=tuning), tuning)


def impedances(model: ForwardModel, shapes: Sequence[Shape], background: float, contact: Array | float) -> Array:
    conductivity = model.touched(list(shapes), background) if shapes else background
    return np.abs(model.solve(conductivity, model.contact_impedance * contact).impedances())


def drift(count: int, seed: int) -> None:
    model, rng = shared("square16", MESH), np.random.default_rng(seed)
    pre = Bundle.load("square16").prereconstructor()
    z0 = impedances(model, (), 1.0, 1.0)
    base, normaliser = noisy(z0, rng, FRAMES), pre.normaliser(z0)
    scenes = []
    for k in range(count):
        shapes = random_scene(rng, SCENES)
        contact = np.ones(16)
        if k % 6 >= 4:
            contact[rng.permutation(16)[: 16 if k % 6 == 4 else int(rng.integers(1, 5))]] = 1.1
        background = (0.97, 0.99, 1.01, 1.03, 1.0, 1.0)[k % 6]
        truth = (impedances(model, shapes, 1.0, 1.0) - z0) / normaliser
        pressed, free = (noisy(impedances(model, s, background, contact), rng) for s in (shapes, ()))
        scenes.append((len(shapes), truth, (pressed - base) / normaliser, (free - base) / normaliser))
    print(f"{count} scenes; |error| of d after the correction: of |d| of the touch, % (median, p90); of what is stated")
    for name, tuning in OTHERS.items():
        judge = evidence(tuning)
        error = np.diag(np.full(len(z0), NOISE**2 * (1 + 1 / FRAMES) + tuning.absolute**2))
        prior = np.diag([tuning.scale_sd**2, *[tuning.contact_sd**2] * 16])
        share, stated, right, odds, alarm = [], [], [], [], []
        for touches, truth, d, free in scenes:
            got, covariance, found = judge.corrected(d, error, judge.physics.columns(d), prior)
            off = float(np.linalg.norm(got - truth))
            share.append(100 * off / float(np.linalg.norm(truth)))
            stated.append(off / float(np.sqrt(np.trace(covariance) + len(d) * NOISE**2)))
            right.append(len(found.touches) == touches)
            odds.append(found.odds)
            alarm.append(judge(free, error, judge.physics.columns(free), prior).odds)
        print(
            f"{name:20} {np.median(share):6.2f} {np.quantile(share, 0.9):6.2f}   "
            f"{np.median(stated):5.2f} {np.quantile(stated, 0.9):5.2f}   count right "
            f"{100 * np.mean(right):3.0f} %   odds, touched {min(odds):6.1f} or more, free {max(alarm):6.1f} or less"
        )


def start(count: int, seed: int) -> None:
    rng, judge, skin = np.random.default_rng(seed), evidence(), geometry.load("square16")

    def look(model: ForwardModel, shapes: Sequence[Shape]) -> tuple[str, float]:
        z = impedances(model, shapes, 1 + 0.05 * rng.uniform(-1, 1), 1 + 0.3 * rng.uniform(-1, 1, 16))
        found = judge_start(noisy(z, rng, FRAMES), z * NOISE / np.sqrt(FRAMES), judge)
        return found.verdict.value, found.odds

    def line(name: str, seen: Sequence[tuple[str, float]]) -> None:
        odds = [o for _, o in seen]
        print(f"{name:34} odds {min(odds):8.1f} to {max(odds):8.1f} nats   {dict(Counter(v for v, _ in seen))}")

    for mesh in ("stub", MESH):
        model = shared("square16", mesh)
        line(f"{mesh}: untouched", [look(model, ()) for _ in range(count)])
        for drop, radius in PRESSES:
            places = [(x, y) for x in np.linspace(-0.6, 0.6, 7) for y in np.linspace(-0.6, 0.6, 7)]
            seen = [look(model, [Shape("circle", x, y, radius, drop)]) for x, y in places]
            line(f"{mesh}: {10 * drop:g} N, radius {radius:g}", seen)
    for shift in SHIFTS[1:]:
        models = [
            ForwardModel(skin.moved(shift * np.clip(rng.standard_normal(16), -2, 2)), skin.pattern, mesh="stub")
            for _ in range(max(count // 5, 4))
        ]
        line(f"electrodes off by {shift:g}: untouched", [look(model, ()) for model in models])
        touches = [
            Shape("circle", x, y, radius, drop) for drop, radius in PRESSES for x, y in [rng.uniform(-0.6, 0.6, 2)]
        ]
        seen = [look(model, [touches[k % len(touches)]]) for k, model in enumerate(models)]
        line(f"electrodes off by {shift:g}: touched", seen)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="skin bench estimation", description=__doc__.splitlines()[0] if __doc__ else ""
    )
    parser.add_argument("part", choices=("drift", "start"))
    parser.add_argument("--count", type=whole(), default=120, help="scenes, or untouched starts")
    parser.add_argument("--seed", type=whole(0), default=7)
    args = parser.parse_args(argv)
    (drift if args.part == "drift" else start)(args.count, args.seed)


if __name__ == "__main__":
    main()
