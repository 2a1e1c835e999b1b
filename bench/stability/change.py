"""Small change in, small change out: how far contacts move and forces change for changes of the size of the noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from bench.stability.run import METRES, SKIN, Answer, InProcessStages, Row, Scene, Setting, noisy, share, solved
from models import fisher
from models.shapes import Array, Shape

JUMP_MM = 2.0  # for a change within noise
FLOORS = 4.0  # times what no estimator can beat: a light touch at 60 dB may move by more than JUMP_MM
LEVELS = (60.0, 70.0, 80.0)
STEPS = 24  # along the way from one noisy frame to another
DIFFERENTIATE = 0.1  # of the noise: step of a difference quotient
SLIDE_MM = 0.5


def pairs(setting: Setting) -> Iterator[Row]:
    """Two frames of one touch that differ by noise alone; Lipschitz constants of position and force."""
    runner = InProcessStages(setting.bundle)
    draws = 4 if setting.quick else 30
    for decibel in LEVELS if not setting.quick else LEVELS[1:]:
        rng, relative = setting.rng("pairs"), share(decibel)
        for k, scene in enumerate(setting.scenes()):
            baseline = runner.tare(scene.z0, relative, rng)
            clean = runner.once(baseline, scene.z)
            frames = noisy(scene.z, relative, rng, draws)
            moves = [_change(clean, runner.once(baseline, z), scene, z - scene.z) for z in frames]
            newtons = scene.touch.force(METRES)
            row: Row = {"case": f"touch {k + 1}, {decibel:g} dB", "value": decibel, "newtons": newtons}
            yield row | _worst(moves, draws, allowed(scene.touch, decibel))


def ways(setting: Setting) -> Iterator[Row]:
    """The straight way from one noisy frame to another in small steps: where the answer is not continuous it jumps."""
    runner = InProcessStages(setting.bundle)
    for decibel in (70.0, 80.0):
        rng, relative = setting.rng("ways"), share(decibel)
        worst: list[tuple[float, float]] = []
        lost = 0
        for scene in setting.scenes()[:: 4 if setting.quick else 1]:
            baseline = runner.tare(scene.z0, relative, rng)
            for _ in range(1 if setting.quick else 3):
                a, b = noisy(scene.z, relative, rng, 2)
                steps = np.linspace(0, 1, STEPS + 1)[:, None]
                seen = [runner.once(baseline, z) for z in a + steps * (b - a)]
                lost += sum(bool(p.contacts) != bool(q.contacts) for p, q in zip(seen, seen[1:], strict=False))
                worst += [_apart(p, q) for p, q in zip(seen, seen[1:], strict=False) if p.contacts and q.contacts]
        mm, newtons = (max(v) for v in zip(*worst, strict=True))
        yield {
            "case": f"{STEPS} steps of the way, {decibel:g} dB",
            "value": decibel,
            "frames": len(worst),
            "lost": lost,
            "max_mm": mm,
            "max_N": newtons,
            "broken": _jumps(mm),
        }


def derivative(setting: Setting) -> Iterator[Row]:
    """The Lipschitz constant at a touch: spectral norm of d(position)/d(d) and of d(force)/d(d), by differences."""
    runner, decibel = InProcessStages(setting.bundle), 70.0
    relative, rng = share(decibel), setting.rng("derivative")
    for k, scene in enumerate(setting.scenes()[:: 4 if setting.quick else 1]):
        baseline = runner.tare(scene.z0, relative, rng)
        at = runner.once(baseline, scene.z)
        if not at.contacts:
            continue
        step = DIFFERENTIATE * relative * scene.z
        columns = []
        for channel in range(len(scene.z)):
            z = scene.z.copy()
            z[channel] += step[channel]
            columns.append(_vector(runner.once(baseline, z)) - _vector(at))
        jacobian = np.array(columns).T / (step / scene.z0)  # rows x, y [m], force [N]; per unit of d
        size = float(np.linalg.norm(scene.z / scene.z0 - 1))
        within = float(np.linalg.norm(jacobian[:2] * relative * scene.z / scene.z0)) * 1e3
        worst = float(np.linalg.norm(jacobian[:2] * relative * scene.z / scene.z0, 2)) * 1e3
        yield {
            "case": f"touch {k + 1}, {decibel:g} dB",
            "mm_per_share": 1e3 * float(np.linalg.norm(jacobian[:2], 2)) * size,
            "N_per_share": float(np.linalg.norm(jacobian[2])) * size,
            "rms_mm": within,
            "worst_direction_mm": worst,
            "broken": {"not finite: derivative": 1} if not np.isfinite(jacobian).all() else {},
        }


def slide(setting: Setting) -> Iterator[Row]:
    """A touch moved across the skin by SLIDE_MM a frame, as a stream, noise-free and noisy: what it jumps beyond."""
    steps = 12 if setting.quick else 60
    along = (np.arange(steps) - steps / 2) * SLIDE_MM * 1e-3 / METRES
    touches = [Shape("circle", 0.8 * s + 0.1, 0.6 * s - 0.2, 0.25, 0.3) for s in along]
    scenes = solved(setting.model(), touches)
    for decibel in (np.inf, 80.0, 70.0):
        runner, rng, relative = InProcessStages(setting.bundle), setting.rng("slide"), share(decibel)
        runner.begin(runner.tare(scenes[0].z0, relative, rng))
        seen = [(runner.see(noisy(s.z, relative, rng)), s) for s in scenes]
        errors = [a.place() - METRES * s.touch.centroid for a, s in seen if a.place() is not None]  # type: ignore[operator]
        jumps = 1e3 * np.linalg.norm(np.diff(errors, axis=0), axis=1)
        force = [a.force() or 0.0 for a, _ in seen if a.contacts]
        name = "noise-free" if np.isinf(decibel) else f"{decibel:g} dB"
        yield {
            "case": f"{SLIDE_MM:g} mm a frame, {name}",
            "frames": len(seen),
            "lost": len(seen) - len(errors),
            "median_mm": float(np.median(jumps)),
            "max_mm": float(jumps.max()),
            "max_N": float(np.abs(np.diff(force)).max()),
            "broken": _jumps(float(jumps.max())),
        }


def allowed(touch: Shape, decibel: float) -> float:
    """Millimetres that a contact may move between two frames which differ by noise."""
    floor = fisher.floors(SKIN, touch, fisher.MeasurementNoise(decibel), fisher.SizePrior())["bayes"]
    return max(JUMP_MM, FLOORS * 1e3 * METRES * floor.position)


def _worst(moves: list[tuple[float, float, float]], draws: int, most_mm: float) -> Row:
    if not moves:
        return {"frames": draws, "lost": draws, "broken": {}}
    mm, newtons, change = np.array([m for m in moves if np.isfinite(m[0])] or [(np.nan,) * 3]).T
    return {
        "frames": draws,
        "lost": int(sum(not np.isfinite(m[0]) for m in moves)),
        "median_mm": float(np.median(mm)),
        "max_mm": float(mm.max()),
        "allowed_mm": most_mm,
        "max_N": float(newtons.max()),
        "mm_per_share": float((mm / change).max()),
        "N_per_share": float((newtons / change).max()),
        "broken": _jumps(float(mm.max()), most_mm),
    }


def _change(a: Answer, b: Answer, scene: Scene, by: Array) -> tuple[float, float, float]:
    """mm, N, and the change of d relative to d; infinite mm where one shows no contact."""
    change = float(np.linalg.norm(by / scene.z0) / np.linalg.norm(scene.z / scene.z0 - 1))
    if not (a.contacts and b.contacts):
        return np.inf, np.inf, change
    return (*_apart(a, b), change)


def _apart(a: Answer, b: Answer) -> tuple[float, float]:
    """mm and N between the strongest contacts of two answers."""
    difference = _vector(a) - _vector(b)
    return 1e3 * float(np.hypot(*difference[:2])), abs(float(difference[2]))


def _vector(answer: Answer) -> Array:
    """x, y [m], force [N] of the strongest contact; NaN where there is none."""
    place = answer.place()
    return np.full(3, np.nan) if place is None else np.append(place, answer.force() or 0.0)


def _jumps(mm: float, most_mm: float = JUMP_MM) -> dict[str, int]:
    return {f"a contact jumped by {mm:.1f} mm": 1} if mm > most_mm else {}


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "change within noise": pairs,
    "on the way between two noisy frames": ways,
    "derivative": derivative,
    "sliding touch": slide,
}
