"""Studies behind the adaptive scan: the list's length, its power, and what was measured and not built."""

from __future__ import annotations

from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_stub.board import measurement_s
from models import patterns, sentinel
from models.bundle import Bundle
from models.fisher import MeasurementNoise, SizePrior, information, sensitivity
from models.forward import shared
from models.limits import positions
from models.prereconstruction import Drift
from models.shapes import Shape
from protocol.frames import DeltaFrame
from services.contacts.segmentation import segment
from services.estimation.sentinel import SentinelDetector, SentinelVerdict
from services.networks import Network

Array = NDArray[np.float64]

LENGTHS = (3, 4, 6, 8, 12, 16, 24, 40)
LINE_S = 10 / 921_600  # a byte on the line
MEANS = (1, 4, 16, 64)  # frames


def lengths(bundle: Bundle) -> list[dict[str, Any]]:
    """What lists of other lengths would give; by the design's own linear physics, 1 N of radius 0.2 at 70 dB."""
    rows = []
    for n in LENGTHS:
        found = sentinel.design(bundle.matrices, max(n, 3))
        judged = found.touches.radius == sentinel.RADIUS
        sigma = 10 ** (-sentinel.SNR_DB / 20) * np.sqrt(1 + 1 / 64)
        signal = sentinel.NEWTON * found.touches.response[judged][:, found.rows] / sigma
        worst = float(np.linalg.norm(signal, axis=1).min())
        c = sentinel.threshold(found.filters(np.ones(n)), sentinel.FALSE_ALARMS_HZ * n * sentinel.MEASUREMENT_S)
        scan = n * measurement_s(128)
        rows.append(
            {
                "n": n,
                "scan_ms": 1e3 * scan,
                "worst_deflection": worst,
                "threshold": c,
                "power": NormalDist().cdf(worst - c),
                "to_hit_ms": 1e3 * (1.5 * scan + (9 * n + 30) * LINE_S),
                "place_percent": _place(bundle, found.rows),
            }
        )
    return rows


def _place(bundle: Bundle, rows: NDArray[np.integer]) -> float:
    """Bayesian floor of the position, % of the side, 1 N of radius 0.2, root mean square over the skin."""
    drift, noise, prior = Drift(), MeasurementNoise(70.0), SizePrior().information()
    each = []
    for x, y in positions("square16", 0.2, 5):
        seen = sensitivity("square16", Shape("circle", x, y, 0.2, 0.1))
        covariance = np.linalg.inv(information(seen, bundle.pattern[rows].astype(int), noise, drift) + prior)
        each.append(covariance[0, 0] + covariance[1, 1])
    return float(50 * np.sqrt(np.mean(each)))


def power(bundle: Bundle, touches: int, draws: int, seed: int = 0) -> dict[str, Any]:
    """Presses solved on a mesh that the design has not seen, judged by `SentinelDetector` as it is, one scan each."""
    model, rng = shared("square16", "stub"), np.random.default_rng(seed)
    found = sentinel.design(bundle.matrices)
    z0 = np.abs(model.solve().impedances())[found.rows]
    relative = 10 ** (-sentinel.SNR_DB / 20)
    watch, hits, scores = SentinelDetector(found), [], []
    for _ in range(touches):
        x, y = rng.uniform(-0.8, 0.8, 2)
        touched = model.solve(model.touched([Shape("circle", x, y, sentinel.RADIUS, sentinel.NEWTON)])).impedances()
        z = np.abs(touched)[found.rows]
        watch.begin(z0 * (1 + relative * rng.standard_normal((64, len(z0)))))
        verdicts = []
        for _ in range(draws):
            watch.begin_again()
            verdicts.append(watch(z * (1 + relative * rng.standard_normal(len(z)))) is SentinelVerdict.HIT)
            scores.append(watch.score)
        hits.append(np.mean(verdicts))
    return {"touches": touches, "draws": draws, "seen": float(np.mean(hits)), "worst": float(np.min(hits)),
            "lowest_score": float(np.min(scores)), "threshold": watch.hit}  # fmt: skip


def false_alarms(bundle: Bundle, minutes: float, seed: int = 0) -> dict[str, float]:
    """Hits and suspicions a minute on an untouched skin that dries and whose contacts age as the stub's do."""
    found, rng = sentinel.design(bundle.matrices), np.random.default_rng(seed)
    z0, contact = bundle.z0[found.rows], bundle.matrices.contact[found.rows]
    relative, watch = 10 ** (-sentinel.SNR_DB / 20), SentinelDetector(found)
    rates = np.zeros(contact.shape[1])
    rates[[3, 13]] = 1e-4
    count = int(minutes * 60 / found.seconds)
    hits = suspicions = 0
    watch.begin(z0 * (1 + relative * rng.standard_normal((64, len(z0)))))
    for k in range(count):
        seconds = k * found.seconds
        now = z0 * (1 + 1e-5 * seconds + contact @ (rates * seconds))
        verdict = watch(now * (1 + relative * rng.standard_normal(len(z0))))
        suspicions += verdict is SentinelVerdict.SUSPECT
        if verdict is SentinelVerdict.HIT:
            hits += 1
            watch.begin(now * (1 + relative * rng.standard_normal((64, len(z0)))))
    return {"minutes": minutes, "hits_per_minute": hits / minutes, "suspicions_per_minute": suspicions / minutes}


# what was measured and not built


def hold(seconds: tuple[float, ...] = (0.2, 0.5, 1.0, 2.0, 5.0)) -> list[dict[str, Any]]:
    """Floors after t seconds of a held touch, by the DFT's length: error falls with the square root of the time."""
    rows = []
    for t in seconds:
        row: dict[str, Any] = {"seconds": t}
        for points in (128, 256, 512):
            frames = int(t / (120 * measurement_s(points)))
            row[f"frames_{points}"] = frames
            if frames:
                snr = 70.0 + 10 * np.log10(frames * points / 128)
                row[f"position_{points}"] = _floor(None, MeasurementNoise(snr, tare_frames=10**9))
        rows.append(row)
    return rows


def averaged(bundle: Bundle, touches: int, seed: int = 0) -> list[dict[str, Any]]:
    """Errors (root mean square) of the network on the mean of n frames of 128 points, tare of 64.

    As the network is told of one frame's noise, or of the mean's (an operator conditioned for it). A frame of 512
    points has the noise of four, and takes the time of 3.64.
    """
    model, rng, relative = shared("square16", "stub"), np.random.default_rng(seed), 10**-3.5
    pre, network = bundle.prereconstructor(), Network(str(bundle.network_path("full")))
    one = np.full(pre.measurements, relative)
    operators = {
        (n, told): pre.condition(one / np.sqrt(n if told else 1), tare_frames=max(1, 64 // n if told else 64))
        for n in MEANS
        for told in (False, True)
    }
    z0 = np.abs(model.solve().impedances())
    errors: dict[tuple[int, bool], list[tuple[float, float, float]]] = {key: [] for key in operators}
    for _ in range(touches):
        (x, y), drop = rng.uniform(-0.75, 0.75, 2), rng.uniform(0.1, 0.5)
        z = np.abs(model.solve(model.touched([Shape("circle", x, y, 0.2, drop)])).impedances())
        for (n, told), operator in operators.items():
            tare, mean = (relative / np.sqrt(m) * rng.standard_normal(len(z0)) for m in (64, n))
            stack, context, scale = operator.stack(pre.difference(z * (1 + mean), z0 * (1 + tare)))
            image, sigma, _ = network.run(DeltaFrame(skin="skin", stack=stack, context=context, scale=scale))
            if found := segment(image, sigma, []):
                half, s = bundle.image_size / 2, found[0]
                off = np.hypot((s.x + 0.5) / half - 1 - x, (s.y + 0.5) / half - 1 - y)
                integral = s.volume / half**2 / (np.pi * 0.04 * drop)
                errors[n, told].append((50 * off, 100 * (s.peak / drop - 1), 100 * (integral - 1)))
    rows = []
    for n in MEANS:
        row: dict[str, Any] = {"frames": n, "seconds": n * 120 * measurement_s(128)}
        for told, name in ((False, "told of one frame"), (True, "told of the mean")):
            position, force, integral = np.sqrt((np.array(errors[n, told]) ** 2).mean(axis=0))
            row |= {f"{name}: position": position, "force " + name: force, "integral " + name: integral}
        row["floor: position"] = _floor(
            None, MeasurementNoise(70.0 - 10 * np.log10(1 / n + 1 / 64), tare_frames=10**9), 0.3
        )
        rows.append(row)
    return rows


def _floor(rows: NDArray[np.int64] | None, noise: MeasurementNoise, drop: float = 0.15) -> float:
    """Bayesian floor of the position [% of the side], radius 0.2, root mean square over the skin."""
    own = shared("square16", "inverse").skin.pattern if rows is None else rows
    prior, each = SizePrior().information(), []
    for x, y in positions("square16", 0.2, 5):
        seen = sensitivity("square16", Shape("circle", x, y, 0.2, drop))
        covariance = np.linalg.inv(information(seen, own, noise, Drift()) + prior)
        each.append(covariance[0, 0] + covariance[1, 1])
    return float(50 * np.sqrt(np.mean(each)))


def partial(counts: tuple[int, ...] = (15, 30, 60, 120)) -> list[dict[str, float]]:
    """The best n of the 120 pairs for a touch that is known but for its last movement, beside all of them."""
    own, noise, prior = shared("square16", "inverse").skin.pattern, MeasurementNoise(70.0), SizePrior().information()
    variances: dict[int, list[float]] = {n: [] for n in counts}
    for x, y in positions("square16", 0.2, 5):
        z0, slope, _ = sensitivity("square16", Shape("circle", x, y, 0.2, 0.15)).relative(own)
        slopes = (slope / (noise.sigma(z0) / np.abs(z0))[:, None])[None]
        order = _a_optimal(slopes, max(counts), prior)
        for n in counts:
            best = slopes[0, order[:n]]
            covariance = np.linalg.inv(best.T @ best + prior)
            variances[n].append(covariance[0, 0] + covariance[1, 1])
    std = {n: float(50 * np.sqrt(np.mean(v))) for n, v in variances.items()}
    last = max(counts)
    return [
        {"n": n, "position_percent": std[n], "at_equal_time": std[n] * np.sqrt(n / last) / std[last]} for n in counts
    ]


def d_optimal(count: int = 120) -> list[dict[str, Any]]:
    """`count` measurements of all the four multiplexers can reach, greedily D-optimal, beside the known patterns."""
    n = 16
    pair = patterns.pairs(n)[:, :2]
    first, second = np.triu_indices(len(pair))  # by reciprocity each unordered pair of pairs once
    candidates = np.column_stack([pair[first], pair[second]])
    seen = [sensitivity("square16", Shape("circle", x, y, 0.2, 0.15)) for x, y in positions("square16", 0.2, 5)]
    typical = float(np.median(np.abs(seen[0].relative(patterns.pairs(n))[0])))
    floor = 10**-3.5 * typical
    prior, rows = SizePrior().information(), []
    for name, noise in {
        "relative 70 dB": MeasurementNoise(70.0),
        "converter alone": MeasurementNoise(np.inf, floor),
        "70 dB and a tenth of it": MeasurementNoise(70.0, 0.1 * floor),
    }.items():
        slopes = []
        for one in seen:
            z0, slope, _ = one.relative(candidates)
            spread = noise.sigma(z0) / np.abs(z0)
            slopes.append(np.where(spread[:, None] > 0, slope / np.maximum(spread, 1e-12)[:, None], 0.0))
        chosen = _d_optimal(np.array(slopes), count, prior)
        row: dict[str, Any] = {"noise": name}
        row["pairs"] = _floor(patterns.pairs(n), noise)
        row["adjacent (208)"] = _floor(patterns.adjacent(n), noise)
        row["D-optimal"] = _floor(candidates[chosen], noise)
        rows.append(row)
    return rows


def _a_optimal(slopes: Array, count: int, prior: Array) -> list[int]:
    """Measurements in the order in which they lower the variance of the position. slopes (M, K, 4)."""
    chosen: list[int] = []
    inside = prior + np.zeros((len(slopes), 4, 4))
    while len(chosen) < count:
        u = np.einsum("mab,mkb->mka", np.linalg.inv(inside), slopes)
        gain = ((u[..., 0] ** 2 + u[..., 1] ** 2) / (1 + np.einsum("mka,mka->mk", u, slopes))).mean(axis=0)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        new = slopes[:, chosen[-1]]
        inside = inside + new[:, :, None] * new[:, None, :]
    return chosen


def _d_optimal(slopes: Array, count: int, prior: Array) -> list[int]:
    chosen: list[int] = []
    inside = prior + np.zeros((len(slopes), 4, 4))
    while len(chosen) < count:
        gain = np.log1p(np.einsum("mka,mab,mkb->mk", slopes, np.linalg.inv(inside), slopes, optimize=True)).mean(axis=0)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        new = slopes[:, chosen[-1]]
        inside = inside + new[:, :, None] * new[:, None, :]
    return chosen
