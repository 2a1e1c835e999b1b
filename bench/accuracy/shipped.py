"""The shipped bundle in the accuracy benchmark: the runtime's own stages, each network file; what physics allows."""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np

from bench.accuracy import frames as _frames
from bench.accuracy.frames import Frames
from bench.accuracy.methods import session
from bench.accuracy.report import progress
from bench.accuracy.scores import Row, gap_of, standard_error, summarise
from models import fisher, metrics
from models.bundle import Bundle
from models.shapes import CLASSES, Array
from protocol.frames import RawFrame
from services.estimation.first.baseline import take
from services.pipeline import Pipeline
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Indenter, NetworkFile, Reads, Skin

METRES_PER_UNIT = 0.05  # of square16
LARGE = 0.25  # radius from which on shape classes are scored
VARIANTS: tuple[NetworkFile, ...] = ("full", "fast", "int8")
RATE_HZ = 22.0  # the board's full scan


def reconstructed(noisy: Frames, untouched: Array, skin: Skin, bundle: Bundle) -> tuple[dict[str, Array], float]:
    """What `skin reconstruct` gives for all frames, each of EIDORS's against its own baseline; CPU seconds a frame."""
    parts, seconds = [], 0.0
    order = []
    for index in (np.flatnonzero(noisy.group != "eidors"), noisy.of("eidors")):
        if not index.size:
            continue
        tare = untouched / untouched.mean(0) * noisy.pairs0[index[0]]
        began = time.process_time()
        parts.append(reconstruct(Input(noisy.pairs[index], tare, None), skin, bundle, age_s=0.0))
        seconds += time.process_time() - began
        order.append(index)
    back = np.argsort(np.concatenate(order))
    return {k: np.concatenate([p[k] for p in parts])[back] for k in parts[0]}, seconds / len(noisy)


def network_ms(bundle: Bundle, variant: str, runs: int = 200) -> float:
    """Median run time of a network file alone, one thread, one frame."""
    path = bundle.network_path(variant)
    assert path is not None
    network = session(path)
    feed = {
        i.name: np.zeros([d if isinstance(d, int) else 1 for d in i.shape], np.float32) for i in network.get_inputs()
    }
    seconds = []
    for _ in range(runs):
        began = time.perf_counter()
        network.run(None, feed)
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds) * 1e3)


def run(
    frames: Frames, bundle: Bundle, levels: Iterable[str], seed: int, untouched_frames: int, reads: Reads = "pressure"
) -> list[Row]:
    """One row a level and network file: figures of the image, and of the contacts a controller would get."""
    variants: list[NetworkFile] = [v for v in VARIANTS if bundle.network_path(v) is not None] or ["none"]
    alone: dict[NetworkFile, float] = {v: network_ms(bundle, v) for v in variants if v != "none"}
    rows = []
    for level in levels:
        noisy, untouched = _frames.noisy(frames, level, seed)
        for variant in variants:
            skin = Skin(port="stub", bundle=str(bundle.path), network=variant, reads=reads)
            found, seconds = reconstructed(noisy, untouched, skin, bundle)
            row: Row = {"method": f"shipped, {variant}", "level": level, "value": None, "ms": seconds * 1e3}
            row["network_ms"] = alone.get(variant)
            row |= summarise(found["image"], noisy, np.arange(len(noisy)), None)
            row |= contacts(found, noisy)
            row |= known_indenter(noisy, untouched, skin, bundle)
            if variant == "full":
                if level == "70":
                    row |= false_touches(frames, level, seed, bundle, untouched_frames)
            rows.append(row)
            progress(row)
    return rows


FAR = 10.0  # per cent of the side: a contact that is so far off is told where nothing touches


def contacts(found: dict[str, Array], frames: Frames) -> Row:
    """Position, force, count and shape as the publisher gives them; a touch not seen is off by half the diagonal."""
    singles = [k for k in frames.of("shapes", "hertz", "force") if found["count"][k] >= 1]
    missed = len(frames.of("shapes", "hertz", "force")) - len(singles)
    position = [np.hypot(*(found["position"][k, 0] / 0.05 - frames.scene(k)[0].centroid)) for k in singles]
    distance = metrics.of_side(np.array(position + [metrics.SIDE / np.sqrt(2)] * missed))
    force = [k for k in frames.of("force") if np.isfinite(found["force"][k, 0])]
    newton = [frames.scene(k)[0].force(METRES_PER_UNIT) for k in force]
    errors = metrics.relative_error([found["force"][k, 0] for k in force], newton)
    within = [
        abs(found["force"][k, 0] - frames.scene(k)[0].force(METRES_PER_UNIT)) <= found["force_sigma"][k, 0]
        for k in singles
    ]
    wanted = {"two": 2, "three": 3}
    several = frames.of(*wanted)
    large = [k for k in frames.of("shapes") if frames.scene(k)[0].radius >= LARGE and found["count"][k] >= 1]
    named = [(frames.scene(k)[0].shape_class, str(found["shape"][k, 0])) for k in large]
    matrix = metrics.confusion(
        [t for t, s in named if s in CLASSES], [CLASSES.index(s) for _, s in named if s in CLASSES]
    )
    right = np.array([s in CLASSES and CLASSES.index(s) == t for t, s in named], dtype=float)
    apart = frames.of("apart")
    return {
        "position_%_se": standard_error(distance),
        "force_%_se": standard_error(errors),
        "shape_%_se": 100 * standard_error(right),
        "missed": missed,
        "far": int((distance[: len(singles)] > FAR).sum()),
        "position_%": float(distance.mean()),
        "position_rms_%": float(np.sqrt((distance**2).mean())),
        "position_p95_%": float(np.percentile(distance, 95)),
        "force_%": float(errors.mean()),
        "force_rms_%": float(np.sqrt((errors**2).mean())),
        "force_within_%": float(100 * np.mean(within)),
        "count_%": float(100 * np.mean([found["count"][k] == wanted[frames.group[k]] for k in several])),
        "single_%": float(100 * np.mean([found["count"][k] == 1 for k in frames.of("shapes", "hertz", "force")])),
        "shape_%": float(100 * np.trace(matrix) / max(len(named), 1)),
        "confusion": matrix.tolist(),
        "separation": metrics.separation([gap_of(frames, k) for k in apart], [found["count"][k] == 2 for k in apart]),
    }


def known_indenter(noisy: Frames, untouched: Array, skin: Skin, bundle: Bundle) -> Row:
    """Force of the touches of one radius where the configuration says that radius; a touch not seen counts whole."""
    index = noisy.of("force")
    if not index.size:
        return {}
    shapes = [noisy.scene(int(k))[0] for k in index]
    prior = Indenter(radius_m=shapes[0].radius * bundle.metres_per_unit)
    some = Frames(*(getattr(noisy, f)[index] for f in noisy.__dataclass_fields__))
    found, _ = reconstructed(some, untouched, skin.model_copy(update={"indenter": prior}), bundle)
    force, sigma = np.nan_to_num(found["force"][:, 0]), found["force_sigma"][:, 0]
    newton = np.array([s.force(METRES_PER_UNIT) for s in shapes])
    errors = metrics.relative_error(force, newton)
    return {
        "known_force_%": float(errors.mean()),
        "known_force_rms_%": float(np.sqrt((errors**2).mean())),
        "known_force_within_%": float(100 * np.mean(np.abs(force - newton) <= sigma)),
    }


def false_touches(frames: Frames, level: str, seed: int, bundle: Bundle, n: int) -> Row:
    """How often n frames of a skin that nobody touches become contacts, at the board's full-scan rate."""
    relative = _frames.Level(level).share
    rng = np.random.default_rng([seed, 9])
    z0 = frames.pairs0[0]
    pipeline = Pipeline(Skin(port="stub", bundle=str(bundle.path)), bundle=bundle)
    tare = z0 * (1 + relative * rng.standard_normal((64, len(z0))))
    pipeline.pre.set_baseline(take(tare, pipeline.pre.pre, "bench", 0))
    touched = []
    for k in range(n):
        z = z0 * (1 + relative * rng.standard_normal(len(z0)))
        raw = RawFrame(
            skin="skin",
            scan=k,
            z=z.astype(np.complex64),
            status=np.zeros(len(z0), np.uint8),
            stamps={"sample": round((k + 1) * 1e9 / RATE_HZ)},
            source="replay",
            valid=True,
            board="bench",
        )
        contacts = pipeline.run(raw).contact.contacts
        touched.append(any(c.state != "end" for c in contacts))
    return {"false_touches_h": metrics.false_touches_per_hour(touched, RATE_HZ), "untouched_frames": n}


def floors(frames: Frames, levels: Iterable[str], reads: Reads = "pressure") -> dict[str, Row]:
    """Bayesian floors (root mean square) of the same touches, size unknown, no drift; none where noise-free."""
    found = {}
    for level in levels:
        if level == "none":
            continue
        relative, floor_ohm = _frames.Level(level).parts(frames.pairs0[0])
        decibel = -20 * np.log10(relative) if relative else np.inf
        noise = fisher.MeasurementNoise(decibel, floor_ohm)

        def mean(index: Iterable[int], noise: fisher.MeasurementNoise = noise) -> fisher.Floor:
            return fisher.mean_floor(
                fisher.floors("square16", frames.scene(k)[0], noise, fisher.SizePrior())["bayes"] for k in index
            )

        shapes = [frames.scene(int(k))[0] for k in frames.of("force")]
        known = fisher.SizePrior(radius=(shapes[0].radius, shapes[0].radius)) if shapes else fisher.SizePrior()
        indenter = fisher.mean_floor(fisher.floors("square16", s, noise, known)["bayes"] for s in shapes)
        everywhere, force = mean(frames.of("shapes", "hertz", "force")), mean(frames.of("force"))
        found[level] = {
            "position_rms_%": float(metrics.of_side(everywhere.position)),
            "force_rms_%": 100 * (force.drop if reads == "peak" else force.force),
            "integral_rms_%": 100 * force.integral,
            "known_force_rms_%": 100 * (indenter.drop if reads == "peak" else indenter.force),
        }
    return found
