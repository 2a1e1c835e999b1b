"""Skins that are not the skin of their file, with and without calibration from their untouched frames.

    skin bench mismatch [--skins 3] [--touches 4] [--levels none 70] [--only anisotropy5 ...] [--quick]

Each mismatch of models/mismatch.py is drawn for several skins, solved on a mesh that neither training nor inverse uses,
touched by each of the five shapes, and goes through `skin reconstruct` with 64 untouched frames. A touch is what
exceeds half the image's peak; the truth of a blurred one is its drop above half its own peak. Prints, beside the
targets, mean IoU, the force's median error and the share of valid rows; writes mismatch.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench.accuracy.frames import Level
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from models import metrics
from models.bundle import Bundle
from models.calibration_file import found_by, unpack
from models.command import whole
from models.fit_calibration import calibrate
from models.mismatch import NAMED, Mismatch, MismatchedSheet, soft_drop
from models.prereconstruction import noise_of_frames
from models.scenes import TARGETS, random_scene
from models.shapes import CLASSES, Shape
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

Array = NDArray[np.float64]

SKIN = "square16"
MESH = {"full": "reference", "quick": "stub"}
LEVELS = ("none", "70")
UNTOUCHED = 64
SCORED_AT = 96
METRES_PER_UNIT = 0.05  # of square16
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


@dataclass(frozen=True, eq=False)
class SkinFrames:
    """Noise-free frames of one mismatched skin: z0 (K,), z (N, K) ohm of `touches`."""

    mismatch: Mismatch
    metres_per_unit: float
    touches: list[list[Shape]]
    z0: Array
    z: Array


def solved(mismatch: Mismatch, touches: int, seed: int, mesh: str) -> SkinFrames:
    rng = np.random.default_rng([seed, 91])
    scenes = [random_scene(rng, replace(TARGETS, kinds=(kind,)), n=1) for _ in range(touches) for kind in CLASSES]
    sheet = MismatchedSheet(SKIN, mismatch.seeded(seed), mesh)
    z = np.array([np.abs(sheet.solve(scene).impedances()) for scene in scenes])
    return SkinFrames(mismatch, sheet.skin.metres_per_unit, scenes, np.abs(sheet.solve().impedances()), z)


def truth(frames: SkinFrames, touch: list[Shape]) -> tuple[NDArray[np.bool_], float]:
    """Which pixels are touched, and the force [N]."""
    force = max(shape.force(METRES_PER_UNIT) for shape in touch)
    if not frames.mismatch.blur_m:
        return np.any([s.fraction(SCORED_AT, covered=True) > 0.5 for s in touch], axis=0), force
    drop = soft_drop(touch, frames.mismatch.blur_m / frames.metres_per_unit, SCORED_AT)
    return drop > 0.5 * drop.max(), force


def scored(frames: SkinFrames, level: str, bundle: Bundle, calibrated: bool, seed: int) -> list[dict[str, Any]]:
    """One row a touch."""
    noise, rng = Level(level), np.random.default_rng([seed, *level.encode()])
    untouched = frames.z0 * (1 + noise.share * rng.standard_normal((UNTOUCHED, len(frames.z0))))
    measured = frames.z * (1 + noise.share * rng.standard_normal(frames.z.shape))
    if calibrated:
        sigma = noise_of_frames(untouched, untouched.mean(0)) / np.sqrt(UNTOUCHED)
        bundle = unpack(calibrate(bundle, untouched.mean(0), sigma), bundle)
    data = Input(measurements=measured, untouched=untouched, reference=None)
    out = reconstruct(data, Skin(port="stub", bundle=SKIN, frame_id="bench"), bundle, age_s=1.0)
    said = found_by(bundle) or {}
    rows = []
    for k, touch in enumerate(frames.touches):
        image, (mask, force) = out["image"][k], truth(frames, touch)
        found = float(out["force"][k, 0])
        rows.append(
            {
                "iou": metrics.iou(image > 0.5 * max(image.max(), 1e-9), mask)[0],
                "force_error": abs(found / force - 1) if np.isfinite(found) else 1.0,
                "valid": bool(out["valid"][k]),
                "remarks": said.get("remarks", []),
            }
        )
    return rows


def measured(name: str, level: str, skins: Sequence[SkinFrames], bundle: Bundle, seed: int) -> dict[str, Any]:
    """Figures of one mismatch at one noise level."""
    row: dict[str, Any] = {"mismatch": name, "level": level, "skins": len(skins)}
    for place, calibrated in (("file", False), ("calibrated", True)):
        found = [one for frames in skins for one in scored(frames, level, bundle, calibrated, seed)]
        row[place] = {
            "mean_iou": float(np.mean([one["iou"] for one in found])),
            "force_error_%": 100 * float(np.median([one["force_error"] for one in found])),
            "valid_%": 100 * float(np.mean([one["valid"] for one in found])),
            "touches": len(found),
        }
        if calibrated:
            row["remarks"] = sorted({remark for one in found for remark in one["remarks"]})
    return row


def goals(rows: Sequence[dict[str, Any]]) -> list[Goal]:
    found = []
    for row in rows:
        wanted = WANTED[row["mismatch"]][LEVELS.index(row["level"])] if row["level"] in LEVELS else None
        least = row["file"]["mean_iou"] if wanted is None else wanted
        title = Level(row["level"]).title
        gate = row["file"]["mean_iou"] - 0.01  # a short run: never worse than without
        found.append(
            Goal(f"{row['mismatch']}, {title}: mean IoU", row["calibrated"]["mean_iou"], at_least=least, gate=gate)
        )
        if wanted is not None:
            found.append(Goal(f"{row['mismatch']}, {title}: valid, %", row["calibrated"]["valid_%"], at_least=99.0))
    return found


def shown(rows: Sequence[dict[str, Any]]) -> Table:
    table = Table(title="mismatched skins", title_justify="left")
    for heading in ("mismatch", "noise", "mean IoU", "calibrated", "target", "force error, %", "", "valid, %", ""):
        table.add_column(heading, justify="left" if heading in ("mismatch", "noise") else "right")
    for row in rows:
        file, own = row["file"], row["calibrated"]
        wanted = WANTED[row["mismatch"]][LEVELS.index(row["level"])] if row["level"] in LEVELS else None
        table.add_row(
            row["mismatch"],
            Level(row["level"]).title,
            f"{file['mean_iou']:.3f}",
            f"{own['mean_iou']:.3f}",
            "no worse" if wanted is None else f"{wanted:g}",
            f"{file['force_error_%']:.0f}",
            f"{own['force_error_%']:.0f}",
            f"{file['valid_%']:.0f}",
            f"{own['valid_%']:.0f}",
        )
    return table


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench mismatch", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--quick", action="store_true", help="one skin each, one touch of each shape, a coarser mesh")
    parser.add_argument("--skins", type=whole(), default=3, help="drawn of each mismatch")
    parser.add_argument("--touches", type=whole(), default=4, help="of each shape on each skin")
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), help="dB, or none")
    parser.add_argument("--only", nargs="+", default=list(WANTED), choices=list(NAMED), help="some mismatches")
    parser.add_argument("--mesh", choices=("reference", "stub"), help="that frames are solved on")
    parser.add_argument("--bundle", default=SKIN)
    parser.add_argument("--seed", type=whole(0), default=1)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    skins, touches = (1, 1) if args.quick else (args.skins, args.touches)
    mesh = args.mesh or MESH["quick" if args.quick else "full"]
    bundle, rows, console = Bundle.load(args.bundle), [], Console()
    for name in args.only:
        drawn = [solved(NAMED[name], touches, args.seed + k, mesh) for k in range(skins)]
        for level in args.levels:
            rows.append(measured(name, level, drawn, bundle, args.seed))
            own, file = rows[-1]["calibrated"], rows[-1]["file"]
            console.print(f"{name}, {level}: {file['mean_iou']:.3f} -> {own['mean_iou']:.3f}", style="dim")
    console.print(shown(rows))
    for row in rows:
        if row["level"] == args.levels[0] and row["remarks"]:
            console.print(f"{row['mismatch']}: {'; '.join(row['remarks'][:3])}")
    wanted = [goal.to_dict() for goal in goals(rows)]
    said = {"mesh": mesh, "skins": skins, "touches": touches * len(CLASSES), "bundle_hash": bundle.hash}
    write_json(args.out / "mismatch.json", provenance("mismatch", argv) | said | {"targets": wanted, "rows": rows})
    return 0 if all(goal["passed"] for goal in wanted) else 1


if __name__ == "__main__":
    raise SystemExit(main())
