"""The pictures of bench/reports, drawn from the reports' JSON alone: python -m bench.plots [FOLDER]"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from bench import REPORTS
from protocol.whole_file import whole_file

STYLE: Any = {"font.size": 13, "axes.titlesize": 14, "legend.fontsize": 11, "lines.markersize": 8}
ACCURACY = (  # level, figure, title
    ("none", "mean_iou", "without noise"),
    ("70", "mean_iou", "at 70 dB"),
    ("none", "position_%", "without noise"),
    ("70", "position_%", "at 70 dB"),
)
MARKERS = "osD^v<>pPX*h8"


@contextlib.contextmanager
def panels(path: Path, rows: int, columns: int, size: tuple[float, float]) -> Iterator[list[Axes]]:
    """Axes, row by row; written to `path` at the end."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
        yield list(axes.ravel())
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            figure.savefig(part, dpi=100)
        plt.close(figure)


def plain(axis: Any, ticks: Sequence[float]) -> None:
    """Numbers as one writes them on a logarithmic axis: 0.2, not 2 x 10^-1."""
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))


def accuracy(report: Mapping[str, Any], path: Path) -> None:
    """Run time against mean IoU and against position; ours are stars."""
    names = list(dict.fromkeys(row["method"] for row in report["rows"]))
    with panels(path, 2, 2, (13, 11)) as axes:
        for axis, (level, key, title) in zip(axes, ACCURACY, strict=True):
            for k, name in enumerate(names):
                row: Mapping[str, Any] = next(
                    (r for r in report["rows"] if (r["method"], r["level"]) == (name, level)), {}
                )
                if row.get(key) is not None:
                    mark = "*" if name.startswith("eitskin") else MARKERS[k % 10]
                    axis.plot(row["ms"], row[key], mark, c=f"C{k % 10}", ms=15 if mark == "*" else 8, label=name)
            axis.set(xscale="log", title=title, xlabel="CPU time of a frame, one thread, ms")
            plain(axis.xaxis, (0.01, 0.1, 1, 10, 100))
            if key == "mean_iou":
                axis.set(ylabel="mean IoU (1 is best)")
            else:
                axis.set(ylabel="position error, % of the side", yscale="log")
                plain(axis.yaxis, (0.1, 0.2, 0.5, 1, 2, 5, 10))
            axis.grid(alpha=0.3)
        handles = axes[0].get_legend_handles_labels()
        axes[0].figure.legend(*handles, loc="outside lower center", ncols=3, frameon=False)


def latency(report: Mapping[str, Any], path: Path) -> None:
    """Median and 99th percentile of each condition; and against the number of skins."""
    rows, many = report.get("hops", []), report.get("scale", [])
    if not rows and not many:
        return
    with panels(path, 2, 1, (11, 3.5 + 0.5 * len(rows) + 4)) as (one, skins):
        for k, row in enumerate(rows):
            one.plot([row["p50_ms"], row["p99_ms"]], [-k, -k], "|-", color="C0", lw=3, ms=12)
            one.plot(row["p50_ms"], -k, "o", color="C0")
        names = [f"{'whole scans' if row['scan'] == 'full' else 'in parts'}, {row['scene']}" for row in rows]
        one.set_yticks([-k for k in range(len(rows))], names)
        title = "board's last byte to a controller's recv: median, to the 99th percentile"
        one.set(xscale="log", xlabel="ms", title=title)
        plain(one.xaxis, (1, 2, 5, 10, 20, 50))
        for k, scan in enumerate(dict.fromkeys(row["scan"] for row in many)):
            own = [row for row in many if row["scan"] == scan]
            count, name = [row["skins"] for row in own], "whole scans" if scan == "full" else "in parts"
            skins.plot(count, [row["p50_ms"] for row in own], "o-", color=f"C{k}", label=f"median, {name}")
            skins.plot(count, [row["p99_ms"] for row in own], "o:", color=f"C{k}", label=f"99th percentile, {name}")
        skins.set(xscale="log", yscale="log", xlabel="skins", ylabel="frame read to recv, ms")
        plain(skins.xaxis, sorted({row["skins"] for row in many}))
        plain(skins.yaxis, (1, 2, 5, 10, 20, 50, 100, 200, 500))
        for axis in (one, skins):
            axis.grid(alpha=0.3)
        if many:
            skins.legend()


def reaction(report: Mapping[str, Any], path: Path) -> None:
    """How long steps of force take to be seen in place, and to be gone."""
    bins = np.arange(0.0, 205.0, 5.0)
    with panels(path, 2, 1, (8, 6.5)) as axes:
        for axis, (what, title) in zip(axes, (("contact", "to a valid contact"), ("gone", "release")), strict=True):
            for k, (mode, each) in enumerate(report["steps_ms"].items()):
                ms = np.array([np.inf if value is None else value for value in each[what]])
                share = np.full(len(ms), 1 / max(len(ms), 1))
                label = f"{mode}, median {np.median(ms):.0f} ms"
                axis.hist(ms.clip(0, 202).tolist(), bins.tolist(), weights=share, alpha=0.6, color=f"C{k}", label=label)
            axis.set(ylabel="share of touches", title=f"2 N: {title}", xlabel="ms (the last bar: later, or never)")
            axis.legend()
            axis.grid(alpha=0.3)


def force(report: Mapping[str, Any], path: Path) -> None:
    """Said over true and sigma over true, by radius and force, a row a scan mode."""
    cells = report["cells"]
    scans, radii, newtons = (sorted({c[key] for c in cells}) for key in ("scan", "radius_mm", "newtons"))
    shown = (("ratio", "median said / true", 0.7, 1.3, "RdBu"), ("sigma", "median sigma / true", 0.0, 0.3, "viridis"))
    with panels(path, len(scans), 2, (11, 3.8 * len(scans))) as axes:
        for axis, (scan, (key, title, low, high, colours)) in zip(
            axes, [(scan, each) for scan in scans for each in shown], strict=True
        ):
            image = np.full((len(newtons), len(radii)), np.nan)
            for c in (c for c in cells if c["scan"] == scan and c[key] is not None):
                at = newtons.index(c["newtons"]), radii.index(c["radius_mm"])
                image[at] = c[key]
                mark = "*" if c["saturated"] else ""
                axis.text(at[1], at[0], f"{c[key]:.2f}{mark}", ha="center", va="center", fontsize=10)
            axis.imshow(image, origin="lower", vmin=low, vmax=high, cmap=colours, alpha=0.6, aspect="auto")
            axis.set_xticks(range(len(radii)), [f"{r:g}" for r in radii])
            axis.set_yticks(range(len(newtons)), [f"{f:g}" for f in newtons])
            axis.set(title=f"{scan}: {title} (*: saturated)", xlabel="radius, mm", ylabel="force, N")


DRAWN: dict[str, Callable[[Mapping[str, Any], Path], None]] = {
    "accuracy": accuracy,
    "latency": latency,
    "reaction": reaction,
    "force": force,
}


def draw(report: Path) -> Path:
    """The picture of one report, beside it; NAME_live.json as NAME.json."""
    picture = report.with_suffix(".png")
    DRAWN[report.stem.removesuffix("_live")](json.loads(report.read_text(encoding="utf-8")), picture)
    return picture


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else REPORTS
    for name in DRAWN:
        for found in sorted(folder.glob(f"{name}*.json")):
            with contextlib.suppress(KeyError):  # a report of an older form keeps its picture
                print(draw(found))
