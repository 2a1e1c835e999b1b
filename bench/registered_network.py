"""A registered skin's network beside the likelihood of its presses and the image without a network, on real presses:
`.venv/bin/python -m bench.registered_network FILE FOLDER`.

FOLDER is what `skin register FILE --presses N --out FOLDER` wrote and `make train SKIN=FOLDER` trained; the presses
that follow the first N of FILE took no part in either. Positions of single presses, and of two at once: sums of the
differences of two presses, since no file has real ones. What two touches do to each other is not in them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, BundleError
from models.locator import Locator
from models.prereconstruction import Operator
from services.calibration.locating import true_places
from services.calibration.presses import Presses, RegistrationError, part, read_presses
from services.calibration.registration import Similarity
from services.contacts.images.segmentation import Segment, segment
from services.networks import Network, network, softmax
from services.recordings.npz_file import InputError, load_npz

Array = NDArray[np.float64]
Places = Callable[[Array], Array]  # (K,) difference -> (n, 2) m, strongest first

MOST_OTHERS = 400
PAIRS = 300
APART = 0.7  # of the presses' radius: two presses that are no closer


def registered_as(bundle: Bundle) -> tuple[Similarity, int, float]:
    """Where the skin lies in the machine's frame, how many rows of the file it was registered on, and in which unit."""
    said = bundle.manifest["registration"]
    similarity = Similarity(
        float(np.radians(said["angle_degrees"])), float(said["scale"]), np.array(said["offset_m"]), said["mirrored"]
    )
    return similarity, int(said["presses"]) + int(said["unusable_presses"]), float(said["delta_unit"])


class Pictured:
    """Touches of an image: of the network, or without one."""

    def __init__(self, bundle: Bundle, operator: Operator, by: Network | None) -> None:
        self.bundle, self.operator, self.by = bundle, operator, by
        self.circles, self.areas = list[bool](), list[float]()

    def segments(self, d: Array) -> tuple[list[Segment], NDArray[np.float32]]:
        n = self.bundle.image_size
        if self.by is None:
            return segment(self.operator.one_step(d, n), np.zeros((0, 0), np.float32)), np.zeros((0, 0, 0), np.float32)
        stack, context, scale = self.operator.stack(d)
        drop, log_sigma, logits = self.by.session.run(None, {"stack": stack[None], "context": context[None]})
        return segment(drop[0, 0] * scale, np.exp(log_sigma[0, 0]) * scale), softmax(logits[0])

    def __call__(self, d: Array) -> Array:
        m = self.bundle.metres_per_pixel
        found, classes = self.segments(d)
        if found:
            self.areas.append(found[0].area * m * m)
            if classes.size:
                coarse = found[0].mask.reshape(
                    classes.shape[1], -1, classes.shape[2], found[0].mask.shape[1] // classes.shape[2]
                )
                weight = coarse.mean(axis=(1, 3))
                self.circles.append(int((classes * weight).sum(axis=(1, 2)).argmax()) == 0)
        half = 0.5 * self.bundle.image_size
        return np.array([[(s.x + 0.5 - half) * m, (s.y + 0.5 - half) * m] for s in found]).reshape(-1, 2)


def positions(found: list[Array], true: Array) -> dict[str, float]:
    """found: of each press, strongest first; a press that was not found counts as found at the skin's centre."""
    distance = np.array([np.linalg.norm((f[0] if len(f) else 0.0) - x) for f, x in zip(found, true, strict=True)])
    return {
        "median_mm": 1e3 * float(np.median(distance)),
        "mean_mm": 1e3 * float(distance.mean()),
        "p95_mm": 1e3 * float(np.percentile(distance, 95)),
        "counted_as_one": float(np.mean([len(f) == 1 for f in found])),
    }


def two_at_once(places: Places, presses: Presses, true: Array, unit: float) -> dict[str, float]:
    """Of sums of two presses: share that is counted as two, and the median distance of those from where they were."""
    rng = np.random.default_rng(3)
    radius = float(np.linalg.norm(true - true.mean(axis=0), axis=1).max())
    counted, distances = 0, list[float]()
    pairs = [pair for pair in rng.integers(len(presses), size=(20 * PAIRS, 2)) if _apart(true[pair], radius)][:PAIRS]
    for pair in pairs:
        found = places(unit * presses.difference[pair].sum(axis=0))
        if len(found) == 2:
            counted += 1
            either = [np.linalg.norm(found - true[pair][order], axis=1) for order in ([0, 1], [1, 0])]
            distances += min(either, key=lambda each: float(each.sum())).tolist()
    return {"two_counted": counted / len(pairs), "two_median_mm": 1e3 * float(np.median(distances or [np.nan]))}


def _apart(two: Array, radius: float) -> bool:
    return float(np.linalg.norm(two[0] - two[1])) > APART * radius


def run(file: Path, folder: Path, base: str) -> list[dict[str, Any]]:
    """A row for each way."""
    bundle = Bundle.load(folder.resolve())
    if bundle.locator is None or bundle.network_path("full") is None:
        raise RegistrationError(
            f"{folder}: expected a registered bundle with a network: `skin register FILE --out {folder}`, "
            f"then `make train SKIN={folder}`"
        )
    similarity, used, trained_unit = registered_as(bundle)
    arrays = load_npz(file)
    others = read_presses(part(arrays, slice(used, used + MOST_OTHERS)), Bundle.load(base))
    unit, true = trained_unit / others.unit, true_places(others.xy, similarity)
    noise = np.where(bundle.locator.measured, bundle.locator.noise, np.inf)
    operator = bundle.prereconstructor().condition(noise)
    locator = Locator(bundle.locator)
    ways: dict[str, Places] = {
        "likelihood of the presses": lambda d: np.array([[t.x, t.y] for t in locator.locate(d, noise)]).reshape(-1, 2),
        "network's image": Pictured(bundle, operator, network(str(bundle.network_path("full")))),
        "image without a network": Pictured(bundle, operator, None),
    }
    rows = []
    for name, places in ways.items():
        row = {"way": name, **positions([places(unit * d) for d in others.difference], true)}
        if isinstance(places, Pictured):
            row["radius_mm"] = 1e3 * float(np.sqrt(np.median(places.areas or [np.nan]) / np.pi))
            if places.circles:
                row["seen_as_circle"] = float(np.mean(places.circles))
        rows.append({**row, **two_at_once(places, others, true, unit), "presses": len(others)})
    return rows


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="bench.registered_network", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("file", type=Path, help="the presses: FILE.npz, as `skin register` reads them")
    parser.add_argument("folder", type=Path, help="the bundle that was registered on the first of them, and trained")
    parser.add_argument("--skin", default="disc16", help="bundle that it was registered from")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    args = parser.parse_args(argv)
    try:
        rows = run(args.file, args.folder, args.skin)
    except (BundleError, RegistrationError, InputError) as why:
        print(why, file=sys.stderr)
        return 2
    print(f"{rows[0]['presses']} presses that took no part, of {args.file.name}")
    print(f"{'':28s} median mm  mean mm   p95 mm  one touch  radius mm  circle   two counted  of these, median mm")
    for row in rows:
        size, circle = row.get("radius_mm"), row.get("seen_as_circle")
        print(
            f"{row['way']:28s} {row['median_mm']:9.1f} {row['mean_mm']:8.1f} {row['p95_mm']:8.1f} "
            f"{100 * row['counted_as_one']:8.1f} % {'-' if size is None else f'{size:.1f}':>9s} "
            f"{'-' if circle is None else f'{100 * circle:.0f} %':>7s} {100 * row['two_counted']:11.0f} % "
            f"{row['two_median_mm']:18.1f}"
        )
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
