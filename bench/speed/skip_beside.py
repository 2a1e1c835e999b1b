"""What refinement and symmetry cost the newest frame: the same frames with and without them, one after the other."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from bench.tracking.scene import Recorded
from models.bundle import Bundle
from protocol.frames import RawFrame, pack, unpack
from services.pipeline import build_stages
from services.refine_process import RefineProcess
from services.runtime.config import Indenter, Skin, TouchConfig
from services.runtime.stage import Stage

PERIOD_S = 0.045  # between frames, as a board has it
SWITCHES = {
    "neither": Skin(port="stub", bundle="square16", frame_id="palm"),
    "touches refined, indenter any": Skin(
        port="stub", bundle="square16", frame_id="palm", indenter=Indenter(kind="any")
    ),
    "averaged over symmetries": Skin(port="stub", bundle="square16", frame_id="palm", touch=TouchConfig(symmetry=True)),
}


def beside(recorded: Recorded, bundle: Bundle, after_s: float) -> dict[str, Any]:
    """switch -> p50 and p99 of a frame's time through the stages, and of the CPU that it takes [ms]; fits, and frames
    that were skipped. Fits run in their process, as they do live. Frames before after_s are not counted.
    """
    fits = RefineProcess()
    sets = {name: build_stages("palm", skin, bundle) for name, skin in SWITCHES.items()}
    took: dict[str, list[tuple[float, float]]] = {name: [] for name in sets}
    try:
        for stages in sets.values():
            stages[1].fit_by(fits)
            stages[1].warm_up()
        for k in range(len(recorded)):
            began, raw = time.monotonic(), recorded.frame(k)
            counted = bool(recorded.seconds[k] > after_s)
            names = list(sets)
            for name in names[k % len(names) :] + names[: k % len(names)]:  # none is always the first
                times = _through(sets[name], raw)
                if counted:
                    took[name].append(times)
            for stages in sets.values():
                for stage in stages:
                    stage.prepare()
            if counted:
                time.sleep(max(0.0, began + PERIOD_S - time.monotonic()))
        counters = sets["touches refined, indenter any"][1].health().counters
    finally:
        fits.close()
    found: dict[str, Any] = {}
    for name, times_s in took.items():
        wall, cpu = 1e3 * np.array(times_s).T
        found[name] = {"p50_ms": float(np.median(wall)), "p99_ms": float(np.quantile(wall, 0.99)), "frames": len(wall)}
        found[name] |= {"cpu_p50_ms": float(np.median(cpu)), "cpu_p99_ms": float(np.quantile(cpu, 0.99))}
    found["touches refined, indenter any"] |= {
        key: counters[f"refine_{key}"] for key in ("fits", "refined", "skipped", "unexplained")
    }
    return found


def _through(stages: Sequence[Stage], raw: RawFrame) -> tuple[float, float]:
    """Seconds on the clock and of CPU."""
    message, wanted = pack(raw), frozenset({"delta", "image", "contact"})
    began, used = time.perf_counter(), time.thread_time()
    for stage in stages:
        message = pack(stage.process(unpack(message), wanted)[0])
    return time.perf_counter() - began, time.thread_time() - used


def ratios(found: dict[str, Any]) -> dict[str, float]:
    """p99 of each switch over that of neither; and of the CPU, which other programs on the machine move less."""
    return {
        f"{name}{said}": row[key] / found["neither"][key]
        for name, row in found.items()
        for key, said in (("p99_ms", ""), ("cpu_p99_ms", ", CPU"))
        if name != "neither"
    }


def table_of(found: dict[str, Any]) -> Table:
    table = Table(title="a moving touch's frames, switches in turn, fits in their own process", title_justify="left")
    for heading in ("", "p50 ms", "p99 ms", "CPU p50 ms", "CPU p99 ms", "frames", "fits", "refined", "skipped"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, row in found.items():
        counts = [str(row.get(key, "")) for key in ("frames", "fits", "refined", "skipped")]
        times = [f"{row[key]:.2f}" for key in ("p50_ms", "p99_ms", "cpu_p50_ms", "cpu_p99_ms")]
        table.add_row(name, *times, *counts)
    return table
