"""What each skip rule saves and what it costs: CPU per frame and error, with the rule and without.

    skin bench skip [--seconds 20] [--live 15]

Part one runs the stages in one process, every frame packed and unpacked between them as on the wire, on three scenes
of the stub in simulated time; variants take turns; a touch held still is met again and again; a moving touch's frames
go through the stages with and without refinement and symmetry in turn, at a board's pace. Part two brings up the real
processes and reads their CPU time while the skin is untouched, touched and still, touched and moving. Prints tables,
writes skip.json.
"""

from __future__ import annotations

import argparse
import gc
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.service import BEGIN, Outside, end_on_sigterm, running_square
from bench.speed.skip_averaging import SNR_DB, averaging
from bench.speed.skip_batching import TOGETHER, batch_table, batched
from bench.speed.skip_beside import beside, ratios, table_of
from bench.tracking.scene import Recorded, record
from models.bundle import Bundle
from models.command import real
from models.refine import RefineJob
from protocol.frames import ContactFrame, Frame, RawFrame, pack, unpack
from services.pipeline import build_stages
from services.refine_process import RefineHere
from services.runtime.config import Indenter, Skin, TouchConfig
from services.runtime.stage import PROCESSES, Stage

QUIET_S = 5.0  # of each scene, before it begins: the tare
ROUNDS = 3
LEAST_S, LEAST_LIVE_S = 2.0, 1.0  # of a scene, to count frames of
TARGETS = {"untouched": 0.25, "still": 0.5}  # of a moving touch's CPU
GATES = {"untouched": 0.45, "still": 0.7}  # of a short run, stages alone
REFINED_GATES = {"still": 1.6, "moving": 2.5}  # a slide is refined too: nearly each of its frames is handed to a fit
TOUCH = {"shape": "circle", "x": 0.008, "y": -0.012, "force": 2.0, "radius": 0.01}
ENDS_S = 0.5  # before the scene's end the touch is gone, so that its release is seen too
EVERYTHING = frozenset({"delta", "image", "contact", "force", "shape"})
PLAIN = frozenset({"delta", "image", "contact"})


@dataclass(frozen=True)
class Variant:
    """A configuration of the switches, and the topics somebody subscribes to."""

    touch: TouchConfig = TouchConfig()
    wanted: frozenset[str] = PLAIN
    indenter: Indenter | None = None

    def skin(self) -> Skin:
        return Skin(port="stub", bundle="square16", frame_id="palm", touch=self.touch, indenter=self.indenter)


class FitsBetween(RefineHere):
    """Fits while no frame waits, as the process that refines touches does beside inference."""

    def __init__(self) -> None:
        super().__init__()
        self._job: RefineJob | None = None

    def offer(self, job: RefineJob) -> None:
        self._job = job

    def between(self) -> None:
        if self._job is not None:
            job, self._job = self._job, None
            super().offer(job)


VARIANTS = {
    "all rules": Variant(),
    "untouched frames reconstructed too": Variant(TouchConfig(skip_untouched=False)),
    "no hold": Variant(TouchConfig(hold=False)),
    "force and shape subscribed": Variant(wanted=EVERYTHING),
    "no rule": Variant(TouchConfig(skip_untouched=False, hold=False), EVERYTHING),
    "held images averaged over symmetries": Variant(TouchConfig(symmetry=True)),
    "touches refined, indenter a circle": Variant(indenter=Indenter(kind="circle")),
}


@lru_cache(maxsize=4)
def scenes(seconds: float, quiet_s: float = QUIET_S) -> dict[str, Recorded]:
    """The three scenes in simulated time; nothing touches for quiet_s."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, script in scripts(seconds, quiet_s).items():
            path = Path(folder, f"{name}.toml")
            path.write_text(script)
            found[name] = record(str(path), 80.0, 3, quiet_s + seconds)[0]
    return found


def scripts(seconds: float, quiet_s: float = QUIET_S) -> dict[str, str]:
    """The TOML of the three scenes."""
    end = quiet_s + seconds
    keys = {
        "untouched": [],
        "still": [{"t": quiet_s, **TOUCH}, {"t": end - ENDS_S, **TOUCH}],
        "moving": [
            {"t": quiet_s + s, **TOUCH, "x": 0.03 * float(np.cos(1.3 * s)), "y": 0.03 * float(np.sin(1.3 * s))}
            for s in np.arange(0, seconds - ENDS_S + 1e-9, 0.25)
        ],
    }
    return {name: _toml(points, end) for name, points in keys.items()}


def _toml(points: list[dict[str, Any]], end: float) -> str:
    lines = [f"duration = {end}"]
    if points:
        lines.append("[[touch]]\nkeys = [")
        for point in points:
            lines.append("  { " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in point.items()) + " },")
        lines.append("]")
    return "\n".join(lines) + "\n"


def run(recorded: Recorded, variant: Variant, bundle: Bundle) -> tuple[list[ContactFrame], float]:
    """(contact frames, CPU seconds per frame after the quiet time) of a scene through the stages and their wire."""
    stages, fits = build_stages("palm", variant.skin(), bundle), FitsBetween()
    if variant.indenter is not None:
        stages[1].fit_by(fits)
    contacts, used, counted = [], 0.0, 0
    for k in range(len(recorded)):
        contact, seconds = run_once(stages, recorded.frame(k), variant.wanted)
        if recorded.seconds[k] > QUIET_S:
            used, counted = used + seconds, counted + 1
        fits.between()
        contacts.append(contact)
    return contacts, used / counted


def run_once(stages: Sequence[Stage], raw: RawFrame, wanted: frozenset[str] = PLAIN) -> tuple[ContactFrame, float]:
    """(contact frame, CPU seconds) of a raw frame through the stages, packed and unpacked between them."""
    message = pack(raw)
    began = time.thread_time()
    frames: list[Frame] = []
    for stage in stages:
        frames = stage.everything(unpack(message), wanted)
        for frame in frames:
            frame.stamps.setdefault(stage.stamp, time.monotonic_ns())
        message = [pack(frame) for frame in frames][0]
    used = time.thread_time() - began
    for stage in stages:
        stage.prepare()
    assert isinstance(frames[0], ContactFrame)
    return frames[0], used


def errors(recorded: Recorded, contacts: list[ContactFrame]) -> dict[str, Any]:
    """Position error [mm] and force error [%] of the frames with a touch, and what was seen how late [frames]."""
    truth = {int(row[0]): row[1:] for row in recorded.touches}
    position, force = [], []
    for k, frame in enumerate(contacts):
        if k in truth and frame.contacts and frame.contacts[0].state != "end":
            _, x, y, newton, *_ = truth[k]
            found = frame.contacts[0]
            position.append(1e3 * float(np.hypot(found.position[0] - x, found.position[1] - y)))
            force.append(100 * abs((found.force_n or 0.0) / newton - 1))
    if not position:
        return {"seen": sum(bool(frame.contacts) for frame in contacts)}
    here = [bool(frame.contacts) and frame.contacts[0].state != "end" for frame in contacts]
    first, last = min(truth), max(truth)
    return {
        "position_mm": float(np.sqrt(np.mean(np.square(position)))),
        "force_%": float(np.sqrt(np.mean(np.square(force)))),
        "seen_after_frames": here.index(True, first) - first,
        "released_after_frames": here.index(False, last + 1) - last - 1 if False in here[last + 1 :] else None,
    }


def stages_alone(seconds: float) -> dict[str, Any]:
    """variant -> scene -> CPU per frame [ms] and errors."""
    recorded, bundle = scenes(seconds), Bundle.load("square16")
    cpu: dict[tuple[str, str], list[float]] = {}
    found: dict[str, Any] = {name: {} for name in VARIANTS}
    gc.collect()
    gc.freeze()
    for _ in range(ROUNDS):
        for name, variant in VARIANTS.items():
            for scene, frames in recorded.items():
                contacts, used = run(frames, variant, bundle)
                cpu.setdefault((name, scene), []).append(used * 1e3)
                found[name][scene] = errors(frames, contacts)
    for (name, scene), used_ms in cpu.items():
        found[name][scene]["cpu_ms"] = min(used_ms)
    return found


def live(seconds: float) -> dict[str, Any]:
    """scene -> CPU per frame [ms] of each process, one controller on contact; and of all of them."""
    found: dict[str, Any] = {}
    with running_square("full") as service:
        contacts = Outside("contact", "palm", service.folder)
        for scene, start in BEGIN.items():
            start(service)
            time.sleep(3.0)
            before, frames, end = service.cpu_s(), 0, time.monotonic() + seconds
            while time.monotonic() < end:
                frames += contacts.recv(0.2) is not None
            used = service.cpu_s()
            each = {name: 1e3 * (used[name] - before[name]) / frames for name in PROCESSES}
            found[scene] = {"cpu_ms": sum(each.values()), "processes_ms": each, "frames": frames}
        contacts.close()
    return found


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench skip", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=real(), default=20.0, help="of each scene, simulated")
    parser.add_argument(
        "--live", type=real(itself=True), default=15.0, help="seconds of each scene with the real processes"
    )
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    for name, given, least in (("seconds", args.seconds, LEAST_S), ("live", args.live, LEAST_LIVE_S)):
        if not given >= least:
            parser.error(f"--{name} {given:g}: expected {least:g} or more")
    end_on_sigterm()
    bundle, recorded = Bundle.load("square16"), scenes(args.seconds)
    variants, held = stages_alone(args.seconds), averaging(recorded["still"], bundle)
    switches = beside(recorded["moving"], bundle, QUIET_S)
    batches, processes = batched(recorded["moving"], bundle), live(args.live)
    console = Console(width=140)
    for table in (
        _variants_table(variants),
        _held_table(held),
        table_of(switches),
        batch_table(batches),
        _live_table(processes),
    ):
        console.print(table)
    wanted = goals(variants, held, batches, processes)
    wanted += [
        Goal(f"moving: p99 of the newest frame, {name}, of neither", ratio, at_most=1.05, gate=3.0)
        for name, ratio in ratios(switches).items()
    ]
    console.print(_goals.table(wanted))
    report = {**provenance("skip", argv), "targets": [goal.to_dict() for goal in wanted]}
    write_json(
        args.out / "skip.json",
        report | {"stages": variants, "held": held, "switches": switches, "batched": batches, "live": processes},
    )
    print(f"wrote {args.out / 'skip.json'}")
    return 0


def goals(
    variants: dict[str, Any],
    held: dict[str, dict[str, float]],
    batches: dict[str, dict[str, float]],
    processes: dict[str, Any],
) -> list[Goal]:
    found = []
    ours, without = variants["all rules"], variants["no rule"]
    for scene, most in TARGETS.items():
        live_ratio = processes[scene]["cpu_ms"] / processes["moving"]["cpu_ms"]
        alone = ours[scene]["cpu_ms"] / ours["moving"]["cpu_ms"]
        found.append(Goal(f"{scene}: CPU of a moving touch's, four processes", live_ratio, at_most=most))
        found.append(Goal(f"{scene}: CPU of a moving touch's, stages alone", alone, at_most=most, gate=GATES[scene]))
    refined = variants["touches refined, indenter a circle"]
    for scene, gate in REFINED_GATES.items():
        ratio = refined[scene]["cpu_ms"] / ours[scene]["cpu_ms"]
        found.append(Goal(f"{scene}: CPU of a frame's stages, refined, of without", ratio, at_most=1.1, gate=gate))
        closer = refined[scene]["force_%"] / ours[scene]["force_%"]
        found.append(Goal(f"{scene}: force error, refined, of without", closer, at_most=1.0))
    for scene in ("still", "moving"):
        for what in ("seen", "released"):
            late, plain = (of[scene][f"{what}_after_frames"] for of in (ours, without))
            more = None if late is None or plain is None else late - plain
            found.append(Goal(f"{scene}: {what} so many frames later than without rules", more, at_most=0, gate=0))
    start, *_, end = held.values()
    falls = f"still: position error after {list(held)[-1]} frames, of the first one's"
    found.append(Goal(falls, end["averaged"] / start["averaged"], at_most=1.0, gate=0.7))
    found.append(Goal("the same, floors", end["averaged, floor"] / start["averaged, floor"]))
    largest = batches[str(TOGETHER[-1])]
    saved = f"network's CPU a frame, {TOGETHER[-1]} skins in one run, of each alone's"
    found.append(Goal(saved, largest["one run"] / largest["each alone"], gate=1.1))
    for scene in ("untouched", "still", "moving"):
        found.append(Goal(f"{scene}: frames a second on one core, stages alone", 1e3 / ours[scene]["cpu_ms"]))
    return found


def _variants_table(variants: dict[str, Any]) -> Table:
    table = Table(title=f"stages with their wire in one process, {machine()}", title_justify="left")
    for heading in ("", *(f"CPU ms, {scene}" for scene in ("untouched", "still", "moving"))):
        table.add_column(heading, justify="right" if heading else "left")
    for heading in ("still: mm", "force %", "moving: mm", "force %", "seen after", "released after"):
        table.add_column(heading, justify="right")
    for name, of in variants.items():
        cells = [f"{of[scene]['cpu_ms']:.2f}" for scene in ("untouched", "still", "moving")]
        for scene in ("still", "moving"):
            cells += [f"{of[scene]['position_mm']:.3f}", f"{of[scene]['force_%']:.1f}"]
        cells += [str(of["moving"][key]) for key in ("seen_after_frames", "released_after_frames")]
        table.add_row(name, *cells)
    return table


def _held_table(held: dict[str, dict[str, float]]) -> Table:
    title = f"a touch held still, {SNR_DB:g} dB: rms position error, mm, from so many frames after it began on"
    table = Table(title=title, title_justify="left")
    for heading in ("", *held):
        table.add_column(heading, justify="right" if heading else "left")
    for name in next(iter(held.values())):
        table.add_row(name, *(f"{row[name]:.2f}" for row in held.values()))
    return table


def _live_table(processes: dict[str, Any]) -> Table:
    table = Table(title="real processes, CPU ms per frame", title_justify="left")
    for heading in ("", "all four", *PROCESSES):
        table.add_column(heading, justify="right" if heading else "left")
    for scene, row in processes.items():
        table.add_row(scene, f"{row['cpu_ms']:.2f}", *(f"{row['processes_ms'][p]:.2f}" for p in PROCESSES))
    return table


if __name__ == "__main__":
    raise SystemExit(main())
