"""What the reaction benchmark says: figures of each kind of touch, targets, tables and the picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.accuracy.intervals import INTERVALS
from bench.goals import Goal
from bench.machine import machine
from bench.speed.reaction_events import KINDS, PHASES, Reaction, TouchEvent
from bench.speed.reaction_floor import growing_floor, held_floor

SNR_DB = 80.0
STEP, LIGHT, FAST_RAMP, SLOW_RAMP = (kind.name for kind in KINDS[:4])
SLIDING = [kind.name for kind in KINDS if kind.speed]
SEVERAL = [kind.name for kind in KINDS if kind.touches > 1]
TARGETS_MS = {STEP: (50, 12.0, 99, 25.0), LIGHT: (50, 18.0, 90, 35.0)}  # quantile, target, quantile, target
GONE_MS = (15.0, 30.0)
SEVERAL_MS = 40.0
BEYOND_MS = {50: 8.0, 99: 15.0}  # of a force that grows: beyond the floor of the same touches
SLIP = 0.1
PIECES = ("to its middle", "line", "preprocessing", "inference", "publisher", "recv")
"""Between an onset, the steps of STEPS_TO_RECV and recv: until the middle of the scan or part that tells of the touch
was measured; the rest of it, the line and acquisition; each stage with the hop to it; the hop to the controller.
"""


def rows(mode: str, found: list[tuple[TouchEvent, Reaction]]) -> list[dict[str, Any]]:
    made = []
    for kind in KINDS:
        of = [reaction for event, reaction in found if event.kind is kind]
        if not of:
            continue
        row: dict[str, Any] = {"mode": mode, "kind": kind.name, "touches": len(of)}
        if kind.speed:
            errors = np.array([e for r in of for e in r.errors_m])
            row |= {"frames": len(errors), "error_at_recv_mm": 1e3 * _quantile(errors, 50)}
            row |= {"velocity_error": _quantile(np.array([v for r in of for v in r.slip]), 50)}
        elif not kind.ramp_s and kind.touches == 1:
            off, force = (np.array([e for r in of for e in getattr(r, name)]) for name in ("held_m", "held_force"))
            row |= {"held_frames": len(off), "held_error_mm": 1e3 * _rms(off), "held_force_error": _rms(force)}
            place, drop = held_floor([event for event, _ in found if event.kind is kind], SNR_DB)
            row |= {"held_floor_mm": 1e3 * place, "held_force_floor": drop}
        elif kind.ramp_s:
            floor = 1e3 * growing_floor([event for event, _ in found if event.kind is kind], SNR_DB)
            row |= {f"floor_p{q}_ms": _quantile(floor, q) for q in (50, 99)}
        row |= waited(of)
        row |= {"wrong": sum(r.wrong for r in of), "unstated": sum(r.unstated for r in of)}
        made.append(row)
    return made


def waited(of: Sequence[Reaction]) -> dict[str, Any]:
    """How long until each was in place, near and gone [ms]; one that never was counts as after every other."""
    row: dict[str, Any] = {}
    for what in ("contact", "near", "gone"):
        ms = 1e3 * np.array([getattr(each, f"{what}_s") for each in of])
        ms = np.where(np.isnan(ms), np.inf, ms)
        row |= {f"{what}_seen": int(np.isfinite(ms).sum())}
        row |= {f"{what}_p{q}_ms": _quantile(ms, q) for q in (50, 90, 99)}
    return row


def _quantile(values: NDArray[np.float64], q: float) -> float:
    return float(np.percentile(values, q, method="higher")) if len(values) else float("nan")


def _rms(of: NDArray[np.float64]) -> float:
    return float(np.sqrt((of**2).mean())) if len(of) else float("nan")


def goals(table: list[dict[str, Any]], late: dict[str, int]) -> list[Goal]:
    """Gates are counts: of poses that were not solved, of touches that were not seen."""
    found = []
    for row in table:
        name = f"{row['mode']}: {row['kind']}"
        if row["kind"] == STEP:
            share = row["contact_seen"] / row["touches"]
            found.append(Goal(f"{name}: share seen in place", share, at_least=1.0, gate=0.8))
        if row["mode"] == "rolling":  # the others are what it is compared with
            found += _rolling_goals(name, row)
        found.append(Goal(f"{name}: frames before it, off by over 3 sigma", row["wrong"], at_most=0))
    found += _beside_full(table)
    for mode, count in late.items():
        found.append(Goal(f"{mode}: poses that the stub had not solved", count, at_most=0, gate=0))
    return found


def _rolling_goals(name: str, row: dict[str, Any]) -> list[Goal]:
    found = []
    if row["kind"] in TARGETS_MS:
        low, at_low, high, at_high = TARGETS_MS[row["kind"]]
        found.append(Goal(f"{name}: to a valid contact, median, ms", row[f"contact_p{low}_ms"], at_most=at_low))
        found.append(Goal(f"{name}: the same, p{high}, ms", row[f"contact_p{high}_ms"], at_most=at_high))
    if row["kind"] in SEVERAL:
        found.append(Goal(f"{name}: all near, median, ms", row["near_p50_ms"], at_most=SEVERAL_MS))
        found.append(Goal(f"{name}: all in place, median, ms", row["contact_p50_ms"], at_most=SEVERAL_MS))
    if row["kind"] == STEP:
        found.append(Goal(f"{name}: release, median, ms", row["gone_p50_ms"], at_most=GONE_MS[0]))
        found.append(Goal(f"{name}: release, p99, ms", row["gone_p99_ms"], at_most=GONE_MS[1]))
    for q, most in BEYOND_MS.items():
        if f"floor_p{q}_ms" in row:
            beyond = row[f"contact_p{q}_ms"] - row[f"floor_p{q}_ms"]
            found.append(
                Goal(f"{name}: beyond the floor ({row[f'floor_p{q}_ms']:.1f}), p{q}, ms", beyond, at_most=most)
            )
    if "held_frames" in row:
        for what, error, floor in (
            ("position", "held_error_mm", "held_floor_mm"),
            ("force", "held_force_error", "held_force_floor"),
        ):
            found.append(Goal(f"{name}: held, {what} error, times the floor", row[error] / row[floor], at_most=1.2))
    if row["kind"] in SLIDING:
        found.append(Goal(f"{name}: velocity error, median", row["velocity_error"], at_most=SLIP))
    return found


def _beside_full(table: list[dict[str, Any]]) -> list[Goal]:
    """Rolling scans against full scans of the same touches."""
    by = {(row["mode"], row["kind"]): row for row in table}
    found = []
    for kind in (kind.name for kind in KINDS):
        full, rolling = by.get(("full", kind)), by.get(("rolling", kind))
        if full is None or rolling is None:
            continue
        for key, name, most in (
            ("error_at_recv_mm", "position at recv, error as a share of full scans'", 1 / 3),
            ("held_error_mm", "held, position error as a share of full scans'", 1.0),
            ("held_force_error", "held, force error as a share of full scans'", 1.0),
        ):
            if key in full and key in rolling:
                found.append(Goal(f"rolling: {kind}: {name}", rolling[key] / max(full[key], 1e-9), at_most=most))
    return found


def table(of: list[dict[str, Any]]) -> Table:
    made = Table(title=f"force leaves zero (or is back) to a controller's recv, ms, {machine()}", title_justify="left")
    headings: tuple[str, ...] = ("scan", "touch", "n", "in place", "p50", "p90", "p99", "first near p50", "p99")
    headings += ("release p50", "p99")
    headings += ("off > 3 sigma", "off > 3 %, no sigma", "mm at recv", "velocity", "held mm (floor)", "force")
    for heading in headings:
        made.add_column(heading, justify="left" if heading in ("scan", "touch") else "right")
    for row in of:
        cells = [row[f"contact_p{q}_ms"] for q in (50, 90, 99)]
        cells += [row[f"{what}_p{q}_ms"] for what in ("near", "gone") for q in (50, 99)]
        slides = [f"{row['error_at_recv_mm']:.2f}", f"{row['velocity_error']:.2f}"] if "frames" in row else ["", ""]
        held = ["", ""]
        if "held_frames" in row:
            held = [f"{row['held_error_mm']:.2f} ({row['held_floor_mm']:.2f})"]
            held += [f"{row['held_force_error']:.2f} ({row['held_force_floor']:.2f})"]
        seen = f"{row['contact_seen']}/{row['touches']}"
        numbers = [f"{v:.1f}" if np.isfinite(v) else "-" for v in cells]
        made.add_row(
            row["mode"],
            row["kind"],
            str(row["touches"]),
            seen,
            *numbers,
            str(row["wrong"]),
            str(row["unstated"]),
            *slides,
            *held,
        )
    return made


def sums(mode: str, found: list[tuple[TouchEvent, Reaction]]) -> list[dict[str, Any]]:
    """Where the time to the first frame near a touch goes, by kind: medians of each piece [ms], which need not add up
    to the whole's median; beside them when the parts of a scan can tell the place at best, by noise alone.
    """
    made = []
    for kind in KINDS:
        of = [(event, reaction) for event, reaction in found if event.kind is kind and reaction.near_after_s]
        if not of:
            continue
        ends = np.array([[0.0, *reaction.near_after_s, reaction.near_s] for _, reaction in of])
        pieces = 1e3 * np.median(np.diff(ends, axis=1), axis=0)
        row: dict[str, Any] = {"mode": mode, "kind": kind.name, "touches": len(of)}
        row |= {f"{name}_ms": float(ms) for name, ms in zip(PIECES, pieces, strict=True)}
        row["whole_ms"] = 1e3 * float(np.median(ends[:, -1]))
        if mode == "rolling" and kind.touches == 1:
            row["floor_ms"] = 1e3 * float(np.median(growing_floor([event for event, _ in of], SNR_DB)))
        made.append(row)
    return made


def sums_table(of: list[dict[str, Any]]) -> Table:
    made = Table(title="force leaves zero to the first frame near it: medians of the pieces, ms", title_justify="left")
    for heading in ("scan", "touch", "n", *PIECES, "whole", "floor of the parts"):
        made.add_column(heading, justify="left" if heading in ("scan", "touch") else "right")
    for row in of:
        cells = [row.get(f"{name}_ms") for name in (*PIECES, "whole", "floor")]
        numbers = ["" if ms is None else f"{ms:.1f}" for ms in cells]
        made.add_row(row["mode"], row["kind"], str(row["touches"]), *numbers)
    return made


def stated(mode: str, found: list[tuple[TouchEvent, Reaction]]) -> list[dict[str, Any]]:
    """How often the truth lies in what contacts state, by phase."""
    made = []
    for phase in PHASES:
        errors = [(k, error) for k, (_, r) in enumerate(found) for error in r.stated if error.phase == phase]
        if not errors:
            continue
        place, force = (np.array([getattr(error, name) for _, error in errors]) for name in ("place", "force"))
        row: dict[str, Any] = {
            "mode": mode,
            "phase": phase,
            "frames": len(errors),
            "touches": len({k for k, _ in errors}),
        }
        for percent, (one, two) in INTERVALS.items():
            row |= {f"position_{percent}": 100 * float((place < two).mean())}
            row |= {f"force_{percent}": 100 * float((np.abs(force) < one).mean())}
        made.append(row)
    return made


def stated_table(of: list[dict[str, Any]]) -> Table:
    made = Table(title="truths within what contacts state, % of frames", title_justify="left")
    names = [f"{what}_{percent}" for what in ("position", "force") for percent in INTERVALS]
    for heading in ("scan", "phase", "frames", "touches", *(name.replace("_", " in ") + " %" for name in names)):
        made.add_column(heading, justify="left" if heading in ("scan", "phase") else "right")
    for row in of:
        numbers = [f"{row[name]:.0f}" for name in names]
        made.add_row(row["mode"], row["phase"], str(row["frames"]), str(row["touches"]), *numbers)
    return made


def draw(found: dict[str, list[tuple[TouchEvent, Reaction]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(7, 5.4), layout="constrained", sharex=True)
    bins = np.arange(0.0, 205.0, 5.0)
    for axis, name, what in ((axes[0], "contact_s", "to a valid contact in place"), (axes[1], "gone_s", "release")):
        for k, (mode, each) in enumerate(found.items()):
            ms = 1e3 * np.array([getattr(r, name) for event, r in each if event.kind.name == STEP])
            share = np.full(len(ms), 1 / max(len(ms), 1))
            axis.hist(np.where(np.isnan(ms), np.inf, ms).clip(0, 202), bins, weights=share, alpha=0.6, color=f"C{k}")
            axis.plot([], [], color=f"C{k}", lw=6, alpha=0.6, label=f"{mode}, median {np.nanmedian(ms):.0f} ms")
        axis.set(ylabel="share of touches", title=f"{STEP}: {what}")
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3)
    axes[1].set(xlabel="ms (the last bar: later, or never)")
    figure.savefig(path, dpi=110)
    plt.close(figure)
