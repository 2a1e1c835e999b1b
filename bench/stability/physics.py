"""Stability against what a skin, a board and a mesh may be: noise, scale, background, contacts, electrodes, meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.stability.run import (
    SKIN,
    TOUCHES,
    Answer,
    InProcessStages,
    Row,
    Scene,
    Setting,
    mean_iou,
    noisy,
    share,
    solved,
    summary,
)
from models import geometry, meshing, metrics
from models.forward import ForwardModel
from models.linearise import linearise
from models.prereconstruction import Operator, PreReconstructor
from models.shapes import Array, Shape
from services.estimation.first.baseline import NoBaseline

USUAL_DB = 70.0
SPACING = 0.5  # model units between neighbouring electrodes of a side
GRADINGS = {  # coarse to fine, between them the meshes that the project uses
    "coarsest": meshing.Grading(edge=2e-2, growth=0.6, interior=0.12, offset=0.11),
    "coarser": meshing.Grading(edge=8e-3, growth=0.55, interior=0.08, offset=0.47),
    "coarse": meshing.Grading(edge=4e-3, growth=0.5, interior=0.06, offset=0.29),
    "inverse": meshing.USES["inverse"],
    "stub": meshing.USES["stub"],
    "training": meshing.USES["training"],
    "fine": meshing.Grading(edge=2e-4, growth=0.28, interior=0.021, offset=0.53),
}
Images = NDArray[np.floating]
LAMBDAS = 10.0 ** np.arange(-8, 1.01, 0.5)


def answers(
    runner: InProcessStages,
    scenes: Sequence[Scene],
    relative: float | Array,
    rng: np.random.Generator,
    draws: int,
    scale: float = 1.0,
) -> list[tuple[Answer, Shape | None]]:
    """`draws` noisy frames of each scene against a noisy tare of its own skin; a tare refused is a frame not valid."""
    found: list[tuple[Answer, Shape | None]] = []
    for scene in scenes:
        try:
            baseline = runner.tare(scale * scene.z0, relative, rng)
        except NoBaseline as why:
            found += [(Answer(reasons=(f"tare refused: {why}",)), scene.touch)] * draws
            continue
        for _ in range(draws):
            found.append((runner.once(baseline, scale * noisy(scene.z, relative, rng)), scene.touch))
    return found


def snr(setting: Setting) -> Iterator[Row]:
    """Noise on each measurement and on the tare."""
    runner, rng = InProcessStages(setting.bundle), setting.rng("snr")
    draws = 2 if setting.quick else 12
    for decibel in (30, 40, 50, 60, 70, 80, 90, 100) if not setting.quick else (30, 50, 70, 100):
        found = answers(runner, setting.scenes(), share(decibel), rng, draws)
        yield {"case": f"{decibel} dB", "value": decibel, **summary(found, doubtful=True)}


def few(setting: Setting) -> Iterator[Row]:
    """A few measurements far noisier than the others, in the tare too: they should cost little."""
    runner, rng = InProcessStages(setting.bundle), setting.rng("few")
    for count in (0, 1, 5, 20) if not setting.quick else (1, 5):
        for factor in (10.0, 100.0, 1000.0) if count and not setting.quick else (100.0,):
            found = []
            for scene in setting.scenes():
                relative = np.full(len(scene.z), share(USUAL_DB))
                relative[rng.permutation(len(relative))[:count]] *= factor
                found += answers(runner, [scene], relative, rng, 1 if setting.quick else 4)
            yield {"case": f"{count} x {factor:g}", "value": factor, "kind": f"{count} measurements", **summary(found)}


def scale(setting: Setting) -> Iterator[Row]:
    """The unit of the measurements: what divides out must make no difference."""
    runner = InProcessStages(setting.bundle)
    for exponent in (-9, -6, -3, 0, 3, 6, 9) if not setting.quick else (-9, 0, 9):
        rng = setting.rng("scale")  # the same noise for every unit
        found = answers(runner, setting.scenes(), share(USUAL_DB), rng, 1 if setting.quick else 4, 10.0**exponent)
        yield {"case": f"x 1e{exponent:+d}", "value": 10.0**exponent, **summary(found)}


def background(setting: Setting) -> Iterator[Row]:
    """The untouched sheet's conductivity, tared there; a touch takes the same share of it."""
    model, runner, rng = setting.model(), InProcessStages(setting.bundle), setting.rng("background")
    values = (0.2, 0.35, 0.6, 1.0, 1.7, 3.0, 5.0) if not setting.quick else (0.2, 5.0)
    touches = TOUCHES if not setting.quick else TOUCHES[1:5]
    for value in values:
        for decibel in (USUAL_DB, np.inf):
            found = answers(runner, solved(model, touches, value), share(decibel), rng, 1 if setting.quick else 6)
            yield {"case": f"{value:g} S/m, {_decibel(decibel)}", "value": value, "dB": decibel, **summary(found)}


def contact(setting: Setting) -> Iterator[Row]:
    """Contact impedance of all electrodes, and of each by chance, tared there."""
    model, runner, rng = setting.model(), InProcessStages(setting.bundle), setting.rng("contact")
    nominal = model.contact_impedance
    touches = TOUCHES if not setting.quick else TOUCHES[1:5]
    cases = [(f"x {f:g}", f, f * nominal) for f in ((0.1, 0.3, 1.0, 3.0, 10.0) if not setting.quick else (0.1, 10.0))]
    cases.append(("each x 0.1 to 10", np.nan, nominal * 10.0 ** rng.uniform(-1, 1, len(nominal))))
    for name, factor, impedance in cases:
        scenes = solved(model, touches, contact_impedance=impedance)
        for decibel in (USUAL_DB, np.inf):
            found = answers(runner, scenes, share(decibel), rng, 1 if setting.quick else 6)
            yield {"case": f"{name}, {_decibel(decibel)}", "value": factor, "dB": decibel, **summary(found)}


def electrodes(setting: Setting) -> Iterator[Row]:
    """Electrodes mounted off by a share of their spacing (standard deviation), unknown to the bundle."""
    runner, rng = InProcessStages(setting.bundle), setting.rng("electrodes")
    skin = geometry.load(SKIN)
    for percent in (1, 2, 3, 5) if not setting.quick else (5,):
        found = []
        for _ in range(1 if setting.quick else 2):
            moved = skin.moved(0.01 * percent * SPACING * rng.standard_normal(skin.n_electrodes))
            model = ForwardModel(moved, mesh="stub" if not setting.quick else "inverse")
            found += answers(runner, solved(model), share(USUAL_DB), rng, 1)
        yield {"case": f"{percent} % of the spacing", "value": percent, **summary(found, doubtful=True)}


def meshes(setting: Setting) -> Iterator[Row]:
    """The data's mesh from coarse to fine, noise-free: differences and answers against those of the finest."""
    runner = InProcessStages(setting.bundle)
    names = list(GRADINGS) if not setting.quick else ["coarsest", "coarse", "stub"]
    found, told = {}, {}
    for name in names:
        model = setting.model("stub") if name == "stub" else ForwardModel(SKIN, mesh=GRADINGS[name])
        found[name] = setting.scenes() if name == "stub" else solved(model)
        told[name] = model.n_elements
    finest = found[names[-1]]
    reached = [a for a, _ in answers(runner, finest, share(np.inf), setting.rng("meshes"), 1)]
    for name in names:
        pairs = answers(runner, found[name], share(np.inf), setting.rng("meshes"), 1)
        relative = [
            _norm(a.z / a.z0 - b.z / b.z0) / _norm(b.z / b.z0 - 1) for a, b in zip(found[name], finest, strict=True)
        ]
        places = [(a.place(), b.place()) for (a, _), b in zip(pairs, reached, strict=True)]
        moved = [1e3 * _norm(p - q) for p, q in places if p is not None and q is not None]
        yield {
            "case": f"{name}, {told[name]} elements",
            "value": told[name],
            "difference_%": 100 * float(np.mean(relative)) if name != names[-1] else None,
            "against_finest_mm": float(np.mean(moved)) if moved else None,
            **summary(pairs),
        }


def two_meshes(setting: Setting) -> Iterator[Row]:
    """Mesh of the data against mesh of the inverse, noise-free: where both are the same the error looks too small."""
    names = ("inverse", "stub", "training") if not setting.quick else ("inverse", "stub")
    data = {name: setting.scenes() if name == "stub" else solved(setting.model(name)) for name in names}
    shipped = setting.bundle.matrices
    for inverse in names:
        made = linearise(setting.model(inverse), model_error=shipped.model_error)
        bundle = replace(setting.bundle, matrices=replace(made, level=shipped.level, ladder=shipped.ladder))
        for network in ("full", "none"):
            if network == "full" and bundle.network_path() is None:
                continue
            runner = InProcessStages(bundle, network)
            for name in names:
                pairs = answers(runner, data[name], share(np.inf), setting.rng("two"), 1)
                kind = "network" if network == "full" else "one-step"
                yield {
                    "case": f"{kind}: data {name}, inverse {inverse}",
                    "value": float(name == inverse),
                    **summary(pairs),
                }


def lambdas(setting: Setting) -> Iterator[Row]:
    """The one-step image for lambda from 1e-8 to 10 by the bundle's own matrices; amplitude from one centred touch."""
    shipped = setting.bundle.matrices
    wide = replace(shipped, ladder=LAMBDAS**2, level=np.ones(len(LAMBDAS)), scale_index=0)
    pre = PreReconstructor(wide)
    scenes, rng = setting.scenes(), setting.rng("lambda")
    draws = 2 if setting.quick else 10
    for decibel in (USUAL_DB, np.inf):
        relative = share(decibel)
        operator = pre.condition(np.full(pre.measurements, relative))

        def images(scene: Scene, operator: Operator = operator, relative: float = relative) -> Images:
            d = pre.difference(noisy(scene.z, relative, rng), noisy(scene.z0, relative / 8, rng))
            return np.asarray(operator.images(d[None])).reshape(len(LAMBDAS), *operator.shape)

        made = [(scene.touch, images(scene)) for scene in scenes for _ in range(draws)]
        centre = pre.difference(scenes[0].z, scenes[0].z0)
        gain = scenes[0].touch.drop / operator.images(centre[None])[0].max(axis=1)
        for k, value in enumerate(LAMBDAS):
            yield {
                "case": f"lambda {value:.1e}, {_decibel(decibel)}",
                "value": float(value),
                "dB": decibel,
                **_of_images([(touch, gain[k] * image[k]) for touch, image in made]),
            }


def _of_images(pairs: Sequence[tuple[Shape, Images]]) -> Row:
    """Errors of plain images; broken where one is not finite."""
    bad = sum(not np.isfinite(image).all() for _, image in pairs)
    good = [(touch, np.asarray(image, float)) for touch, image in pairs if np.isfinite(image).all()]
    position = [metrics.position_error(metrics.touch_masks(image, [touch])[0], touch) for touch, image in good]
    force = [float(metrics.relative_error(image.max(), touch.drop)) for touch, image in good]
    return {
        "frames": len(pairs),
        "position_%": float(metrics.of_side(position).mean()) if good else None,
        "position_max_%": float(metrics.of_side(position).max()) if good else None,
        "force_%": float(np.mean(force)) if good else None,
        "mean_iou": float(np.mean([mean_iou(image, touch) for touch, image in good])) if good else None,
        "broken": {"not finite: image": bad} if bad else {},
    }


def _norm(v: Array) -> float:
    return float(np.linalg.norm(v))


def _decibel(decibel: float) -> str:
    return "noise-free" if np.isinf(decibel) else f"{decibel:g} dB"


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "lambda": lambdas,
    "signal over noise": snr,
    "a few noisy measurements": few,
    "measurement scale": scale,
    "background": background,
    "contact impedance": contact,
    "electrode positions": electrodes,
    "meshes, coarse to fine": meshes,
    "mesh of the data, mesh of the inverse": two_meshes,
}
