"""Single touches by the network, and refined: the touch's parameters fitted to the same frame.

    skin bench refined [--touches 500] [--levels none 70] [--seed 33] [--quick]

Touches are drawn as training draws them (models.scenes.TRAINING: radius 0.12 to 0.45 and, in one of five, 0.08 to 0.5;
drop 0.1 to 0.5 and 0.05 to 0.9), of all six kinds alike, and solved on the stub's mesh, which neither training nor
inverse uses. `network`: the image of the network that runs by default, a touch being what exceeds half its peak.
`found`: models/touch_fit.py with every kind, the kinds weighed by their evidence; its image is the posterior mean.
`declared`: with the kind that it was. `service`: what a contact says with `indenter = { kind = "any" }`, the fit where
it explains the frame and the image agrees, else the image; `stated`: of those, the fits alone. Prints means with their
standard errors, and how often the truth lay within the stated 68 and 90 % intervals; the images of shapes that neither
knows (bench/accuracy/odd_shapes.py). Writes refined.json.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench import REPORTS, WORK
from bench.accuracy.frames import Level
from bench.accuracy.odd_shapes import ODD, OddShape, random_odd
from bench.goals import Goal
from bench.goals import table as goal_table
from bench.json_file import write_json
from bench.machine import provenance
from models import export, metrics
from models.bundle import Bundle
from models.forward import ForwardModel
from models.npz import read_npz
from models.refine import refined_fit, responses_of, start_of
from models.scenes import TRAINING, random_scene
from models.shapes import KINDS, Array, Shape, from_rows, to_rows
from models.touch_fit import TouchPosterior, frame_errors
from protocol.frames import Contact
from services.contacts.force import Force
from services.contacts.refined import agrees, both
from services.refinement import told

SKIN, MESH, N = "square16", "stub", 96
MOST = 64 * 2**20
Row = dict[str, tuple[float, float]]
INTERVALS = {68: (1.0, 2.279), 90: (1.645, 4.605)}  # sd of one figure; squared distance of two, in sd


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


def counts(posterior: TouchPosterior, image: Array, start: Shape, unit: float) -> bool:
    """Whether the service would say the fit: the rule of its publisher."""
    if not posterior.fits_frame:
        return False
    (x, y), area = start.centroid * unit, float((image > 0.5 * image.max()).mean()) * 4 * unit**2
    seen = Contact(id=1, position=[float(x), float(y), 0.0], area_m2=area, force_n=float(image.max()))
    return agrees(seen, told(posterior, 0, unit), Force(*posterior.drop))


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
    }
    for percent, (one, two) in INTERVALS.items():
        row[f"force in {percent} %"] = 100.0 * (abs(posterior.drop[0] - touch.drop) < one * posterior.drop[1])
        row[f"position in {percent} %"] = 100.0 * (distance < two)
    return row


def measured(level: str, touches: list[Shape], clean: Array, seed: int) -> dict[str, list[Any]]:
    """method -> one row a touch."""
    bundle, noise, rng = Bundle.load(SKIN), Level(level), np.random.default_rng([seed, 7])
    pre = bundle.prereconstructor()
    path = bundle.network_path("int8")
    assert path is not None
    network = export.session(path.read_bytes())
    responses = responses_of(bundle)
    sigma = np.full(pre.measurements, noise.share)
    operator = pre.condition(sigma)
    d = clean + noise.share * np.sqrt(1 + 1 / 64) * rng.standard_normal(clean.shape)
    found: dict[str, list[Any]] = {"network": [], "found": [], "declared": [], "service": [], "stated": []}
    for one, touch in zip(track(d, description=noise.title), touches, strict=True):
        stack, context, scale = operator.stack(one)
        drop, _, logits = network.run(None, {"stack": stack[None], "context": context[None]})
        image = drop[0, 0] * scale
        mask = (image > 0.5 * image.max()).reshape(24, 4, 24, 4).mean(axis=(1, 3))
        shifted = np.exp(logits[0] - logits[0].max(axis=0))
        share = (shifted / shifted.sum(axis=0) * mask).sum(axis=(1, 2))
        found["network"].append(
            row_of(image, touch)
            | {
                "force %": 100 * abs(float(image.max()) / touch.drop - 1),
                "integral %": 100 * abs(metrics.integrated(image) / touch.integral - 1),
                "class %": 100.0 * (int(share.argmax()) == touch.shape_class),
            }
        )
        start = start_of(image)
        assert start is not None
        errors = frame_errors(pre.m.gram.astype(float), sigma, one, float(image.max()))
        for method, kinds in (("found", KINDS), ("declared", (touch.kind,))):
            began = time.perf_counter()
            posterior = refined_fit(*responses, one, errors, start, kinds)
            took = 1e3 * (time.perf_counter() - began)
            found[method].append(
                row_of(posterior.image(N), touch)
                | fitted(posterior, touch)
                | {"class %": 100.0 * (int(posterior.classes.argmax()) == touch.shape_class), "ms": took}
            )
            if method == "found":
                fits = counts(posterior, image, start, bundle.metres_per_unit)
                said = dict(found["found" if fits else "network"][-1])
                if fits:
                    named = both(posterior.classes.tolist(), (share / share.sum()).tolist())
                    said["class %"] = 100.0 * (int(np.argmax(named)) == touch.shape_class)
                found["service"].append(said | {"refined %": 100.0 * fits})
                found["stated"].append(found["found"][-1] if fits else None)
    return found


def odd(level: str, touches: list[OddShape], clean: Array, seed: int) -> dict[str, dict[str, tuple[float, float]]]:
    """What network and service say, and how often the fit counts."""
    bundle, noise, rng = Bundle.load(SKIN), Level(level), np.random.default_rng([seed, 8])
    pre, responses = bundle.prereconstructor(), responses_of(bundle)
    path = bundle.network_path("int8")
    assert path is not None
    network, sigma = export.session(path.read_bytes()), np.full(pre.measurements, noise.share)
    operator = pre.condition(sigma)
    rows: dict[str, list[dict[str, float]]] = {kind: [] for kind in ODD}
    d = clean + noise.share * np.sqrt(1 + 1 / 64) * rng.standard_normal(clean.shape)
    for one, touch in zip(track(d, description=noise.title), touches, strict=True):
        stack, context, scale = operator.stack(one)
        image = network.run(None, {"stack": stack[None], "context": context[None]})[0][0, 0] * scale
        start = start_of(image)
        assert start is not None
        posterior = refined_fit(*responses, one, frame_errors(pre.m.gram.astype(float), sigma, one, start.drop), start)
        fits, covered = counts(posterior, image, start, bundle.metres_per_unit), touch.fraction(N)
        mask = image > 0.5 * image.max()
        axis = -1 + 2 * (np.arange(N) + 0.5) / N
        centroid = np.array([(covered * a).sum() for a in (axis, axis[:, None])]) / covered.sum()
        row: dict[str, float] = {"refined %": 100.0 * fits}
        for method in ("network", "service"):
            fitted_now = fits and method == "service"
            place = posterior.position if fitted_now else start.centroid
            area = posterior.area[0] if fitted_now else 4 * float(mask.mean())
            peak = posterior.drop[0] if fitted_now else float(image.max())
            seen = posterior.image(N) if fitted_now else image
            row |= {
                f"{method}: contact IoU": metrics.iou(seen > 0.5 * seen.max(), covered > 0.5)[1],
                f"{method}: position, % of the side": 50 * float(np.linalg.norm(place - centroid)),
                f"{method}: force, %": 100 * abs(peak / touch.drop - 1),
                f"{method}: area, %": 100 * abs(area / (4 * float(covered.mean())) - 1),
            }
        rows[touch.kind].append(row)
    return {kind: summary(found, list(range(len(found)))) for kind, found in rows.items() if found}


def summary(rows: list[Any], index: list[int]) -> dict[str, tuple[float, float]]:
    """Mean and standard error of each figure; of force and integral the median, and the standard error of a median."""
    out = {}
    kept = [rows[k] for k in index if rows[k] is not None]
    for name in [n for n in kept[0] if all(n in row for row in kept)] if kept else []:
        values = np.array([row[name] for row in kept])
        error = float(values.std() / np.sqrt(len(values)))
        if name == "position %":
            out["position rms %"] = (float(np.sqrt((values**2).mean())), error)
        elif name in ("force %", "integral %"):
            low, high = np.quantile(values, (0.5 - 0.5 / np.sqrt(len(values)), 0.5 + 0.5 / np.sqrt(len(values))))
            out[name] = (float(np.median(values)), float(high - low) / 2)
        else:
            out[name] = (float(values.mean()), error)
    return out


def gains(kind: str, network: Row, service: Row) -> list[float]:
    """By how many of the network's standard errors the service is better. A perfect image of a Hertz contact is cut at
    half its peak, inside the patch that it is scored by: its place and force count.
    """
    higher = () if kind == "hertz" else ("mean IoU", "contact IoU")
    better = [(service[name][0] - network[name][0]) / max(network[name][1], 1e-9) for name in higher]
    lower = ("position rms %", "force %", "integral %")
    return better + [(network[name][0] - service[name][0]) / max(network[name][1], 1e-9) for name in lower]


def worst_odd(found: dict[str, dict[str, tuple[float, float]]]) -> float:
    """Of what a contact says: place, force, area."""
    return min(
        (row[f"network: {name}"][0] - row[f"service: {name}"][0]) / max(row[f"network: {name}"][1], 1e-9)
        for row in found.values()
        for name in ("position, % of the side", "force, %", "area, %")
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
        for percent in INTERVALS:
            for what in ("force", "position"):
                name = f"{what} in {percent} %"
                within = by_kind["all"]["found"][name][0]
                made.append(
                    Goal(f"{title}: {what} within the stated {percent} %, off by", abs(within - percent), at_most=3)
                )
        worst = min(gain for kind, row in by_kind.items() for gain in gains(kind, row["network"], row["service"]))
        made.append(Goal(f"{title}: worst row, service less network, standard errors", worst, at_least=-1.0))
        for kind, most in (("circle", 14 if level != "none" else 3), ("hertz", 14 if level != "none" else 3)):
            force = by_kind[kind]["declared"]["force %"][0]
            made.append(Goal(f"{title}: force, {kind} declared, median error, %", force, at_most=most))
    for level, found in report["odd"].items():
        title = f"{Level(level).title}, shapes that neither knows: worst row, service less network, standard errors"
        made.append(Goal(title, worst_odd(found), at_least=-1.0))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench refined", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--touches", type=int, default=None, help="500; 60 with --quick")
    parser.add_argument("--levels", nargs="+", default=["none", "70"])
    parser.add_argument("--seed", type=int, default=33)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    touches, clean = frames(args.seed, args.touches or (60 if args.quick else 500))
    report: dict[str, Any] = {"levels": {}, "touches": len(touches), **provenance("refined", argv)}
    console = Console()
    for level in args.levels:
        rows = measured(level, touches, clean, args.seed)
        report["levels"][level] = by_kind = {}
        for kind in ("all", *KINDS):
            index = [k for k, touch in enumerate(touches) if kind in ("all", touch.kind)]
            by_kind[kind] = {method: summary(found, index) for method, found in rows.items()}
            names = [n for n in by_kind[kind]["declared"] if kind == "all" or " in " not in n]
            table = Table(title=f"{Level(level).title}, {kind}: {len(index)} touches")
            for column in ("", *rows):
                table.add_column(column, justify="right" if column else "left")
            for name in names:
                cells = [by_kind[kind][method].get(name) for method in rows]
                table.add_row(name, *("" if c is None else f"{c[0]:.4g} +- {c[1]:.2g}" for c in cells))
            console.print(table)
    report["odd"] = {}
    odd_touches, odd_clean = odd_frames(args.seed, len(touches) // 5)
    for level in ("none", "70"):
        report["odd"][level] = found = odd(level, odd_touches, odd_clean, args.seed)
        table = Table(
            title=f"{Level(level).title}, shapes that neither knows: contact IoU of {len(odd_touches)} touches"
        )
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
