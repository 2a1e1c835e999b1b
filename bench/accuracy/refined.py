"""Single touches by the network, and refined: the touch's parameters fitted to the same frame.

    skin bench refined [--touches 500] [--levels none 70] [--seed 33] [--quick] [--coverage-touches 300]

Touches are drawn as training draws them (models.scenes.TRAINING: radius 0.12 to 0.45 and, in one of five, 0.08 to 0.5;
drop 0.1 to 0.5 and 0.05 to 0.9), of all six kinds alike, and solved on the stub's mesh, which neither training nor
inverse uses. `network`: the image of the network that runs by default, a touch being what exceeds half its peak.
`found`: models/touch_fit.py with every kind, the kinds weighed by their evidence; its image is the posterior mean.
`declared`: with the kind that it was. `service`: what a contact says with `indenter = { kind = "any" }`, the fit where
it explains the frame and the image agrees, else the image; its IoU are of the posterior's mean image, which no frame
carries, its outline IoU of the outline that shape frames carry; `stated`: of those, the fits alone; `symmetry`: the
image as the mean over the square's symmetries. Prints means with their standard errors; at 60, 70 and 80 dB and without
noise, how often the truth lay within the stated 68 and 90 % intervals of the service; how far the stated probability of
a shape is from how often it is right (expected calibration error); shapes that neither knows
(bench/accuracy/odd_shapes.py). Writes refined.json.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench import REPORTS, WORK
from bench.accuracy.frames import NOISE_FREE, Level
from bench.accuracy.intervals import (
    INTERVALS,
    by_kinds,
    class_error,
    counted,
    coverage,
    coverage_table,
    pixels,
    summary,
)
from bench.accuracy.odd_shapes import ODD, OddShape, random_odd
from bench.accuracy.symmetric import ldci, pictures
from bench.goals import Goal
from bench.goals import table as goal_table
from bench.json_file import write_json
from bench.machine import provenance
from models import metrics
from models.bundle import Bundle
from models.command import whole
from models.forward import ForwardModel
from models.npz import read_npz
from models.refine import refined_fit, responses_of, start_of
from models.response_error import frame_errors
from models.scenes import TRAINING, random_scene
from models.shapes import KINDS, Array, Shape, from_rows, to_rows
from models.touch_posterior import TouchPosterior
from protocol.frames import Contact
from services.contacts.contact_writer import ContactWriter
from services.contacts.force.curve import Curve
from services.contacts.force.law import ForceLaw
from services.contacts.refined import area_of_image, both
from services.contacts.surface import Placement, Plane
from services.networks import Network
from services.refinement import told

SKIN, MESH, N = "square16", "stub", 96
MOST = 64 * 2**20
Row = dict[str, tuple[float, float]]
COVERAGE_ALSO = ("60", "80")  # noise levels of which intervals alone are looked at
WRITER = ContactWriter(ForceLaw(Curve(1.0), reads="peak"), Placement(Plane()), tells_force=True)
METHODS = ("network", "found", "declared", "service", "stated", "symmetry")


def frames(seed: int, count: int) -> tuple[list[Shape], Array]:
    """Touches, and their d (count, K) without noise; kept in bench/work."""
    path = WORK / f"refined-seed{seed}-n{count}.npz"
    if path.exists():
        kept = read_npz(path, MOST)
        return [from_rows(row)[0] for row in kept["shapes"]], np.asarray(kept["d"])
    rng, model = np.random.default_rng([seed, 31]), ForwardModel(SKIN, mesh=MESH)
    touches = [random_scene(rng, replace(TRAINING, kinds=(KINDS[k % 6],)), n=1)[0] for k in range(count)]
    z0 = np.abs(model.solve().impedances())
    solved = [np.abs(model.solve(model.touched([t])).impedances()) / z0 - 1 for t in track(touches, description=MESH)]
    WORK.mkdir(exist_ok=True)
    np.savez(path, shapes=np.array([to_rows([t]) for t in touches]), d=np.array(solved))
    return touches, np.array(solved)


def odd_frames(seed: int, count: int) -> tuple[list[OddShape], Array]:
    """The same of shapes that nobody knows; kept in bench/work."""
    rng = np.random.default_rng([seed, 32])
    touches = [random_odd(rng, ODD[k % len(ODD)]) for k in range(count)]
    path = WORK / f"refined-odd-seed{seed}-n{count}.npz"
    if not path.exists():
        model = ForwardModel(SKIN, mesh=MESH)
        z0 = np.abs(model.solve().impedances())
        solved = [np.abs(model.solve(t.conductivity(model)).impedances()) / z0 - 1 for t in track(touches)]
        WORK.mkdir(exist_ok=True)
        np.savez(path, d=np.array(solved))
    return touches, np.asarray(read_npz(path, MOST)["d"])


def said(posterior: TouchPosterior, image: Array, start: Shape, unit: float) -> Contact | None:
    """The contact as the service's publisher has it of the fit; None where it says the image's. The force law is 1 N/S,
    so the force is the drop.
    """
    if not posterior.fits_frame:
        return None
    (x, y), area = start.centroid * unit, float((image > 0.5 * image.max()).mean()) * 4 * unit**2
    seen = Contact(id=1, position=[float(x), float(y), 0.0], area_m2=area, force_n=float(image.max()))
    return WRITER.fitted(seen, told(posterior, 0, unit))


def outlined(shown: Array, covered: Array) -> float:
    """Contact IoU of what a shape frame draws, as a mask (N, N), and of the patch that is touched."""
    return metrics.iou(shown > 0.5, covered > 0.5)[1]


def drawn(posterior: TouchPosterior, image: Array) -> Array:
    """(N, N) the touch as the shape frame of a refined contact draws it: what exceeds 0.5."""
    if area_of_image(told(posterior, 0, 1.0)):
        return np.asarray(image / image.max())
    return posterior.fits[0].shape.fraction(N, covered=True)


def row_of(image: Array, touch: Shape) -> dict[str, float]:
    found = metrics.score(image.astype(np.float32), [touch])
    return {
        "mean IoU": found["mean_iou"],
        "contact IoU": found["contact_iou"],
        "position %": float(metrics.of_side(np.array([found["position"]]))[0]),
    }


def fitted(posterior: TouchPosterior, touch: Shape) -> dict[str, float]:
    """Figures that a posterior alone has, and whether the truth is in its intervals."""
    off = posterior.position - touch.centroid
    distance = float(off @ np.linalg.solve(posterior.position_covariance, off))
    row = {
        "position %": 50 * float(np.linalg.norm(off)),
        "force %": 100 * abs(posterior.drop[0] / touch.drop - 1),
        "integral %": 100 * abs(posterior.integral[0] / touch.integral - 1),
        "area %": 100 * abs(posterior.area[0] / touch.area - 1),
    }
    for percent, (one, two) in INTERVALS.items():
        row[f"force in {percent} %"] = 100.0 * (abs(posterior.drop[0] - touch.drop) < one * posterior.drop[1])
        row[f"position in {percent} %"] = 100.0 * (distance < two)
    return row


def stated(contact: Contact, touch: Shape, unit: float) -> dict[str, float]:
    """Of what a contact says where image and fit are weighed: force and area."""
    force, sigma = contact.force_n, contact.force_sigma_n
    assert force is not None and sigma is not None
    off = abs(force - touch.drop)
    row = {"force %": 100 * off / touch.drop, "area %": 100 * abs(contact.area_m2 / unit**2 / touch.area - 1)}
    return row | {f"force in {percent} %": 100.0 * (off < one * sigma) for percent, (one, _) in INTERVALS.items()}


def shipped() -> Path:
    """The network that runs by default."""
    path = Bundle.load(SKIN).network_path("int8")
    assert path is not None
    return path


def measured(
    level: str, touches: list[Shape], clean: Array, seed: int, methods: tuple[str, ...] = METHODS
) -> dict[str, list[Any]]:
    """method -> one row a touch."""
    bundle, noise, rng = Bundle.load(SKIN), Level(level), np.random.default_rng([seed, 7])
    pre = bundle.prereconstructor()
    network = Network(str(shipped()))
    responses = responses_of(bundle)
    sigma = np.full(pre.measurements, noise.share)
    operator = pre.condition(sigma)
    d = clean + noise.share * np.sqrt(1 + 1 / 64) * rng.standard_normal(clean.shape)
    found: dict[str, list[Any]] = {method: [] for method in methods}
    for one, touch in zip(track(d, description=noise.title), touches, strict=True):
        made = operator.stack(one)
        for method in ("symmetry", "network"):
            if method not in methods:
                continue
            image, spread, classes = pictures(network, made, method == "symmetry")
            mask = (image > 0.5 * image.max()).reshape(24, 4, 24, 4).mean(axis=(1, 3))
            share = (classes * mask).sum(axis=(1, 2))
            found[method].append(
                row_of(image, touch)
                | {
                    "force %": 100 * abs(float(image.max()) / touch.drop - 1),
                    "integral %": 100 * abs(metrics.integrated(image) / touch.integral - 1),
                    "area %": 100 * abs(4 * float((image > 0.5 * image.max()).mean()) / touch.area - 1),
                    "class %": 100.0 * (int(share.argmax()) == touch.shape_class),
                    "outline IoU": outlined(image / image.max(), touch.fraction(N, covered=True)),
                }
                | pixels(image, spread, touch)
            )
        start = start_of(image)
        assert start is not None
        errors = frame_errors(pre.m.gram.astype(float), sigma, one, float(image.max()))
        for method, kinds in (("found", KINDS), ("declared", (touch.kind,))):
            if method not in methods:
                continue
            began = time.perf_counter()
            posterior = refined_fit(*responses, one, errors, start, kinds)
            took = 1e3 * (time.perf_counter() - began)
            found[method].append(
                row_of(posterior.image(N), touch)
                | fitted(posterior, touch)
                | {"class %": 100.0 * (int(posterior.classes.argmax()) == touch.shape_class), "ms": took}
            )
            if method == "found":
                contact = said(posterior, image, start, bundle.metres_per_unit)
                row = dict(found["network" if contact is None else "found"][-1])
                named = (share / share.sum()).tolist()
                if contact is not None:
                    named = both(posterior.classes.tolist(), named)
                    row["class %"] = 100.0 * (int(np.argmax(named)) == touch.shape_class)
                    row |= stated(contact, touch, bundle.metres_per_unit)
                    row["outline IoU"] = outlined(drawn(posterior, image), touch.fraction(N, covered=True))
                row["class stated %"] = 100 * max(named)
                found["service"].append(row | {"refined %": 100.0 * (contact is not None)})
                found["stated"].append(None if contact is None else row)
    return found


def consistency() -> dict[str, float]:
    """LDCI noise-free; found: every kind fitted; declared: a circle alone."""
    bundle = Bundle.load(SKIN)
    pre, responses = bundle.prereconstructor(), responses_of(bundle)
    sigma, gram = np.full(pre.measurements, NOISE_FREE), pre.m.gram.astype(float)

    def refined(d: Array, image: Array, kinds: tuple[str, ...] = KINDS) -> float:
        start = start_of(image)
        assert start is not None
        return refined_fit(*responses, d, frame_errors(gram, sigma, d, start.drop), start, kinds).drop[0]

    declared: Callable[[Array, Array], float] = partial(refined, kinds=("circle",))
    fits = {"found": refined, "declared": declared}
    return ldci(Network(str(shipped())), bundle, MESH, sigma, fits)


def odd(level: str, touches: list[OddShape], clean: Array, seed: int) -> dict[str, dict[str, tuple[float, float]]]:
    """What network and service say, and how often the fit counts."""
    bundle, noise, rng = Bundle.load(SKIN), Level(level), np.random.default_rng([seed, 8])
    pre, responses = bundle.prereconstructor(), responses_of(bundle)
    network, sigma = Network(str(shipped())), np.full(pre.measurements, noise.share)
    operator = pre.condition(sigma)
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in ODD}
    d = clean + noise.share * np.sqrt(1 + 1 / 64) * rng.standard_normal(clean.shape)
    for one, touch in zip(track(d, description=noise.title), touches, strict=True):
        image = pictures(network, operator.stack(one))[0]
        start = start_of(image)
        assert start is not None
        posterior = refined_fit(*responses, one, frame_errors(pre.m.gram.astype(float), sigma, one, start.drop), start)
        contact, covered = said(posterior, image, start, bundle.metres_per_unit), touch.fraction(N)
        mask = image > 0.5 * image.max()
        axis = -1 + 2 * (np.arange(N) + 0.5) / N
        centroid = np.array([(covered * a).sum() for a in (axis, axis[:, None])]) / covered.sum()
        row: dict[str, float] = {"refined %": 100.0 * (contact is not None)}
        for method in ("network", "service"):
            place, area, peak, shown = start.centroid, 4 * float(mask.mean()), float(image.max()), image / image.max()
            if method == "service" and contact is not None:
                area, peak = contact.area_m2 / bundle.metres_per_unit**2, contact.force_n or 0.0
                place, shown = posterior.position, drawn(posterior, image)
            row |= {
                f"{method}: outline IoU": outlined(shown, covered),
                f"{method}: position, % of the side": 50 * float(np.linalg.norm(place - centroid)),
                f"{method}: force, %": 100 * abs(peak / touch.drop - 1),
                f"{method}: area, %": 100 * abs(area / (4 * float(covered.mean())) - 1),
            }
        rows[touch.kind].append(row)
    return {kind: summary(found, list(range(len(found)))) for kind, found in rows.items() if found}


def gains(kind: str, network: Row, service: Row) -> list[float]:
    """By how many standard errors of the difference the service is better. A perfect image of a Hertz contact is cut at
    half its peak, inside the patch that it is scored by: its outline counts, and not its image.
    """
    higher = ("outline IoU", "class %", *(() if kind == "hertz" else ("mean IoU", "contact IoU")))
    lower = ("position rms %", "force %", "integral %", "area %")
    return [better(service[name], network[name]) for name in higher] + [
        better(network[name], service[name]) for name in lower
    ]


def better(more: tuple[float, float], less: tuple[float, float]) -> float:
    """more - less in standard errors; 0 where both are known exactly, and the same."""
    off, error = more[0] - less[0], math.hypot(more[1], less[1])
    return off / error if error else 0.0


def worst_odd(found: dict[str, dict[str, tuple[float, float]]]) -> float:
    """Of what contact and shape frames say: place, force, area, outline."""
    lower = ("position, % of the side", "force, %", "area, %")
    return min(
        min(better(row["service: outline IoU"], row["network: outline IoU"]) for row in found.values()),
        min(better(row[f"network: {n}"], row[f"service: {n}"]) for row in found.values() for n in lower),
    )


def goals(report: dict[str, Any], quick: bool) -> list[Goal]:
    made = []
    for level, by_kind in report["levels"].items():
        network, found = by_kind["all"]["network"], by_kind["all"]["found"]
        mean, contact = (0.955, 0.91) if level == "none" else (0.888, 0.785)
        title = Level(level).title
        made += [
            Goal(f"{title}: mean IoU, refined", found["mean IoU"][0], at_least=mean),
            Goal(f"{title}: contact IoU, refined", found["contact IoU"][0], at_least=contact),
            Goal(
                f"{title}: shape class, refined, %",
                by_kind["all"]["service"]["class %"][0],
                at_least=98.5 if level == "none" else 77,
            ),
            Goal(
                f"{title}: contact IoU, refined less network",
                found["contact IoU"][0] - network["contact IoU"][0],
                at_least=0.0,
                gate=-0.02 if quick else 0.0,
            ),
        ]
        worst = min(gain for kind, row in by_kind.items() for gain in gains(kind, row["network"], row["service"]))
        made.append(Goal(f"{title}: worst row, service less network, standard errors", worst, at_least=-1.0))
        for kind, most in (("circle", 14 if level != "none" else 3), ("hertz", 14 if level != "none" else 3)):
            force = by_kind[kind]["declared"]["force %"][0]
            made.append(Goal(f"{title}: force, {kind} declared, median error, %", force, at_most=most))
        error = report["class_calibration_error"][level]
        made.append(Goal(f"{title}: expected calibration error of the shape class", error, at_most=0.05))
    for level, by_kind in report["coverage"].items():
        for what in ("position", "force", "pixels"):
            for percent in INTERVALS:
                off = abs(by_kind["all"][f"{what} in {percent} %"][0] - percent)
                made.append(Goal(f"{Level(level).title}: {what} in the stated {percent} %, off by", off, at_most=3))
    made += [
        Goal(f"noise-free: LDCI, {name}", report["ldci"][method], at_most=0.012)
        for method, name in (("symmetry", "mean over the symmetries"), ("declared", "refined, kind declared"))
    ]
    for level, found in report["odd"].items():
        title = f"{Level(level).title}, shapes that neither knows: worst row, service less network, standard errors"
        made.append(Goal(title, worst_odd(found), at_least=-1.0))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench refined", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--touches", type=whole(), default=None, help="500; 60 with --quick")
    parser.add_argument("--levels", nargs="+", default=["none", "70"])
    parser.add_argument("--coverage-touches", type=whole(), default=None, help="at 60 and 80 dB: 300; 12 with --quick")
    parser.add_argument("--seed", type=whole(0), default=33)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    touches, clean = frames(args.seed, args.touches or (60 if args.quick else 500))
    report: dict[str, Any] = {"levels": {}, "class_calibration_error": {}, "touches": len(touches)}
    report |= provenance("refined", argv)
    console = Console()
    for level in args.levels:
        rows = measured(level, touches, clean, args.seed)
        report["levels"][level] = by_kind = by_kinds(rows, touches)
        report["class_calibration_error"][level] = class_error(rows["service"])
        for kind, row in by_kind.items():
            names = [n for n in row["declared"] if " in " not in n]
            table = Table(title=f"{Level(level).title}, {kind}: {counted(kind, touches)} touches")
            for column in ("", *rows):
                table.add_column(column, justify="right" if column else "left")
            for name in names:
                cells = [row[method].get(name) for method in rows]
                table.add_row(name, *("" if c is None else f"{c[0]:.4g} +- {c[1]:.2g}" for c in cells))
            console.print(table)
    report["ldci"] = consistency()
    said_of = ", ".join(f"{name} {value:.4f}" for name, value in report["ldci"].items())
    console.print(f"LDCI noise-free, drop 0.15, radius 0.2: {said_of}")
    some = touches[: args.coverage_touches or (12 if args.quick else 300)]
    levels = dict(report["levels"])
    for level in COVERAGE_ALSO:
        if level not in levels:
            rows = measured(level, some, clean[: len(some)], args.seed, ("network", "found", "service", "stated"))
            levels[level] = by_kinds(rows, some)
    report["coverage"] = coverage(levels)
    console.print(coverage_table(report["coverage"]))
    report["odd"] = {}
    odd_touches, odd_clean = odd_frames(args.seed, len(touches) // 5)
    for level in ("none", "70"):
        report["odd"][level] = found = odd(level, odd_touches, odd_clean, args.seed)
        table = Table(title=f"{Level(level).title}, shapes that neither knows: {len(odd_touches)} touches")
        for column in ("", *found):
            table.add_column(column, justify="right" if column else "left")
        for name in next(iter(found.values())):
            table.add_row(name, *(f"{found[kind][name][0]:.3g} +- {found[kind][name][1]:.2g}" for kind in found))
        console.print(table)
    made = goals(report, args.quick)
    report["targets"] = [goal.to_dict() for goal in made]
    console.print(goal_table(made))
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "refined.json", report)
    console.print(f"wrote {args.out / 'refined.json'}")
    return 0 if all(goal.passed for goal in made) else 1


if __name__ == "__main__":
    raise SystemExit(main())
