"""Accuracy against what a skin, a board and a mesh may be: noise, unit, background, contacts, electrodes, meshes.

Eight touches, solved on a mesh that neither training nor inverse uses unless the condition is another one, each tared
as it is and run through `skin reconstruct` without a fit of the mounting.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.table import Table

from bench.accuracy.frames import NOISE_FREE, SKIN
from bench.accuracy.scores import METRES_PER_UNIT
from bench.goals import titled
from models import geometry, meshing, metrics
from models.bundle import Bundle
from models.forward import ForwardModel, shared
from models.shapes import Array, Shape
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

UNTOUCHED = 64
USUAL_DB = 70.0
SPACING = 0.5  # model units between neighbouring electrodes of a side
TOUCHES = (
    Shape("circle", 0.0, 0.0, 0.2, 0.15),
    Shape("circle", 0.4, 0.3, 0.25, 0.3),
    Shape("square", -0.5, 0.45, 0.3, 0.4, 0.5),
    Shape("L", -0.3, -0.4, 0.4, 0.3, 0.4),
    Shape("triangle", 0.35, -0.5, 0.35, 0.35, 0.9),
    Shape("rectangle", -0.1, 0.5, 0.35, 0.25, 0.6, 2.0),
    Shape("circle", 0.7, -0.65, 0.2, 0.5),
    Shape("circle", -0.7, 0.05, 0.15, 0.2),
)
COARSE = meshing.Grading(edge=8e-3, growth=0.55, interior=0.08, offset=0.47)
FINE = meshing.Grading(edge=2e-4, growth=0.28, interior=0.021, offset=0.53)


@dataclass(frozen=True, eq=False)
class WorseCase:
    """One condition: noise-free |Z| (N, K) of the touches and (K,) untouched, in a skin's own unit."""

    kind: str
    name: str
    z: Array
    z0: Array
    snr_db: float = USUAL_DB


def solved(model: ForwardModel, background: float = 1.0, contact: ArrayLike | None = None) -> tuple[Array, Array]:
    z = [model.solve(model.touched([t], background), contact).impedances() for t in TOUCHES]
    return np.abs(np.array(z)), np.abs(model.solve(background, contact).impedances())


def cases(quick: bool, seed: int) -> Iterator[WorseCase]:
    model, rng = shared(SKIN, "stub"), np.random.default_rng([seed, 41])
    usual = solved(model)
    for decibel in (50, 80) if quick else (30, 40, 50, 60, 70, 80, 90, 100):
        yield WorseCase("noise", f"{decibel} dB", *usual, snr_db=decibel)
    for exponent in (-9, 9) if quick else (-9, -3, 3, 9):
        yield WorseCase("unit", f"x 1e{exponent:+d}", usual[0] * 10.0**exponent, usual[1] * 10.0**exponent)
    for value in (0.2,) if quick else (0.2, 0.6, 1.7, 5.0):
        yield WorseCase("sheet", f"{value:g} S", *solved(model, value))
    impedance = model.contact_impedance
    for factor in (10.0,) if quick else (0.1, 0.3, 3.0, 10.0):
        yield WorseCase("contact impedance", f"x {factor:g}", *solved(model, contact=factor * impedance))
    each = impedance * 10.0 ** rng.uniform(-1, 1, len(impedance))
    yield WorseCase("contact impedance", "each x 0.1 to 10", *solved(model, contact=each))
    skin = geometry.load(SKIN)
    for percent in (2,) if quick else (1, 2, 3, 5):
        moved = skin.moved(0.01 * percent * SPACING * rng.standard_normal(skin.n_electrodes))
        found = solved(ForwardModel(moved, mesh="inverse" if quick else "stub"))
        yield WorseCase("electrodes off", f"{percent} % of the spacing", *found)
    for name, mesh in (("coarse", COARSE), *(() if quick else (("training", "training"), ("fine", FINE)))):
        finer = ForwardModel(SKIN, mesh=mesh)
        yield WorseCase("mesh", f"{name}, {finer.n_elements} elements", *solved(finer), snr_db=np.inf)


def judged(case: WorseCase, bundle: Bundle, draws: int, seed: int) -> dict[str, Any]:
    """Mean errors of the single strongest contact of each noisy row, valid or not."""
    share, rng = max(10 ** (-case.snr_db / 20), NOISE_FREE), np.random.default_rng([seed, 42])
    untouched = case.z0 * (1 + share * rng.standard_normal((UNTOUCHED, len(case.z0))))
    clean = np.repeat(case.z, draws, axis=0)
    rows = clean * (1 + share * rng.standard_normal(clean.shape))
    out = reconstruct(Input(rows, untouched, None), Skin(port="stub", bundle=SKIN), bundle)
    touches = [touch for touch in TOUCHES for _ in range(draws)]
    seen = out["count"] > 0
    centroids = METRES_PER_UNIT * np.array([t.centroid for t in touches])
    off = np.linalg.norm(out["position"][:, 0] - centroids, axis=1)[seen] / METRES_PER_UNIT
    newtons = np.array([t.force(METRES_PER_UNIT) for t in touches])
    force = metrics.relative_error(out["force"][:, 0], newtons)
    return {
        "kind": case.kind,
        "case": case.name,
        "rows": len(rows),
        "valid_%": 100 * float(out["valid"].mean()),
        "missed": int((~seen).sum()),
        "position_%": float(metrics.of_side(off).mean()) if seen.any() else None,
        "position_max_%": float(metrics.of_side(off).max()) if seen.any() else None,
        "force_%": float(np.nanmean(force)) if np.isfinite(force).any() else None,
    }


def run(quick: bool, seed: int) -> list[dict[str, Any]]:
    bundle = Bundle.load(SKIN)
    return [judged(case, bundle, 1 if quick else 6, seed) for case in cases(quick, seed)]


def table(rows: Sequence[dict[str, Any]]) -> Table:
    headings = "condition", "", "rows", "valid %", "not shown", "position, % of the side", "largest", "force %"
    made = titled("eight touches under worse conditions, 70 dB unless it says otherwise", headings, 2)
    for row in rows:
        cells = ["" if row[k] is None else f"{row[k]:.2f}" for k in ("position_%", "position_max_%", "force_%")]
        counts = str(row["rows"]), f"{row['valid_%']:.0f}", str(row["missed"])
        made.add_row(row["kind"], row["case"], *counts, *cells)
    return made
