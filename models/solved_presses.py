"""Presses that a network never saw, solved on a mesh that it was not trained on, and scans of them under noise.

`models.build` fits the temperature of the shape classes to them (models/class_temperature.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import track

from models import geometry
from models.forward import ForwardModel
from models.prereconstruction import TARE_FRAMES, Array, Drift, Operator, PreReconstructor
from models.scenes import Prior, random_shape
from models.shapes import KINDS, Shape
from protocol.whole_file import whole_file

PRIOR = Prior(radius=(0.08, 0.50), drop=(0.10, 0.50), tail=0.0)  # 1 to 5 N
MESH = "stub"  # no training sees it, and the accuracy benchmark uses another again
PRESSES, EACH = 1000, 150  # presses solved, and seen under each condition of noise
DECIBEL = (57.0, 95.0)
NOISE_FREE_SHARE = 0.25
DRIFT = Drift(2e-5, 1e-4), Drift(1e-4, 1e-3)  # from, to: what services allow for soon after an untouched frame
FALSE_ALARMS = 1e-7  # as services: what is no touch has no shape
LEAST_NOISE = 2e-6  # relative; less looks the same


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
        with whole_file(cache) as part:
            np.savez_compressed(part, shapes=rows, difference=difference, z0=z0, mesh=mesh)
    return SolvedPresses(rows, difference, z0)


def scans(
    presses: SolvedPresses, pre: PreReconstructor, seed: int, conditions: int
) -> Iterator[tuple[float, Operator, Array, Array]]:
    """The presses under noise from 57 dB to none, each condition with its own tare: decibel, operator, which presses
    were detected, and their differences (N, K).
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
        yield decibel, operator, chosen[touched], d[touched]
