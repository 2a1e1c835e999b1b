"""The second table of bench.real_presses: how well presses are found by N others, over several random splits."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from models.bundle import Bundle
from models.locator import NINETY, Locator
from services.calibration.locating import build, true_places
from services.calibration.presses import RegistrationError, part, read_presses
from services.calibration.registration import register
from services.recordings.npz_file import load_npz

SUPERPOSE, CONCENTRIC = "hydrogel_disc16", "hydrogel_vse_concentric"
CASES: tuple[tuple[str, int, float | None], ...] = (
    (SUPERPOSE, 10, 8.0),
    (SUPERPOSE, 100, 2.4),
    (SUPERPOSE, 300, None),
    (CONCENTRIC, 100, 4.0),
    (CONCENTRIC, 300, 2.9),
    (CONCENTRIC, 1000, 1.8),
)
"""File, presses that register the skin, target of the others' median error [mm]."""
DEPTH_TARGET_MM = 1.7
MOST_OTHERS = 400
CONFIDENTLY = 1.5  # times its 90 % ellipse: a press that is farther off was stated too surely


def splits(files: Mapping[str, Path], skin: str, count: int, most: int | None = None) -> list[dict[str, Any]]:
    """A row for each case whose file is there: the first presses of the file (of the concentric one, whose places are
    in no order, of a first shuffle), then random ones.
    """
    bundle = Bundle.load(skin)
    rows = []
    for name, presses, target in CASES:
        if not files[name].is_file() or (most is not None and presses > most):
            continue
        arrays = load_npz(files[name])
        n = len(arrays["xy"])
        orders = [np.arange(n) if name == SUPERPOSE else np.random.default_rng(1).permutation(n)]
        orders += [np.random.default_rng(seed).permutation(n) for seed in range(2, 1 + count)]
        each = [one(arrays, bundle, order, presses) for order in orders]
        rows.append({"file": name, "presses": presses, "target_mm": target, "splits": each})
    return rows


def one(arrays: Mapping[str, Any], bundle: Bundle, order: Any, presses: int) -> dict[str, Any]:
    """Registered on the first of this order, scored on those that follow. A refusal is a row too."""
    train = read_presses(part(arrays, order[:presses]), bundle)
    test = read_presses(part(arrays, order[presses : presses + MOST_OTHERS]), bundle)
    try:
        similarity = register(train, bundle).similarity
        made, _, crossed = build(train, similarity, bundle)
    except RegistrationError as why:
        return {"refused": str(why)}
    locator, places = Locator(made), true_places(test.xy, similarity)
    # Another part of one file of differences: in the unit that the skin was registered in.
    found = [locator.locate(d * train.unit / test.unit, train.noise) for d in test.difference]
    apart = np.array([[t[0].x, t[0].y] if t else similarity.offset * 0 for t in found]) - places
    distance = np.linalg.norm(apart, axis=1)
    beyond = np.array(
        [
            np.sqrt(a @ np.linalg.solve(t[0].covariance, a) / NINETY) if t else 0.0
            for t, a in zip(found, apart, strict=True)
        ]
    )
    seen = np.array([bool(t) for t in found])
    row: dict[str, Any] = {
        "median_mm": 1e3 * float(np.median(distance)),
        "p95_mm": 1e3 * float(np.percentile(distance, 95)),
        "in_90_percent_ellipse": float(np.mean(seen & (beyond <= 1.0))),
        "confidently_wrong": float(np.mean(beyond > CONFIDENTLY)),
        "counted_as_one": float(np.mean([len(t) == 1 for t in found])),
        "corrected": crossed.corrected,
    }
    if locator.quantity == "indentation_m" and test.value is not None:
        told = [t[0].value if t else np.nan for t in found]
        row["depth_mae_mm"] = 1e3 * float(np.nanmean(np.abs(np.array(told, float) - test.value)))
    return row


def print_splits(rows: list[dict[str, Any]]) -> None:
    print(
        f"\n{'registered on':30s} median mm: first  splits (spread)  target   p95 mm  in 90 % ellipse  "
        f"1.5 x beyond  one touch  depth MAE mm (target {DEPTH_TARGET_MM:g} on 100)"
    )
    for row in rows:
        good = [each for each in row["splits"] if "refused" not in each]
        for each in row["splits"]:
            if "refused" in each:
                print(f"{row['file']}, {row['presses']}: refused: {each['refused']}")
        if not good:
            continue
        median, p95, inside, wrong, single, depth = (
            np.array([each.get(name, np.nan) for each in good])
            for name in (
                "median_mm",
                "p95_mm",
                "in_90_percent_ellipse",
                "confidently_wrong",
                "counted_as_one",
                "depth_mae_mm",
            )
        )
        target = "-" if row["target_mm"] is None else f"{row['target_mm']:.1f}"
        told = f"{depth[np.isfinite(depth)].mean():.2f}" if np.isfinite(depth).any() else "-"
        name = f"{row['file']}, {row['presses']}"
        print(
            f"{name:30s} {median[0]:16.2f}  {median.mean():6.2f} ({median.std():.2f})"
            f"  {target:>8s} {p95.mean():8.1f} {100 * inside.mean():12.0f} % {100 * wrong.mean():10.1f} % "
            f"{100 * single.mean():9.1f} %  {told}"
        )
