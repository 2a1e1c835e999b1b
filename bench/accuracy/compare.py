"""Every method on the same frames, and the service: what `skin reconstruct` makes of them as the rows of a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from bench.accuracy import frames as _frames
from bench.accuracy.frames import LDCI, Frames
from bench.accuracy.methods import Image, Method, Tare
from bench.accuracy.scores import Row, of_contacts, of_images, score_mask
from models import fisher, metrics
from models.bundle import Bundle
from models.shapes import Array
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct, resampled
from services.runtime.config import Skin

SCORED_AT = 96
CENTRED = f"ldci-{LDCI[0][0]}-{LDCI[0][1]}"  # the middle frame of this group is a touch in the centre
SLOW_SHARE = {False: 3, True: 4}  # by whether the run is short: a slow method sees every third frame, or every fourth
SERVICE = "eitskin"


def tares(noisy: Frames, untouched: Array) -> dict[str, Tare]:
    """What was known before the frames, for ours ("") and for EIDORS's, which have their own untouched frame."""
    found = {}
    for name, index in (("", np.flatnonzero(noisy.group != "eidors")), ("eidors", noisy.of("eidors"))):
        if index.size:
            k = index[0]
            scaled = untouched / untouched.mean(0) * noisy.pairs0[k]
            found[name] = Tare(scaled, noisy.pairs0[k], noisy.adjacent0[k])
    return found


def measure(
    method: Method, value: float | None, noisy: Frames, known: dict[str, Tare], index: Iterable[int]
) -> tuple[Array, float]:
    """Images (n, 96, 96) of some frames, and the median CPU seconds of each before it was resampled for scoring."""
    images: dict[str, Image] = {name: method.build(tare, value) for name, tare in known.items()}
    impedances = noisy.pairs if method.pattern == "pairs" else noisy.adjacent
    for name, image in images.items():  # the first run of anything is slow
        image(impedances[noisy.of("eidors")[0] if name else 0])
    found, seconds = [], []
    for k in index:
        image = images["eidors" if noisy.group[k] == "eidors" else ""]
        began = time.process_time()
        made = image(impedances[k])
        seconds.append(time.process_time() - began)
        found.append(resampled(np.asarray(made, np.float32), SCORED_AT))
    return np.array(found), float(np.median(seconds))


def tuned(method: Method, noisy: Frames, known: dict[str, Tare], share: int) -> float | None:
    """The hyperparameter of the best mean IoU on tuning frames."""
    if not method.values:
        return None
    index = range(0, len(noisy), share)

    def quality(value: float) -> float:
        images, _ = measure(method, value, noisy, known, index)
        return float(np.mean([score_mask(i, noisy, k) for i, k in zip(images, index, strict=True)]))

    return max(method.values, key=quality)


def chosen(frames: Frames, share: int) -> NDArray[np.int64]:
    """Frames a method is run on: all, or for a slow one each `share`-th and, in the full run, one LDCI grid."""
    if share == 1:
        return np.arange(len(frames))
    keep = np.flatnonzero(~np.char.startswith(frames.group, "ldci"))[::share]
    return np.sort(np.concatenate([keep, frames.of(CENTRED)])) if share == SLOW_SHARE[False] else keep


def gains(method: Method, value: float | None, clean: Frames) -> tuple[float, float] | None:
    """What makes the noise-free touch in the centre come out right, in peak and in integrated drop."""
    if not method.gain:
        return None
    index = clean.of(CENTRED)
    one = clean.part(index[len(index) // 2][None])
    known = {"": Tare(np.tile(one.pairs0[0], (2, 1)), one.pairs0[0], one.adjacent0[0])}
    image, shape = measure(method, value, one, known, [0])[0][0], one.scene(0)[0]
    return shape.drop / float(image.max()), shape.integral / metrics.integrated(image)


def run(
    frames: Frames, tuning: Frames, methods: Sequence[Method], level: str, seed: int, quick: bool, skin: Skin
) -> list[Row]:
    """The rows of one noise level: every method's, the service's last."""
    noisy, untouched = _frames.noisy(frames, level, seed)
    known = tares(noisy, untouched)
    to_tune, tune_untouched = _frames.noisy(tuning, level, seed + 1)
    tune_known, rows = tares(to_tune, tune_untouched), []
    for method in methods:
        share = SLOW_SHARE[quick] if method.slow else 1
        value = tuned(method, to_tune, tune_known, share)
        index = chosen(noisy, share)
        images, seconds = measure(method, value, noisy, known, index)
        figures = of_images(images, noisy, index, gains(method, value, frames))
        rows.append({"method": method.name, "level": level, "value": value, "ms": seconds * 1e3, **figures})
        print(f"{level:>5} {method.name}: IoU {figures['mean_iou']:.3f}", file=sys.stderr)
    began = time.process_time()
    found = reconstructed(noisy, untouched, skin)
    row: Row = {"method": SERVICE, "level": level, "value": None}
    row["ms"] = 1e3 * (time.process_time() - began) / len(noisy)
    row |= of_images(found["image"], noisy, np.arange(len(noisy)))
    return [*rows, row | of_contacts(found, noisy)]


def reconstructed(noisy: Frames, untouched: Array, skin: Skin) -> dict[str, Array]:
    """What `skin reconstruct IN.npz OUT.npz --skin square16` writes of the frames, with its default settings; each of
    EIDORS's against its own untouched rows, in a file of its own.
    """
    parts, order = [], []
    bundle = Bundle.load(skin.bundle)
    for index in (np.flatnonzero(noisy.group != "eidors"), noisy.of("eidors")):
        if index.size:
            rows = untouched / untouched.mean(0) * noisy.pairs0[index[0]]
            parts.append(reconstruct(Input(noisy.pairs[index], rows, None), skin, bundle, calibrate=True))
            order.append(index)
    back = np.argsort(np.concatenate(order))
    return {k: np.concatenate([p[k] for p in parts])[back] for k in parts[0] if k != "assumed"}


def floors(frames: Frames, level: str) -> Row:
    """Bayesian floors (root mean square) of the same touches, size unknown, no drift; empty where noise-free."""
    if level == "none":
        return {}
    relative, floor_ohm = _frames.Level(level).parts(frames.pairs0[0])
    noise = fisher.MeasurementNoise(-20 * np.log10(relative) if relative else np.inf, floor_ohm)

    def mean(index: Iterable[int]) -> fisher.Floor:
        return fisher.mean_floor(
            fisher.floors("square16", frames.scene(int(k))[0], noise, fisher.SizePrior())["bayes"] for k in index
        )

    everywhere, force = mean(frames.of(*_frames.SINGLE)), mean(frames.of("force"))
    return {
        "position_rms_%": float(metrics.of_side(everywhere.position)),
        "force_rms_%": 100 * force.force,
        "drop_rms_%": 100 * force.drop,
        "integral_rms_%": 100 * force.integral,
    }
