"""How wrong a network's forces are: presses it never saw, on a mesh it was not trained on, and the maps fitted to them.

    python -m models.calibrate square16            prints the coverage of the shipped maps on fresh presses
    python -m models.calibrate square16 --write    fits them anew and writes them into the bundle's manifest

`models.build` does the second whenever it packages networks. See models/uncertainty.py for what is fitted.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import track
from scipy import ndimage

from models import bundle, command, geometry
from models.forward import ForwardModel
from models.prereconstruction import TARE_FRAMES, Array, Drift, Operator, PreReconstructor
from models.scenes import Prior, random_shape
from models.shapes import KINDS, Shape
from models.uncertainty import (
    ESTIMATES,
    FLOOR,
    LEAST_NOISE,
    PLATEAU,
    RELATIVE_FLOOR,
    ImageFeatures,
    Map,
    estimate,
    features,
    fit,
    maps,
)

if TYPE_CHECKING:
    from models.evaluation import Predict

PRIOR = Prior(radius=(0.08, 0.50), drop=(0.10, 0.50), tail=0.0)  # 1 to 5 N
MESH = "stub"  # no training sees it, and the accuracy benchmark uses another again
PRESSES, CONDITIONS, EACH = 1000, 40, 150  # presses solved; noise conditions, and presses seen under each
DECIBEL = (57.0, 95.0)
NOISE_FREE_SHARE = 0.25
DRIFT = Drift(2e-5, 1e-4), Drift(1e-4, 1e-3)  # from, to: what services allow for soon after an untouched frame
FALSE_ALARMS = 1e-7  # as services: what is not touched has no force
FOLDS = 5


@dataclass(frozen=True, eq=False)
class SolvedPresses:
    """N solved presses: shapes (N, 7) rows, difference (N, K) = |Z| / |Z0| - 1 without noise, z0 (K,) ohm."""

    shapes: Array
    difference: Array
    z0: Array

    def normalised(self, pre: PreReconstructor) -> Array:
        """(N, K) in the bundle's normalisation."""
        return self.difference * (self.z0 / pre.normaliser(self.z0))

    def touches(self) -> list[Shape]:
        return [Shape.from_row(row) for row in self.shapes]


def solve(
    skin: geometry.SkinGeometry, n: int = PRESSES, seed: int = 3, mesh: str = MESH, cache: Path | None = None
) -> SolvedPresses:
    """Half circles, half other shapes, one touch each; read from `cache` where these very ones are there."""
    rng = np.random.default_rng([seed, 31])
    prior, shapes = PRIOR.on(skin), []
    for k in range(n):
        kinds = ("circle",) if k % 2 else KINDS[1:]
        shapes.append(random_shape(rng, Prior(**{**vars(prior), "kinds": kinds}), skin.inside))
    rows = np.array([s.as_row() for s in shapes])
    if cache is not None and cache.is_file():
        with np.load(cache) as file:
            if file["shapes"].shape == rows.shape and np.allclose(file["shapes"], rows) and str(file["mesh"]) == mesh:
                return SolvedPresses(rows, file["difference"], file["z0"])
    model = ForwardModel(skin, mesh=mesh)
    z0 = np.abs(model.solve(1.0).impedances())
    each = track(shapes, description=f"{n} presses on the {mesh} mesh")
    difference = np.array([np.abs(model.solve(model.touched([s])).impedances()) / z0 - 1 for s in each])
    if cache is not None:
        cache.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(cache, shapes=rows, difference=difference, z0=z0, mesh=mesh)
    return SolvedPresses(rows, difference, z0)


@dataclass(frozen=True, eq=False)
class Sightings:
    """M presses as a network saw them: index (M,) into the presses, decibel (M,), and what was seen."""

    index: Array
    decibel: Array
    seen: ImageFeatures

    def __getitem__(self, rows: Array) -> Sightings:
        return Sightings(self.index[rows], self.decibel[rows], part(self.seen, rows))


def part(seen: ImageFeatures, rows: Array) -> ImageFeatures:
    return ImageFeatures(**{f.name: getattr(seen, f.name)[rows] for f in fields(ImageFeatures)})


def scans(
    presses: SolvedPresses, pre: PreReconstructor, seed: int, conditions: int
) -> Iterator[tuple[float, float, Operator, Array, Array]]:
    """The presses under noise from 57 dB to none, each condition with its own tare: decibel, rms sigma, operator, which
    presses were detected, and their differences (N, K).
    """
    rng = np.random.default_rng([seed, 32])
    differences = presses.normalised(pre)
    for condition in range(conditions):
        free = condition < NOISE_FREE_SHARE * conditions
        decibel = np.inf if free else float(rng.uniform(*DECIBEL))
        noise = max(10 ** (-decibel / 20), LEAST_NOISE)
        low, high = DRIFT
        share = rng.uniform()
        drift = Drift(
            *(a ** (1 - share) * b**share for a, b in zip(vars(low).values(), vars(high).values(), strict=True))
        )
        tare = noise * rng.standard_normal((TARE_FRAMES, pre.measurements))
        # As services estimate it: each channel's own scatter, shrunk to the common one.
        sigma = np.sqrt((64 * tare.var(0, ddof=1) + 32 * np.median(tare.var(0, ddof=1))) / 96)
        operator = pre.condition(sigma, drift=drift)
        chosen = rng.choice(len(presses.shapes), min(EACH, len(presses.shapes)), replace=False)
        true = differences[chosen]
        d = true + (1 + true) * noise * rng.standard_normal(true.shape) - tare.mean(0)
        limit = operator.threshold(FALSE_ALARMS, TARE_FRAMES)
        touched = np.array([operator.score(row) > limit for row in d])
        yield decibel, float(np.sqrt((sigma**2).mean())), operator, chosen[touched], d[touched]


def see(
    presses: SolvedPresses, pre: PreReconstructor, network: Predict, seed: int = 4, conditions: int = CONDITIONS
) -> Sightings:
    """What the network shows of the presses under each of `scans`; undetected presses are left out."""
    index, decibels, found = [], [], []
    for decibel, rms, operator, chosen, d in scans(presses, pre, seed, conditions):
        stack, context, scale = operator.stacks(d)
        drop, log_sigma, _ = network(stack, context)
        factors = scale[:, None, None]
        for k, image, spread in zip(chosen, drop[:, 0] * factors, np.exp(log_sigma[:, 0]) * factors, strict=True):
            one = look(image, spread, rms)
            if one is not None:
                index.append(k)
                decibels.append(decibel)
                found.append(one)
    columns = np.array(found).T
    return Sightings(np.array(index), np.array(decibels), ImageFeatures(*columns))


def look(image: Array, sigma: Array, noise: float) -> tuple[float, ...] | None:
    """The numbers of ImageFeatures for the strongest touch of an image, as the service's segmentation measures it."""
    n, smooth = len(image), ndimage.gaussian_filter(image, 1.0)
    top = float(smooth.max())
    if not top > FLOOR:
        return None
    pixel = 2.0 / n
    mask = smooth > 0.5 * top
    values = image[mask]
    peak = float(values[values >= PLATEAU * values.max()].mean())
    iy, ix = np.nonzero(mask)
    x, y = (ix.mean() + 0.5) * pixel - 1, (iy.mean() + 0.5) * pixel - 1
    integral = float(image[smooth > 0.5 * max(FLOOR, RELATIVE_FLOOR * float(image.max()))].sum()) * pixel**2
    area = len(values) * pixel**2
    return peak, float(sigma[mask].mean()), integral, area, 1 - max(abs(x), abs(y)), noise


def truths(presses: SolvedPresses) -> dict[str, Array]:
    shapes = presses.touches()
    drop = np.array([s.drop for s in shapes])
    return {"peak": drop, "integral": np.array([s.integral for s in shapes]), "known": drop}


def rows_of(name: str, presses: SolvedPresses, index: Array) -> Array:
    """Which sightings an estimate is fitted to: a known indenter is round and flat."""
    return presses.shapes[index, 0] == 1 if name == "known" else np.ones(len(index), dtype=bool)


def problem(name: str, presses: SolvedPresses, s: Sightings) -> tuple[Array, Array, Array]:
    """(features, estimates, truths) of the sightings that an estimate is about."""
    s = s[rows_of(name, presses, s.index)]
    area = np.array([t.area for t in presses.touches()])[s.index] if name == "known" else None
    return features(name, s.seen, area), estimate(name, s.seen, area), truths(presses)[name][s.index]


def fitted(presses: SolvedPresses, s: Sightings, network: str) -> dict[str, Any]:
    """For the manifest: a map of each estimate, and how it covers presses that it was not fitted to."""
    said: dict[str, Any] = {}
    for name in ESTIMATES:
        x, estimated, truth = problem(name, presses, s)
        press = s.index[rows_of(name, presses, s.index)]
        decibel = s.decibel[rows_of(name, presses, s.index)]
        factor, sigma = np.ones(len(x)), np.ones(len(x))
        for fold in range(FOLDS):
            out = press % FOLDS == fold  # all sightings of a press together
            held = fit(x[~out], estimated[~out], truth[~out], name == "known")
            factor[out], sigma[out] = held(x[out])
        whole = fit(x, estimated, truth, name == "known", network)
        said[name] = {**whole.to_dict(), "held_out": coverage(estimated * factor, sigma, truth, decibel)}
    return said


def coverage(estimated: Array, sigma: Array, truth: Array, decibel: Array) -> dict[str, float]:
    """Share of presses within one sigma, and the mean relative error, by noise."""
    error = np.abs(estimated / truth - 1)
    inside = np.abs(estimated - truth) <= sigma * estimated
    groups = {"all": decibel > 0, "noise-free": np.isinf(decibel)}
    groups |= {f"{a}-{a + 10} dB": (decibel >= a) & (decibel < a + 10) for a in (60, 70, 80)}
    found = {}
    for label, rows in groups.items():
        if rows.any():
            found[f"within, {label}"] = round(float(inside[rows].mean()), 3)
            found[f"error, {label}"] = round(float(error[rows].mean()), 4)
    return found


def _answers() -> Callable[[bytes | Path], Predict]:
    """An ONNX file, or its content, as a function of arrays. Loads PyTorch, which solving presses does without."""
    from models.evaluation import predict
    from models.export import session

    return lambda file: predict(session(file))


def uncertainty(
    skin: geometry.SkinGeometry,
    pre: PreReconstructor,
    networks: dict[str, bytes],
    n: int = PRESSES,
    cache: Path | None = None,
) -> dict[str, dict[str, Any]]:
    """variant -> what `manifest["network"][variant]["uncertainty"]` says. About a minute."""
    answer = _answers()
    presses = solve(skin, n, cache=cache)
    found = {}
    for variant, content in networks.items():
        sightings = see(presses, pre, answer(content))
        found[variant] = {
            **fitted(presses, sightings, hashlib.sha256(content).hexdigest()),
            "presses": len(presses.shapes),
            "sightings": len(sightings.index),
            "mesh": MESH,
            "prior": {k: list(v) for k, v in vars(PRIOR).items() if k in ("radius", "drop")},
        }
        print(f"{variant}: {_in_words(found[variant])}", flush=True)
    return found


def _in_words(said: dict[str, Any]) -> str:
    """How wrong each estimate is on presses that it was not fitted to, and whether it knows."""
    parts = []
    for name, of in (("peak", "peak drop"), ("integral", "integrated drop"), ("known", "peak drop, indenter known")):
        held = said[name]["held_out"]
        parts.append(f"{of} off by {100 * held['error, all']:.0f} % ({100 * held['within, all']:.0f} % within sigma)")
    return ", ".join(parts)


def check(shipped: bundle.Bundle, seed: int, n: int) -> None:
    """Prints how the shipped maps cover fresh presses."""
    answer = _answers()
    presses = solve(geometry.load(shipped.name), n, seed)
    for variant, file in bundle.NETWORKS.items():
        path = shipped.network_path(variant)
        known: dict[str, Map] = maps(shipped.manifest, variant, file)
        if path is None or not known:
            print(f"{variant}: {'no network' if path is None else 'no maps for this network file'}")
            continue
        sightings = see(presses, shipped.prereconstructor(), answer(path), seed)
        for name, one in known.items():
            x, estimated, truth = problem(name, presses, sightings)
            factor, sigma = one(x)
            decibel = sightings.decibel[rows_of(name, presses, sightings.index)]
            print(f"{variant} {name}: {coverage(estimated * factor, sigma, truth, decibel)}", flush=True)


def write(shipped: bundle.Bundle) -> bundle.Bundle:
    """Fits the maps of a bundle's networks and writes them into its manifest; nothing else changes."""
    networks = {v: (shipped.path / f).read_bytes() for v, f in bundle.NETWORKS.items() if shipped.network_path(v)}
    cache = Path(tempfile.gettempdir()) / f"eitskin-presses-{shipped.name}.npz"
    found = uncertainty(geometry.load(shipped.name), shipped.prereconstructor(), networks, cache=cache)
    said = {v: {**shipped.manifest["network"][v], "uncertainty": found[v]} for v in networks}
    network = {**shipped.manifest["network"], **said}
    return bundle.replace_manifest(shipped.path, {**shipped.manifest, "network": network})


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m models.calibrate", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("bundle", help="a bundle by name or path")
    parser.add_argument("--write", action="store_true", help="fit anew and write the bundle's manifest")
    parser.add_argument("--presses", type=int, default=1000, help="fresh ones to check with")
    parser.add_argument("--seed", type=int, default=17, help="of the fresh ones")
    args = parser.parse_args(argv)
    shipped = bundle.Bundle.load(args.bundle)
    if args.write:
        print(f"{shipped.path}: {write(shipped).hash[:12]}")
    else:
        check(shipped, args.seed, args.presses)


if __name__ == "__main__":
    command.run("models.calibrate", main)
