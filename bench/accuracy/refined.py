"""Single touches by the network, and refined: the touch's parameters fitted to the same frame (option `indenter`).

    skin bench refined [--touches 500] [--levels none 70] [--quick]

Touches are drawn as training draws them (models.scenes.TRAINING), of all six kinds alike, and solved on the stub's
mesh. `network`: the image of the network that runs by default, a touch being what exceeds half its peak. `service`:
what a contact says with `indenter = { kind = "any" }`, the fit where it explains the frame and the image agrees, else
the image. `declared`: the fit with the kind that it was. Prints means, and how often the truth lay in the stated
68 and 90 % intervals. Writes refined.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench import REPORTS, WORK
from bench.accuracy.frames import SKIN, Level
from bench.json_file import write_json
from bench.machine import provenance
from models import metrics
from models.bundle import Bundle
from models.command import whole
from models.forward import shared
from models.npz import read_npz
from models.refine import refined_fit, responses_of, start_of
from models.response_error import frame_errors
from models.scenes import TRAINING, random_scene
from models.shapes import KINDS, Array, Shape, from_rows, to_rows
from models.touch_posterior import TouchPosterior
from services.contacts.refined import both
from services.networks import Network, Stack
from services.runtime.config import Skin

MESH, N = "stub", 96
MOST = 64 * 2**20
QUICK = 24
INTERVALS = {68: (1.0, 2.279), 90: (1.645, 4.605)}  # sd of one figure; squared distance of two, in sd
METHODS = ("network", "service", "declared")


def frames(seed: int, count: int) -> tuple[list[Shape], Array]:  # and their d without noise; kept
    path = WORK / f"refined-seed{seed}-n{count}.npz"
    if not path.exists():
        rng, model = np.random.default_rng([seed, 31]), shared(SKIN, MESH)
        touches = [random_scene(rng, replace(TRAINING, kinds=(KINDS[k % 6],)), n=1)[0] for k in range(count)]
        z0 = np.abs(model.solve().impedances())
        solved = [np.abs(model.solve(model.touched([t])).impedances()) / z0 - 1 for t in track(touches)]
        WORK.mkdir(exist_ok=True)
        np.savez(path, shapes=np.array([to_rows([t]) for t in touches]), d=np.array(solved))
    kept = read_npz(path, MOST)
    return [from_rows(row)[0] for row in kept["shapes"]], np.asarray(kept["d"])


def of_image(image: Array, touch: Shape) -> dict[str, float]:
    found = metrics.score(image.astype(np.float32), [touch])
    return {
        "mean IoU": found["mean_iou"],
        "contact IoU": found["contact_iou"],
        "position %": float(metrics.of_side(np.array([found["position"]]))[0]),
        "force %": 100 * abs(float(image.max()) / touch.drop - 1),
    }


def of_fit(posterior: TouchPosterior, touch: Shape) -> dict[str, float]:
    off = posterior.position - touch.centroid
    distance = float(off @ np.linalg.solve(posterior.position_covariance, off))
    row = of_image(posterior.image(N), touch)
    row |= {"position %": 50 * float(np.linalg.norm(off)), "force %": 100 * abs(posterior.drop[0] / touch.drop - 1)}
    for percent, (one, two) in INTERVALS.items():
        row[f"force in {percent} %"] = 100.0 * (abs(posterior.drop[0] - touch.drop) < one * posterior.drop[1])
        row[f"position in {percent} %"] = 100.0 * (distance < two)
    return row


def measured(level: str, touches: Sequence[Shape], clean: Array, seed: int) -> dict[str, list[dict[str, float]]]:
    bundle, noise, rng = Bundle.load(SKIN), Level(level), np.random.default_rng([seed, 7])
    path = bundle.network_path(Skin.model_fields["network"].default)
    assert path is not None
    network, responses, pre = Network(str(path)), responses_of(bundle), bundle.prereconstructor()
    sigma = np.full(pre.measurements, noise.share)
    operator, gram = pre.condition(sigma), pre.m.gram.astype(float)
    d = clean + noise.share * np.sqrt(1 + 1 / 64) * rng.standard_normal(clean.shape)
    found: dict[str, list[dict[str, float]]] = {method: [] for method in METHODS}
    for one, touch in zip(track(d, description=noise.title), touches, strict=True):
        image, _, classes = (np.asarray(each, float) for each in network.run(Stack(*operator.stack(one))))
        mask = (image > 0.5 * image.max()).reshape(24, 4, 24, 4).mean(axis=(1, 3))
        named = (classes * mask).sum(axis=(1, 2))
        of_network = of_image(image, touch) | {"class %": 100.0 * (int(named.argmax()) == touch.shape_class)}
        start = start_of(image)
        assert start is not None
        errors = frame_errors(gram, sigma, one, float(image.max()))
        any_kind, declared = (refined_fit(*responses, one, errors, start, kinds) for kinds in (KINDS, (touch.kind,)))
        service = dict(of_network)
        if any_kind.fits_frame:
            together = both(any_kind.classes.tolist(), (named / named.sum()).tolist())
            service = of_fit(any_kind, touch) | {"class %": 100.0 * (int(np.argmax(together)) == touch.shape_class)}
        found["network"].append(of_network)
        found["service"].append(service | {"refined %": 100.0 * any_kind.fits_frame})
        found["declared"].append(of_fit(declared, touch))
    return found


def means(rows: Sequence[dict[str, float]]) -> dict[str, tuple[float, float]]:
    """Mean and standard error of each figure, of the rows that have it; of force the median."""
    made = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        values = np.array([row[name] for row in rows if name in row])
        middle = np.median(values) if name == "force %" else values.mean()
        made[name] = float(middle), float(values.std() / np.sqrt(len(values)))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench refined", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--touches", type=whole(), help=f"500; {QUICK} with --quick")
    parser.add_argument("--levels", nargs="+", default=["none", "70"], choices=("none", "50", "60", "70", "80"))
    parser.add_argument("--seed", type=whole(0), default=33)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    touches, clean = frames(args.seed, args.touches or (QUICK if args.quick else 500))
    levels: dict[str, dict[str, Any]] = {}
    for level in args.levels:
        levels[level] = {m: means(rows) for m, rows in measured(level, touches, clean, args.seed).items()}
        table = Table(title=f"{Level(level).title}: {len(touches)} touches", title_justify="left")
        for column in ("", *METHODS):
            table.add_column(column, justify="right" if column else "left")
        for name in levels[level]["service"]:
            cells = [levels[level][method].get(name) for method in METHODS]
            table.add_row(name, *("" if c is None else f"{c[0]:.4g} +- {c[1]:.2g}" for c in cells))
        Console().print(table)
    write_json(args.out / "refined.json", provenance("refined", argv) | {"levels": levels})
    print(f"wrote {args.out / 'refined.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
