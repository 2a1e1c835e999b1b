"""How often the truth lies in the intervals that contacts and images state, and what rows come to."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table

from models.shapes import KINDS, Array, Shape

INTERVALS = {68: (1.0, 2.279), 90: (1.645, 4.605)}  # sd of one figure; squared distance of two, in sd
BINS = 10  # of the probability
Row = dict[str, tuple[float, float]]


def pixels(image: Array, sigma: Array, touch: Shape) -> dict[str, float]:
    """Of the pixels on and about the touch, the share whose truth is in the intervals that the image states."""
    truth = touch.drop * touch.fraction(len(image))
    about = np.maximum(image, truth) > 0.1 * touch.drop
    off = np.abs(image - truth)[about] / sigma[about]
    return {f"pixels in {percent} %": 100.0 * float((off < one).mean()) for percent, (one, _) in INTERVALS.items()}


def summary(rows: list[Any], index: list[int]) -> dict[str, tuple[float, float]]:
    """Mean and standard error of each figure; of force and integral the median, and the standard error of a median."""
    out = {}
    kept = [rows[k] for k in index if rows[k] is not None]
    for name in [n for n in kept[0] if all(n in row for row in kept)] if kept else []:
        values = np.array([row[name] for row in kept])
        error = float(values.std() / np.sqrt(len(values)))
        if name == "position %":
            out["position rms %"] = (float(np.sqrt((values**2).mean())), error)
        elif name in ("force %", "integral %"):
            low, high = np.quantile(values, (0.5 - 0.5 / np.sqrt(len(values)), 0.5 + 0.5 / np.sqrt(len(values))))
            out[name] = (float(np.median(values)), float(high - low) / 2)
        else:
            out[name] = (float(values.mean()), error)
    return out


def class_error(rows: list[dict[str, float]]) -> float:
    """Expected calibration error of the shapes that contacts state. Of 500 touches, one that is none shows as 0.03."""
    sure, right = (np.array([row[name] / 100 for row in rows]) for name in ("class stated %", "class %"))
    place = np.minimum((sure * BINS).astype(int), BINS - 1)
    return float(np.abs(np.bincount(place, right - sure, minlength=BINS)).sum() / len(rows))


def counted(kind: str, touches: list[Shape]) -> int:
    return sum(kind in ("all", touch.kind) for touch in touches)


def by_kinds(rows: dict[str, list[Any]], touches: list[Shape]) -> dict[str, dict[str, Row]]:
    """kind, or all -> method -> figures. rows: method -> one row a touch."""
    index = {kind: [k for k, t in enumerate(touches) if kind in ("all", t.kind)] for kind in ("all", *KINDS)}
    return {kind: {method: summary(found, k) for method, found in rows.items()} for kind, k in index.items()}


def coverage(levels: dict[str, dict[str, dict[str, Row]]]) -> dict[str, Any]:
    """level -> kind -> interval -> share and its standard error, %: position and force of refined contacts, pixels of
    the network's images.
    """
    return {
        level: {
            kind: {
                name: row["network" if name.startswith("pixels") else "stated"].get(name)
                for name in (f"{what} in {p} %" for what in ("position", "force", "pixels") for p in INTERVALS)
            }
            for kind, row in levels[level].items()
        }
        for level in sorted(levels, key=lambda name: (name == "none", name))
    }


def coverage_table(found: dict[str, Any]) -> Table:
    names = list(next(iter(found.values()))["all"])
    table = Table(title="Truth in the stated intervals, %")
    for column in ("noise", "kind", *names):
        table.add_column(column, justify="right" if column in names else "left")
    for level, by_kind in found.items():
        for kind, row in by_kind.items():
            cells = [row[name] for name in names]
            table.add_row(level, kind, *("" if c is None else f"{c[0]:.0f} +- {c[1]:.0f}" for c in cells))
    return table
