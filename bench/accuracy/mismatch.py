"""Skins that are not the skin of their file, with and without the fit of their mounting from untouched rows.

Each mismatch of models/mismatch.py is drawn for several skins, solved on a mesh that neither training nor inverse uses,
touched by each of the five shapes, and goes through `skin reconstruct`. A touch is what exceeds half the image's peak;
the truth of a blurred one is its drop above half its own peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.accuracy.frames import SKIN, Level
from bench.accuracy.scores import METRES_PER_UNIT
from bench.goals import Goal, titled
from models import metrics
from models.bundle import Bundle
from models.mismatch import NAMED, Mismatch, MismatchedSheet, soft_drop
from models.scenes import TARGETS, random_scene
from models.shapes import CLASSES, Array, Shape
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

LEVELS = ("none", "70")
UNTOUCHED = 64
SCORED_AT = 96
# mean IoU with calibration, noise-free and at 70 dB; None: no worse than without
WANTED: dict[str, tuple[float | None, float | None]] = {
    "none": (0.93, 0.85),
    "anisotropy5": (0.93, 0.85),
    "field5": (0.925, 0.85),
    "field10": (0.90, 0.85),
    "shift1": (0.925, 0.85),
    "contacts": (0.93, 0.85),
    "mild": (0.91, 0.85),
    "blur": (0.90, 0.84),
    "anisotropy15": (None, None),
    "shift3": (None, None),
}
QUICK = ("anisotropy5", "mild")


@dataclass(frozen=True, eq=False)
class SkinFrames:
    """Noise-free frames of one mismatched skin: z0 (K,), z (N, K) ohm of `touches`."""

    mismatch: Mismatch
    touches: list[list[Shape]]
    z0: Array
    z: Array


def solved(mismatch: Mismatch, touches: int, seed: int, mesh: str) -> SkinFrames:
    rng = np.random.default_rng([seed, 91])
    scenes = [random_scene(rng, replace(TARGETS, kinds=(kind,)), n=1) for _ in range(touches) for kind in CLASSES]
    sheet = MismatchedSheet(SKIN, mismatch.seeded(seed), mesh)
    z = np.array([np.abs(sheet.solve(scene).impedances()) for scene in scenes])
    return SkinFrames(mismatch, scenes, np.abs(sheet.solve().impedances()), z)


def truth(frames: SkinFrames, touch: list[Shape]) -> tuple[NDArray[np.bool_], float]:
    """Which pixels are touched, and the force [N]."""
    force = max(shape.force(METRES_PER_UNIT) for shape in touch)
    if not frames.mismatch.blur_m:
        return np.any([s.fraction(SCORED_AT, covered=True) > 0.5 for s in touch], axis=0), force
    drop = soft_drop(touch, frames.mismatch.blur_m / METRES_PER_UNIT, SCORED_AT)
    return drop > 0.5 * drop.max(), force


def scored(frames: SkinFrames, level: str, bundle: Bundle, calibrate: bool, seed: int) -> list[dict[str, float]]:
    """One row a touch."""
    noise, rng = Level(level), np.random.default_rng([seed, *level.encode()])
    untouched = frames.z0 * (1 + noise.share * rng.standard_normal((UNTOUCHED, len(frames.z0))))
    measured = frames.z * (1 + noise.share * rng.standard_normal(frames.z.shape))
    skin = Skin(port="stub", bundle=SKIN, frame_id="bench")
    out = reconstruct(Input(measured, untouched, None), skin, bundle, calibrate=calibrate)
    rows = []
    for k, touch in enumerate(frames.touches):
        image, (mask, force) = out["image"][k], truth(frames, touch)
        found = float(out["force"][k, 0])
        iou = metrics.iou(image > 0.5 * max(image.max(), 1e-9), mask)[0]
        error = abs(found / force - 1) if np.isfinite(found) else 1.0
        rows.append({"iou": iou, "force_error": error, "valid": float(out["valid"][k])})
    return rows


def run(names: Sequence[str], skins: int, touches: int, levels: Sequence[str], mesh: str, seed: int) -> dict[str, Any]:
    """Figures of each mismatch at each noise level."""
    bundle, rows = Bundle.load(SKIN), []
    for name in names:
        drawn = [solved(NAMED[name], touches, seed + k, mesh) for k in range(skins)]
        for level in levels:
            row: dict[str, Any] = {"mismatch": name, "level": level, "skins": skins}
            for place, calibrate in (("file", False), ("calibrated", True)):
                found = [one for frames in drawn for one in scored(frames, level, bundle, calibrate, seed)]
                row[place] = {
                    "mean_iou": float(np.mean([one["iou"] for one in found])),
                    "force_error_%": 100 * float(np.median([one["force_error"] for one in found])),
                    "valid_%": 100 * float(np.mean([one["valid"] for one in found])),
                    "touches": len(found),
                }
            rows.append(row)
    return {"mesh": mesh, "rows": rows}


def wanted(row: dict[str, Any]) -> float | None:
    return WANTED[row["mismatch"]][LEVELS.index(row["level"])] if row["level"] in LEVELS else None


def goals(found: dict[str, Any]) -> list[Goal]:
    return [
        Goal(
            f"mismatch {row['mismatch']}, {Level(row['level']).title}: mean IoU, calibrated",
            row["calibrated"]["mean_iou"],
            at_least=row["file"]["mean_iou"] if wanted(row) is None else wanted(row),
        )
        for row in found["rows"]
    ]


def table(found: dict[str, Any]) -> Table:
    title = f"mismatched skins, {found['mesh']} mesh: as the bundle's file says, and mounting fitted"
    headings = "mismatch", "noise", "mean IoU", "fitted", "force error, %", "fitted", "valid, %", "fitted"
    made = titled(title, headings, 2)
    for row in found["rows"]:
        both = row["file"], row["calibrated"]
        cells = [form.format(of[key]) for key, form in FIGURES for of in both]
        made.add_row(row["mismatch"], Level(row["level"]).title, *cells)
    return made


FIGURES = (("mean_iou", "{:.3f}"), ("force_error_%", "{:.0f}"), ("valid_%", "{:.0f}"))
