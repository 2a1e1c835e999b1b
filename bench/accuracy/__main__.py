"""Every method on the same frames in one run: run time per frame against each error.

    skin bench accuracy [--quick] [--levels none 50 60 70 80 70f] [--mesh stub] [--only NAMES] [--out bench/reports]
    skin bench accuracy --reads peak --only --levels none 70 --out bench/work/published

The second line is the published test: LDCI, and force from the peak drop of one indenter of 10 mm radius.

Frames are solved on the reference mesh, which no training and no inverse uses, and read from bench/work where they are
there (bench/accuracy/frames.py says what they are). Noise: |Z| 10^(-dB/20) on each measurement, and on the 64 untouched
frames of the tare; "70f" is the same ohm on all. Hyperparameters of the classical methods are chosen for each noise
level on frames of their own. Prints tables, writes accuracy.json and draws accuracy.png.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from bench import REPORTS
from bench.accuracy import frames as _frames
from bench.accuracy import methods as _methods
from bench.accuracy import report as _report
from bench.accuracy import shipped as _shipped
from bench.accuracy.frames import Frames
from bench.accuracy.methods import Image, Method, Tare
from bench.accuracy.scores import Row, score_mask, summarise
from models import metrics
from models.bundle import Bundle
from models.command import whole
from models.shapes import Array
from services.recordings.reconstruction import resampled
from services.runtime.config import Reads

SINGLES = 100  # of each shape and for force in the full form: 500 frames give the mean IoU to 0.003
LEVELS = ("none", "50", "60", "70", "80", "70f")
SCORED_AT = 96
SLOW_SHARE = {"full": 3, "quick": 4}  # a slow method sees every third frame, or every fourth
UNTOUCHED = {"full": 79_200, "quick": 4_000}  # frames nobody touches: an hour at 22 a second, or three minutes


def tares(noisy: Frames, untouched: Array) -> dict[str, Tare]:
    """What was known before the frames, for ours ("") and for EIDORS's, which have their own untouched frame."""
    found = {}
    for name, index in (("", np.flatnonzero(noisy.group != "eidors")), ("eidors", noisy.of("eidors"))):
        if index.size:
            k = index[0]
            scaled = untouched / untouched.mean(0) * noisy.pairs0[k]
            found[name] = Tare(scaled, noisy.pairs0[k], noisy.adjacent0[k])
    return found


def measure(method: Method, value: float | None, noisy: Frames, known: dict[str, Tare], index: Iterable[int]) -> Row:
    """Images (n, 96, 96) of some frames, and CPU seconds each took before it was resampled for scoring."""
    images: dict[str, Image] = {name: method.build(tare, value) for name, tare in known.items()}
    for name, image in images.items():  # the first run of anything is slow
        first = noisy.of("eidors")[0] if name else 0
        image((noisy.pairs if method.pattern == "pairs" else noisy.adjacent)[first])
    found, seconds = [], []
    for k in index:
        z = (noisy.pairs if method.pattern == "pairs" else noisy.adjacent)[k]
        image = images["eidors" if noisy.group[k] == "eidors" else ""]
        began = time.process_time()
        made = image(z)
        seconds.append(time.process_time() - began)
        found.append(resampled(np.asarray(made, np.float32), SCORED_AT))
    return {"images": np.array(found), "seconds": float(np.median(seconds))}


def tuned(method: Method, noisy: Frames, known: dict[str, Tare], share: int) -> float | None:
    """The hyperparameter of the best mean IoU on tuning frames."""
    if not method.values:
        return None
    index = range(0, len(noisy), share)

    def quality(value: float) -> float:
        images = measure(method, value, noisy, known, index)["images"]
        return float(np.mean([score_mask(i, noisy, k) for i, k in zip(images, index, strict=True)]))

    return max(method.values, key=quality)


def chosen(frames: Frames, share: int) -> NDArray[np.int64]:
    """Frames a method is run on: all, or for a slow one each `share`-th and, in the full run, one LDCI grid."""
    if share == 1:
        return np.arange(len(frames))
    keep = np.flatnonzero(~np.char.startswith(frames.group, "ldci"))[::share]
    first = f"ldci-{_frames.LDCI[0][0]}-{_frames.LDCI[0][1]}"
    return np.sort(np.concatenate([keep, frames.of(first)])) if share == SLOW_SHARE["full"] else keep


def gains(method: Method, value: float | None, clean: Frames) -> tuple[float, float] | None:
    """What makes the noise-free touch in the centre come out right, in peak and in integrated drop."""
    if not method.gain:
        return None
    index = clean.of(f"ldci-{_frames.LDCI[0][0]}-{_frames.LDCI[0][1]}")
    centre = int(index[len(index) // 2])
    known = {"": Tare(np.tile(clean.pairs0[centre], (2, 1)), clean.pairs0[centre], clean.adjacent0[centre])}
    one = Frames(*(getattr(clean, f)[[centre]] for f in clean.__dataclass_fields__))
    image, shape = measure(method, value, one, known, [0])["images"][0], clean.scene(centre)[0]
    return shape.drop / float(image.max()), shape.integral / metrics.integrated(image)


def run(
    frames: Frames, tuning: Frames, methods: list[Method], levels: Iterable[str], seed: int, slow: int
) -> list[Row]:
    """One row a method and level."""
    rows = []
    for level in levels:
        noisy, untouched = _frames.noisy(frames, level, seed)
        known = tares(noisy, untouched)
        to_tune, tune_untouched = _frames.noisy(tuning, level, seed + 1)
        for method in methods:
            share = slow if method.slow else 1
            value = tuned(method, to_tune, tares(to_tune, tune_untouched), share)
            index = chosen(noisy, share)
            made = measure(method, value, noisy, known, index)
            figures = summarise(made["images"], noisy, index, gains(method, value, frames))
            row = {"method": method.name, "level": level, "value": value, "ms": made["seconds"] * 1e3, **figures}
            rows.append(row)
            _report.progress(row)
    return rows


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench accuracy", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few hundred frames of a coarser mesh, two noise levels")
    parser.add_argument(
        "--levels", nargs="+", default=None, choices=LEVELS, help="dB; none: noise-free; 70f: fixed in ohm"
    )
    parser.add_argument("--bundle", default="square16", help="the bundle that stands for what is shipped")
    parser.add_argument("--seed", type=whole(0), default=5, help="of the frames and the noise")
    parser.add_argument(
        "--only", nargs="*", default=None, help="methods whose name contains one of these; no name: what is shipped"
    )
    parser.add_argument("--reads", choices=get_args(Reads), default="pressure", help="what forces are read from")
    parser.add_argument("--mesh", choices=("reference", "stub"), help="stub: the full form's frames in minutes")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    bundle = Bundle.load(args.bundle)
    # first: it says within a second whether a peer's package is missing
    methods = _methods.classical() + _methods.peers() + _methods.published(bundle) + _methods.shipped(bundle)
    levels = args.levels or (("none", "70") if args.quick else LEVELS)
    mesh, n, singles = ("stub", 6, None) if args.quick else ("reference", 20, SINGLES)
    mesh = args.mesh or mesh
    frames = _frames.load(args.seed, n, mesh, singles=singles)
    tuning = _frames.load(args.seed + 1000, 4, "stub", ("shapes", "hertz"))
    wanted = [m for m in methods if args.only is None or any(o in m.name for o in args.only)]
    began = time.perf_counter()
    slow = SLOW_SHARE["quick" if args.quick else "full"]
    rows = run(frames, tuning, wanted, levels, args.seed, slow)
    rows += _shipped.run(frames, bundle, levels, args.seed, UNTOUCHED["quick" if args.quick else "full"], args.reads)
    floors = _shipped.floors(frames, levels, args.reads)
    report = _report.Report(rows, floors, frames, mesh, args.seed, bundle, args.reads)
    report.print()
    report.write(args.out)
    print(f"{time.perf_counter() - began:.0f} s; wrote {args.out / 'accuracy.json'} and {args.out / 'accuracy.png'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
