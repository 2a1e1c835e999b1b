"""A recording as a picture: force over time with its contacts, faults and gaps. `skin info FILE --png OUT.png`."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from services.recordings.summary import FLOWING, SessionSummary

MOST_FAULTS = 12


def draw(found: SessionSummary, path: Path) -> None:
    """Write it. Raises OSError."""
    skins = list(found.courses) or [""]
    kinds = list(dict.fromkeys((f.skin, "".join(c for c in f.what if not c.isdigit())) for f in found.faults))
    kinds = kinds[:MOST_FAULTS]
    height = [3.0] * len(skins) + [0.35 * max(1, len(kinds)) + 0.4]
    figure, axes = plt.subplots(
        len(height), 1, figsize=(11, sum(height) + 1), sharex=True, height_ratios=height, layout="constrained"
    )
    for axis, skin in zip(axes[:-1], skins, strict=True):
        _forces(axis, found, skin)
    _faults(axes[-1], found, kinds)
    axes[-1].set_xlabel("time [s]")
    axes[-1].set_xlim(0, max(found.duration_s, 1e-3))
    figure.suptitle(found.path.name, fontsize=11)
    figure.savefig(path, dpi=110, format="png")
    plt.close(figure)


def _forces(axis: Axes, found: SessionSummary, skin: str) -> None:
    course = found.courses.get(skin)
    axis.set_ylabel(f"{skin}: force [N]")
    if course is None:
        return
    times, forces = np.array(course.times_s), np.array(course.force_n)
    axis.plot(times, forces, color="tab:blue", linewidth=1.2)
    top = float(np.nanmax(forces)) if np.isfinite(forces).any() else 0.0
    axis.set_ylim(0, 1.25 * top or 1)
    edges = np.append(times, found.duration_s)
    for k in np.flatnonzero(~np.array(course.valid)):
        axis.axvspan(edges[k], edges[k + 1], color="0.85", linewidth=0)
    for contact in found.contacts:
        if contact.skin == skin:
            axis.axvline(contact.begin_s, color="tab:green", linewidth=0.8)
            axis.annotate(
                contact.what,
                (contact.begin_s, 1),
                xycoords=("data", "axes fraction"),
                xytext=(2, -10),
                textcoords="offset points",
                fontsize=7,
                color="tab:green",
            )
    axis.plot([], [], color="tab:green", label="a contact begins (its id)")
    axis.fill_between([], [], color="0.85", label="not valid")
    axis.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _faults(axis: Axes, found: SessionSummary, kinds: list[tuple[str, str]]) -> None:
    least = found.duration_s / 400  # wide enough to be seen
    for fault in found.faults:
        kind = fault.skin, "".join(c for c in fault.what if not c.isdigit())
        if kind in kinds:
            width = max(least, fault.end_s - fault.begin_s)
            axis.barh(kinds.index(kind), width, left=fault.begin_s, color="tab:red", height=0.6)
    for name, topic in found.topics.items():
        if name.partition("/")[0] in FLOWING:
            for at_s, seconds in topic.gaps():
                axis.axvspan(at_s, at_s + seconds, color="tab:orange", alpha=0.4, linewidth=0)
    axis.fill_between([], [], color="tab:orange", alpha=0.4, label="gap")
    axis.legend(loc="upper right", fontsize=8)
    axis.set_yticks(range(len(kinds)), [f"{skin}: {what}"[:40] for skin, what in kinds], fontsize=8)
    axis.set_ylim(len(kinds) - 0.5 if kinds else 0.5, -0.5)
    if not kinds:
        axis.set_yticks([0], ["no fault"], fontsize=8)
