"""The pictures of bench/reports, drawn from the reports' JSON alone: python -m bench.plots [FOLDER]

Each can be read at half its width: few panels, large letters, units and targets on the axes, labels that keep out of
each other's way.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator, StrMethodFormatter
from matplotlib.transforms import Bbox

from bench import REPORTS

STYLE: Any = {
    "font.size": 13,
    "axes.titlesize": 14,
    "legend.fontsize": 11.5,
    "lines.markersize": 6,
    "lines.linewidth": 1.8,
}
OURS, THEIRS, TARGET = "C3", "C0", "0.35"
AWAY = 9  # points between a marker and its label
Rows = Sequence[Mapping[str, Any]]


@contextlib.contextmanager
def panels(path: Path, rows: int, columns: int, size: tuple[float, float]) -> Iterator[tuple[Figure, list[Axes]]]:
    """A figure and its axes, row by row; it is written to `path` at the end."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
        yield figure, list(axes.ravel())
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)
        plt.close(figure)


class Mark(NamedTuple):
    name: str
    x: float
    y: float
    ours: bool


def settle(figure: Figure) -> None:
    """Lays it out for good: what is placed by hand afterwards stays where it was put."""
    figure.canvas.draw()
    figure.set_layout_engine("none")


def label(figure: Figure, axis: Axes, marks: Sequence[Mark], lines: Sequence[float] = ()) -> list[Any]:
    """A text beside each mark, where there is room: within the axes, on no other text, on no mark and on none of the
    horizontal `lines`. The nearest place that is free, with a line to it where it is far. Once all has been settled.
    """
    points = [axis.transData.transform((m.x, m.y)) for m in marks]
    frame = axis.get_window_extent()
    pixels = figure.dpi / 72
    half = [10 if mark.ours else 5 for mark in marks]
    taken = [Bbox.from_bounds(x - h, y - h, 2 * h, 2 * h) for (x, y), h in zip(points, half, strict=True)]
    for y in lines:
        at = axis.transData.transform((axis.get_xlim()[0], y))[1]
        taken.append(Bbox.from_bounds(frame.x0, at - 1, frame.width, 2))
    if (legend := axis.get_legend()) is not None:
        taken.append(legend.get_window_extent())
    texts = []
    for mark, (x, y) in zip(marks, points, strict=True):
        text = axis.text(0, 0, mark.name, fontsize=11, color=OURS if mark.ours else "0.1", transform=None, va="center")
        size = text.get_window_extent()
        for far in np.arange(1, 14):
            at = _free(size.width, size.height, (x, y), float(far) * AWAY * pixels, frame, taken)
            if at is not None:
                break
        else:
            raise ValueError(f"no room for {mark.name!r}: make the figure larger")
        taken.append(at)
        text.set_position((at.x0, (at.y0 + at.y1) / 2))
        if far > 1:
            near = (min(max(x, at.x0), at.x1), min(max(y, at.y0), at.y1))
            ends = axis.transData.inverted().transform([(x, y), near])
            axis.plot(*ends.T, color="0.6", lw=0.7, zorder=0.5)
        texts.append(text)
    return texts


def _free(width: float, height: float, point: Sequence[float], far: float, frame: Any, taken: Sequence[Any]) -> Any:
    """A box of that size whose edge is `far` from the point, or None."""
    for angle in np.deg2rad([0, 180, 90, 270, 30, -30, 150, 210, 60, -60, 120, 240]):
        c, s = np.cos(angle), np.sin(angle)
        centre = (
            point[0] + c * far + np.sign(round(c, 3)) * width / 2,
            point[1] + s * far + np.sign(round(s, 3)) * height / 2,
        )
        box = Bbox.from_bounds(centre[0] - width / 2, centre[1] - height / 2, width, height)
        inside = frame.x0 + 3 < box.x0 and box.x1 < frame.x1 - 3 and frame.y0 + 3 < box.y0 and box.y1 < frame.y1 - 3
        if inside and not any(box.overlaps(other) for other in taken):
            return box
    return None


def plain(axis: Any, ticks: Sequence[float]) -> None:
    """Numbers as one writes them on a logarithmic axis: 0.2, not 2 x 10^-1."""
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))


def target(axis: Axes, at: float | None, text: str, across: bool = True, style: str = "--") -> None:
    """A line at the target, if there is one, and in the legend `text` for it."""
    if at is not None:
        (axis.axhline if across else axis.axvline)(at, color=TARGET, ls=style, lw=1.4, label=text.format(at))


# -- accuracy ---------------------------------------------------------------------------------------------------------
SHORT = (
    ("shipped, ", "eitskin "), (" (published)", ""), ("lambda 0.15", "as published"), (", best lambda", ""),
    ("the same without attention", "without attention"), ("MM-CNN as published", "MM-CNN published"),
    ("pyEIT 1.2.4", "pyEIT"), (", training time not recorded", ""),
    (", 3 steps", ""), (" (0.01)", ""),
)  # fmt: skip
ACCURACY = (  # level, figure, its target, title
    ("none", "mean_iou", 0.955, "without noise"),
    ("70", "mean_iou", 0.882, "at 70 dB"),
    ("none", "position_%", 0.3, "without noise"),
    ("70", "position_%", None, "at 70 dB"),
)


def accuracy(rows: Rows, path: Path) -> None:
    """Run time against mean IoU and against position."""
    shown: list[tuple[Axes, list[Mark], list[float]]] = []
    with panels(path, 2, 2, (13, 10.5)) as (figure, axes):
        for axis, (level, key, wanted, title) in zip(axes, ACCURACY, strict=True):
            marks = [_mark(row, key) for row in rows if row["level"] == level and row.get(key) is not None]
            marks = sorted((m for m in marks if "image alone" not in m.name), key=lambda m: m.x)
            shown.append((axis, marks, [] if wanted is None else [wanted]))
            for m in marks:
                axis.plot(m.x, m.y, "*" if m.ours else "o", ms=14 if m.ours else 7, c=OURS if m.ours else THEIRS)
            axis.set(xscale="log", xlim=(0.02, 300), title=title, xlabel="CPU time of a frame, one thread, ms")
            plain(axis.xaxis, (0.1, 1, 10, 100))
            if key == "mean_iou":
                axis.set(ylabel="mean IoU (1 is best)", ylim=(0.56, 1.0))
            else:
                axis.set(ylabel="position error, % of the side", yscale="log", ylim=(0.13, 11))
                plain(axis.yaxis, (0.2, 0.5, 1, 2, 5, 10))
            axis.grid(alpha=0.3)
            if wanted is not None:
                target(axis, wanted, "target {:g}")
                axis.legend(loc="lower right" if key == "mean_iou" else "upper right")
        settle(figure)
        for axis, marks, lines in shown:
            label(figure, axis, marks, lines)


def _mark(row: Mapping[str, Any], key: str) -> Mark:
    name = str(row["method"])
    for old, new in SHORT:
        name = name.replace(old, new)
    return Mark(name, row["ms"], row[key], row["method"].startswith("shipped"))


# -- latency ----------------------------------------------------------------------------------------------------------
def latency(rows: Mapping[str, Mapping[str, Any]], path: Path, p50: float | None, p99: float | None) -> None:
    """Median and 99th percentile of each condition, and of the same stages in one process."""
    names = list(rows)
    with panels(path, 1, 1, (11, 1.8 + 0.55 * len(names))) as (figure, (axis,)):
        for k, row in enumerate(rows.values()):
            y = len(names) - k
            for low, high, colour, shift in (
                (row["floor_p50_ms"], row["floor_p99_ms"], "0.6", -0.16),
                (row["p50_ms"], row["p99_ms"], "C0", 0.16),
            ):
                axis.plot([low, high], [y + shift] * 2, color=colour, lw=3, solid_capstyle="butt")
                axis.plot(low, y + shift, "o", color=colour, ms=9)
                axis.plot(high, y + shift, "|", color=colour, ms=12, mew=3)
        axis.plot([], [], "o-", color="C0", lw=3, ms=9, label="four processes: median, to the 99th percentile")
        axis.plot([], [], "o-", color="0.6", lw=3, ms=9, label="the same stages in one process, no sockets")
        target(axis, p50, "target of the median, {:g} ms", across=False)
        target(axis, p99, "target of the 99th percentile, {:g} ms", across=False, style=":")
        axis.set_yticks(range(len(names), 0, -1), names)
        axis.set(xscale="log", xlabel="from the board's last byte to a controller's recv, ms")
        plain(axis.xaxis, (0.5, 1, 2, 5, 10, 20, 50))
        axis.grid(axis="x", alpha=0.3)
        figure.legend(loc="outside upper left", ncols=2, frameon=False)


# -- scale ------------------------------------------------------------------------------------------------------------
def scale(rows: Rows, path: Path, p99_ms: float | None) -> None:
    """Latency and cores against the number of skins, for each share of them that is touched."""
    with panels(path, 1, 2, (13, 5.2)) as (_, (left, right)):
        for k, share in enumerate(sorted({row["touched"] for row in rows})):
            mine = [row for row in rows if row["touched"] == share]
            skins, name = [row["skins"] for row in mine], f"{100 * share:.0f} % of them touched"
            left.plot(skins, [row["p99_ms"] for row in mine], "o:", color=f"C{k}", label=f"99th percentile, {name}")
            left.plot(skins, [row["p50_ms"] for row in mine], "o-", color=f"C{k}", label=f"median, {name}")
            right.plot(skins, [row["cores"] for row in mine], "o-", color=f"C{k}", label=name)
        target(left, p99_ms, "target of the 99th percentile, {:g} ms")
        left.set(ylabel="from a frame read to a controller's recv, ms", xscale="log", yscale="log", ylim=(2, 4000))
        plain(left.yaxis, (2, 5, 10, 20, 50, 100, 200, 500))
        right.set(ylabel="CPU of all processes, cores", xscale="log", ylim=(0, None))
        left.legend(loc="upper left")
        right.legend(loc="lower right")
        for axis in (left, right):
            axis.set_xlabel("skins at 22 frames a second")
            plain(axis.xaxis, sorted({row["skins"] for row in rows}))
            axis.grid(alpha=0.3)


# -- stability --------------------------------------------------------------------------------------------------------
ERRORS = (("position_%", "position error, % of the side"), ("force_%", "force error, %"))
VALID = (("valid_%", "valid frames"),)
STABILITY = (  # part of the report, title, x axis, ticks where it is logarithmic, curves
    ("signal over noise", "noise", "signal over noise, dB", (), ERRORS),
    ("contact impedance", "contact impedances", "times those of the bundle", (0.1, 0.3, 1, 3, 10), ERRORS),
    ("background", "conductivity", "of the sheet, S/m", (0.2, 0.5, 1, 2, 5), ERRORS),
    ("meshes, coarse to fine", "mesh of the frames", "elements", (2000, 5000, 10000, 30000), ERRORS),
    ("dead electrodes", "dead electrodes", "electrodes", (), VALID),
    ("not numbers in some channels", "not a number", "measurements of 120", (), VALID),
)


def stability(parts: Mapping[str, Rows], path: Path) -> None:
    """Errors, and frames that are valid, against what is made worse; nothing where no such part was run."""
    if not any(parts.get(part) for part, *_ in STABILITY):
        return
    with panels(path, 2, 3, (15, 9.5)) as (figure, axes):
        for axis, (part, title, x_label, ticks, curves) in zip(axes, STABILITY, strict=True):
            rows = parts.get(part, ())
            axis.set(title=title, xlabel=x_label)
            if ticks:
                axis.set_xscale("log")
                plain(axis.xaxis, ticks)
            if curves is ERRORS:
                axis.set(yscale="log", ylabel="mean error", ylim=(0.1, 100))
                plain(axis.yaxis, (0.1, 0.3, 1, 3, 10, 30, 100))
            else:
                axis.set(ylabel="frames that are valid, %", ylim=(-4, 119))
                axis.set_yticks(range(0, 101, 25))
                axis.xaxis.set_major_locator(MaxNLocator(integer=True))
            for k, (key, name) in enumerate(curves):
                _curve(axis, rows, key, name, k)
            axis.grid(alpha=0.3)
            if curves is VALID and axis.lines:
                axis.legend(loc="lower left" if part.startswith("not") else "center right")
        for colour, (_, name) in enumerate(ERRORS):
            axes[0].plot([], [], "o-", color=f"C{colour}", label=name)
        axes[0].plot([], [], "--", color="0.3", label="dashed: without noise")
        handles = axes[0].lines[-3:]
        figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)


def _curve(axis: Axes, rows: Rows, key: str, name: str, colour: int) -> None:
    """One curve for each noise level and kind that the part has."""
    styles = iter(("-", "--", ":", "-."))
    for which in dict.fromkeys(_which(row) for row in rows):
        own = [row for row in rows if _which(row) == which and row.get(key) is not None]
        if own:
            x, y = ([row[k] for row in own] for k in ("value", key))
            shown = which or name
            axis.plot(x, y, next(styles), marker="o", color=f"C{colour}", label=shown)


def _which(row: Mapping[str, Any]) -> str:
    decibel = row.get("dB")
    level = "" if "dB" not in row else f"{decibel:g} dB" if decibel is not None and np.isfinite(decibel) else "no noise"
    return ", ".join(filter(None, (level, row.get("kind"))))


# -- all of them ------------------------------------------------------------------------------------------------------
def _bound(report: Mapping[str, Any], ending: str) -> float | None:
    """The target of the first figure of a report whose name ends so and which has one."""
    bounds = (goal["at_most"] for goal in report["targets"] if goal["figure"].endswith(ending))
    return next((bound for bound in bounds if bound is not None), None)


DRAWN: dict[str, Callable[[Mapping[str, Any], Path], None]] = {
    "accuracy": lambda report, path: accuracy(report["rows"], path),
    "latency": lambda report, path: latency(
        report["rows"], path, p50=_bound(report, "p50, ms"), p99=_bound(report, "p99, ms")
    ),
    "scale": lambda report, path: scale(report["rows"], path, _bound(report, "p99, ms")),
    "stability": lambda report, path: stability(report["parts"], path),
}


def draw(report: Path) -> Path:
    """The picture of one report, beside it."""
    picture = report.with_suffix(".png")
    DRAWN[report.stem](json.loads(report.read_text(encoding="utf-8")), picture)
    return picture


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else REPORTS
    for name in DRAWN:
        if (folder / f"{name}.json").is_file():
            print(draw(folder / f"{name}.json"))
