"""Figures of one method at one noise level, from its images of the test frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.accuracy import frames as _frames
from bench.accuracy.frames import Frames
from models import metrics
from models.shapes import Array

Row = dict[str, Any]


def score_mask(image: Array, frames: Frames, k: int) -> float:
    """Mean IoU alone."""
    scene = frames.scene(k)
    truth = np.any([s.fraction(len(image), covered=True) > 0.5 for s in scene], axis=0)
    return metrics.iou(np.any(metrics.touch_masks(image, scene), axis=0), truth)[0]


def summarise(images: Array, frames: Frames, index: NDArray[np.int64], gain: tuple[float, float] | None) -> Row:
    """Figures of a method at one noise level. gain: for the peak, and for the integrated drop."""
    group = frames.group[index]
    rows = [
        {} if g.startswith("ldci") else metrics.score(image, frames.scene(k))
        for image, k, g in zip(images, index, group, strict=True)
    ]
    peak_gain, integral_gain = gain or (1.0, 1.0)

    def column(name: str, *groups: str) -> Array:
        return np.array([r[name] for r, g in zip(rows, group, strict=True) if g in groups and name in r])

    position = metrics.of_side(column("position", "shapes", "hertz", "force"))
    force = np.flatnonzero(np.isin(group, ["force"]))
    scenes = [frames.scene(int(index[k]))[0] for k in force]
    peaks, sums = (np.array([f(images[k]) for k in force]) for f in (np.max, metrics.integrated))
    force_error = metrics.relative_error(peaks * peak_gain, [s.drop for s in scenes])
    integral_error = metrics.relative_error(sums * integral_gain, [s.integral for s in scenes])
    out: Row = {
        "frames": int(np.count_nonzero(~np.char.startswith(group, "ldci"))),
        "mean_iou": column("mean_iou", "shapes").mean(),
        "contact_iou": column("contact_iou", "shapes").mean(),
        "mean_iou_eidors": column("mean_iou", "eidors").mean() if (group == "eidors").any() else None,
        "position_%": position.mean(),
        "position_rms_%": np.sqrt((position**2).mean()),
        "position_p95_%": np.percentile(position, 95),
        "force_%": force_error.mean(),
        "force_rms_%": np.sqrt((force_error**2).mean()),
        "integral_%": integral_error.mean(),
        "integral_rms_%": np.sqrt((integral_error**2).mean()),
        "correlation": column("correlation", "shapes").mean(),
        "ssim": column("ssim", "shapes").mean(),
        "count_%": 100 * np.mean(_right(rows, group)),
    }
    spread = {
        "mean_iou": column("mean_iou", "shapes"),
        "contact_iou": column("contact_iou", "shapes"),
        "position_%": position,
        "force_%": force_error,
        "integral_%": integral_error,
    }
    out |= {f"{name}_se": standard_error(values) for name, values in spread.items()}
    for name in ("AR", "PE", "RES", "SD", "RNG"):
        out[f"greit_{name}"] = column(f"greit_{name}", "shapes").mean()
    out.update(_ldci(images.max((1, 2)), group))
    apart = np.flatnonzero(group == "apart")
    if apart.size > 3:
        gaps = [gap_of(frames, int(index[k])) for k in apart]
        out["separation"] = metrics.separation(gaps, [rows[k]["count"] == 2 for k in apart])
    return {k: None if v is None else float(v) for k, v in out.items()}


def standard_error(values: Array) -> float:
    """Of the mean; NaN of fewer than two."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")


def gap_of(frames: Frames, k: int) -> float:
    a, b = frames.scene(k)
    return float(np.hypot(a.x - b.x, a.y - b.y) - a.radius - b.radius)


def _right(rows: list[dict[str, float]], group: NDArray[np.str_]) -> list[bool]:
    wanted = {"two": 2, "three": 3}
    return [r["count"] == wanted[g] for r, g in zip(rows, group, strict=True) if g in wanted]


def _ldci(peaks: Array, group: NDArray[np.str_]) -> dict[str, float | None]:
    names = [f"ldci-{spacing}-{drop}" for spacing, drop in _frames.LDCI]
    return {name: metrics.ldci(peaks[group == name]) if (group == name).sum() == 49 else None for name in names}
