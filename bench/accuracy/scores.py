"""Figures of one method at one noise level: of its images of the test frames, and of the contacts that it makes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.accuracy.frames import LDCI, SEVERAL, SINGLE, Frames
from models import metrics
from models.shapes import CLASSES, Array

Row = dict[str, Any]
METRES_PER_UNIT = 0.05  # of square16
LARGE = 0.25  # radius from which on shape classes are scored
FAR = 10.0  # per cent of the side: a contact that is so far off is told where nothing touches


def score_mask(image: Array, frames: Frames, k: int) -> float:
    """Mean IoU alone."""
    scene = frames.scene(k)
    truth = np.any([s.fraction(len(image), covered=True) > 0.5 for s in scene], axis=0)
    return metrics.iou(np.any(metrics.touch_masks(image, scene), axis=0), truth)[0]


def of_images(images: Array, frames: Frames, index: NDArray[np.int64], gain: tuple[float, float] | None = None) -> Row:
    """index: of the frames that the images are of. gain: for the peak, and for the integrated drop."""
    group = frames.group[index]
    rows = [
        {} if g.startswith("ldci") else metrics.score(image, frames.scene(k))
        for image, k, g in zip(images, index, group, strict=True)
    ]
    peak_gain, integral_gain = gain or (1.0, 1.0)

    def column(name: str, *groups: str) -> Array:
        return np.array([r[name] for r, g in zip(rows, group, strict=True) if g in groups and name in r])

    force = np.flatnonzero(np.isin(group, ["force"]))
    scenes = [frames.scene(int(index[k]))[0] for k in force]
    peaks, sums = (np.array([f(images[k]) for k in force]) for f in (np.max, metrics.integrated))
    values = {
        "mean_iou": column("mean_iou", "shapes"),
        "contact_iou": column("contact_iou", "shapes"),
        "position_%": metrics.of_side(column("position", *SINGLE)),
        "force_%": metrics.relative_error(peaks * peak_gain, [s.drop for s in scenes]),
        "integral_%": metrics.relative_error(sums * integral_gain, [s.integral for s in scenes]),
    }
    row: Row = {"frames": int(np.count_nonzero(~np.char.startswith(group, "ldci")))}
    row |= {name: float(of.mean()) for name, of in values.items()}
    row |= {f"{name}_se": standard_error(of) for name, of in values.items()}
    row |= {name.replace("%", "rms_%"): rms(of) for name, of in values.items() if name.endswith("%")}
    row["position_p95_%"] = float(np.percentile(values["position_%"], 95))
    for name in ("correlation", "ssim"):
        row[name] = float(column(name, "shapes").mean())
    if (group == "eidors").any():
        row["mean_iou_eidors"] = float(column("mean_iou", "eidors").mean())
    row |= counts(np.array([int(r.get("count", 0)) for r in rows]), group)
    for spacing, drop in LDCI:
        name = f"ldci-{spacing}-{drop}"
        mine = images[group == name]
        row[name] = metrics.ldci(mine.max((1, 2))) if len(mine) == 49 else None
    return row


def counts(counted: NDArray[np.int64], group: NDArray[np.str_]) -> Row:
    """Shares of frames whose touches are counted right: of two or three together, and of one, two, three and four."""
    wanted = {**dict.fromkeys(SINGLE, 1), **SEVERAL}
    right = np.array([wanted.get(str(g)) == n for g, n in zip(group, counted, strict=True)])
    row: Row = {}
    for key, groups in (
        ("count_%", ("two", "three")),
        ("single_%", SINGLE),
        *((f"{name}_%", (name,)) for name in SEVERAL),
    ):
        some = np.isin(group, groups)
        row[key] = 100 * float(right[some].mean()) if some.any() else None
    return row


def of_contacts(found: dict[str, Array], frames: Frames) -> Row:
    """Position, force, count and shape as `skin reconstruct` gives them; of touches that are shown, and how many are
    not.
    """
    singles = [k for k in frames.of(*SINGLE) if found["count"][k] >= 1]
    missed = len(frames.of(*SINGLE)) - len(singles)
    off = [np.hypot(*(found["position"][k, 0] / METRES_PER_UNIT - frames.scene(k)[0].centroid)) for k in singles]
    distance = metrics.of_side(np.array(off or [np.nan]))
    newton = {k: frames.scene(k)[0].force(METRES_PER_UNIT) for k in singles}
    force = [k for k in frames.of("force") if np.isfinite(found["force"][k, 0])]
    errors = metrics.relative_error([found["force"][k, 0] for k in force], [newton[k] for k in force])
    within = [abs(found["force"][k, 0] - newton[k]) <= found["force_sigma"][k, 0] for k in singles]
    large = [k for k in singles if frames.group[k] == "shapes" and frames.scene(k)[0].radius >= LARGE]
    named = np.array([CLASSES[frames.scene(k)[0].shape_class] == str(found["shape"][k, 0]) for k in large], dtype=float)
    return {
        **counts(found["count"].astype(int), frames.group),
        "missed": missed,
        "far": int((distance > FAR).sum()),
        "not_valid": int((~found["valid"][frames.of(*SINGLE, *SEVERAL)].astype(bool)).sum()),
        "position_%": float(distance.mean()),
        "position_%_se": standard_error(distance),
        "position_rms_%": rms(distance),
        "position_p95_%": float(np.percentile(distance, 95)),
        "force_%": float(errors.mean()) if len(errors) else None,
        "force_%_se": standard_error(errors),
        "force_rms_%": rms(errors),
        "force_within_%": 100 * float(np.mean(within)) if within else None,
        "shape_%": 100 * float(named.mean()) if len(named) else None,
        "shape_%_se": 100 * standard_error(named),
    }


def standard_error(values: Array) -> float:
    """Of the mean; NaN of fewer than two."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else float("nan")
