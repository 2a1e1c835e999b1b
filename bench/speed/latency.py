"""Latency, CPU and scale: what a contact's way costs, of one skin and of many.

    skin bench latency [--quick] [--sections hops stages scale] [--seconds 20]

hops: real processes, the stub's board behind its serial device, a plain pyzmq controller: from the last byte of a scan
or part that the board writes to the controller's recv, hop by hop, and the CPU of the four processes; whole scans and
parts; with 16 controllers too, one of them stopped. stages: the same stages in one process, with and without the rules
that skip work, and their memory. scale: many skins on one set of processes, each a recording of the stub's board played
at its own rate (bench/speed/scale.py). Prints tables, writes latency.json and draws latency.png.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal, titled
from bench.json_file import write_report
from bench.machine import machine
from bench.speed import scale
from bench.speed.recorded import QUIET_S, SCENES, recorded
from bench.speed.service import BEGIN, Service, end_on_sigterm, heard, running_square, subscribed
from models.bundle import Bundle
from models.command import real, whole
from protocol.frames import ContactFrame, Frame, RawFrame, TruthFrame, pack, unpack
from services.pipeline import build_stages
from services.runtime.config import ScanMode, Skin, TouchConfig
from services.runtime.stage import PROCESSES

SECTIONS = ("hops", "stages", "scale")
SCANS: tuple[ScanMode, ...] = ("full", "rolling")
HOPS = ("acquire", "preprocess", "infer", "publish", "receive")
TARGET_MS = {"p50_ms": 2.0, "p99_ms": 5.0}
CORES = {"untouched": 0.30, "still": 0.5, "moving": 1.0}  # of the four processes, scans in parts
UNNOTICED = 1.1  # p50 with more controllers over one's
CONTROLLERS = 16
SETTLE_S = 3.0
ROUNDS = 3  # the least CPU of so many counts
VARIANTS = {
    "all rules": TouchConfig(),
    "no rule": TouchConfig(skip_untouched=False, hold=False),
    "held images averaged over symmetries": TouchConfig(symmetry=True),
}
PLAIN = frozenset({"delta", "image", "contact"})  # what somebody subscribes to
CONTROLLER = """
import sys, zmq
s = zmq.Context.instance().socket(zmq.SUB)
s.setsockopt(zmq.CONFLATE, 1)
s.connect(sys.argv[1])
s.subscribe(b"contact/palm\\0")
while True:
    s.recv()
"""


# -- hops -------------------------------------------------------------------------------------------------------------
def hops(seconds: float, more: int) -> list[dict[str, Any]]:
    """A row for each scan mode and scene; of a moving touch in whole scans, one with `more` controllers too."""
    rows = []
    for scan in SCANS:
        with running_square(scan) as service:
            socket = subscribed(service.folder, ("publisher", "stub"), b"contact/palm\0", b"truth/palm\0")
            for scene, begin in BEGIN.items():
                begin(service)
                heard(socket, SETTLE_S)
                rows.append({"scan": scan, "scene": scene, **of_one(service, socket, seconds)})
            if more > 1 and scan == "full":
                with controllers(more - 1, service):
                    heard(socket, SETTLE_S)
                    name = f"moving, {more} controllers, one stopped"
                    rows.append({"scan": scan, "scene": name, **of_one(service, socket, seconds)})
            socket.close(0)
    return rows


def of_one(service: Service, socket: zmq.Socket[bytes], seconds: float) -> dict[str, Any]:
    cpu, began = service.cpu_s(), time.monotonic()
    messages = heard(socket, seconds)
    took = time.monotonic() - began
    used = {name: (after - cpu[name]) / took for name, after in service.cpu_s().items()}
    written, received = dict[int, int](), dict[int, tuple[dict[str, int], int]]()
    for message, at_ns in messages:
        frame = unpack(message)
        if isinstance(frame, TruthFrame):
            written[frame.scan] = frame.stamps["publish"]
        elif isinstance(frame, ContactFrame):
            received[frame.scan] = frame.stamps, at_ns
    found = [chain(*received[scan], written[scan]) for scan in received.keys() & written.keys()]
    each = np.array(found or [[np.inf] * len(HOPS)])
    whole_ms = each.sum(axis=1)
    return {
        "frames": len(found),
        "rate_hz": len(received) / took,
        "backwards": int((each < 0).any(axis=1).sum()),
        "p50_ms": float(np.percentile(whole_ms, 50)),
        "p99_ms": float(np.percentile(whole_ms, 99)),
        "hops_p50_ms": dict(zip(HOPS, np.median(each, axis=0).tolist(), strict=True)),
        "cores": sum(used[name] for name in PROCESSES),
        "cores_by_process": used,
    }


def chain(stamps: dict[str, int], received: int, written: int) -> list[float]:
    """Milliseconds of each of HOPS; the first is from the board's last byte to acquisition's frame. A part goes to the
    publisher without inference, which takes no time of it.
    """
    stamps = {"infer": stamps["preprocess"], **stamps}
    times = [written, *(stamps[key] for key in ("read", "preprocess", "infer", "publish")), received]
    return [1e-6 * (b - a) for a, b in zip(times, times[1:], strict=False)]


@contextmanager
def controllers(n: int, service: Service) -> Iterator[None]:
    """n further controllers, each a process of its own; one of them stopped by SIGSTOP."""
    address = f"ipc://{service.folder}/publisher.ipc"
    made = [subprocess.Popen([sys.executable, "-c", CONTROLLER, address]) for _ in range(n)]
    try:
        time.sleep(SETTLE_S)
        made[0].send_signal(signal.SIGSTOP)
        yield
    finally:
        for process in made:
            process.kill()
            process.wait()


def hops_table(rows: list[dict[str, Any]]) -> Table:
    headings = "scan", "scene", "frames/s", "p50", "p99", *HOPS, "cores"
    made = titled(f"board's last byte to a controller's recv, ms, {machine()}", headings, 2)
    for row in rows:
        cells = [row["rate_hz"], row["p50_ms"], row["p99_ms"], *row["hops_p50_ms"].values(), row["cores"]]
        made.add_row(row["scan"], row["scene"], *(f"{value:.2f}" for value in cells))
    return made


# -- stages -----------------------------------------------------------------------------------------------------------
def stages(seconds: float, rounds: int) -> dict[str, Any]:
    """CPU ms of a whole scan's frame by variant and scene, the stages in one process, frames packed and unpacked
    between them as on the wire; and by how much resident memory grows between the first round and the last.
    """
    bundle, scenes = Bundle.load("square16"), {name: recorded("full", name, seconds) for name in SCENES}
    used: dict[str, dict[str, float]] = {}
    memory = []
    for _ in range(rounds):  # the variants in turns: the machine's load changes
        for name, touch in VARIANTS.items():
            for scene in SCENES:
                skin, row = Skin(port="stub", bundle="square16", touch=touch), used.setdefault(name, {})
                ms = one_process(scenes[scene], skin, bundle)
                row[scene] = min(ms, row.get(scene, np.inf))
        gc.collect()
        memory.append(int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
    frames = rounds * len(VARIANTS) * sum(len(each) for each in scenes.values())
    return {"cpu_ms": used, "frames": frames, "memory_mb": memory, "growth": memory[-1] / memory[0] - 1}


def one_process(frames: list[RawFrame], skin: Skin, bundle: Bundle) -> float:
    """CPU ms a frame, after the quiet time."""
    chained, used = build_stages("palm", skin, bundle), []
    for raw in frames:
        data = pack(raw)
        began = time.thread_time()
        for stage in chained:
            made: list[Frame] = stage.everything(unpack(data), PLAIN)
            for frame in made:
                frame.stamps.setdefault(stage.stamp, time.monotonic_ns())
            data = [pack(frame) for frame in made][0]
        if raw.stamps["sample"] * 1e-9 > QUIET_S:
            used.append(time.thread_time() - began)
        for stage in chained:
            stage.prepare()
    return 1e3 * float(np.mean(used))


def stages_table(found: dict[str, Any]) -> Table:
    made = titled(f"stages with their wire in one process, CPU ms a whole scan, {machine()}", ("", *SCENES))
    for name, row in found["cpu_ms"].items():
        made.add_row(name, *(f"{row[scene]:.2f}" for scene in SCENES))
    return made


# ---------------------------------------------------------------------------------------------------------------------
def goals(found: dict[str, Any]) -> list[Goal]:
    made = []
    for row in found.get("hops", []):
        name = f"{'whole scans' if row['scan'] == 'full' else 'in parts'}, {row['scene']}"
        made += [Goal(f"{name}: {key[:3]}, ms", row[key], at_most=most) for key, most in TARGET_MS.items()]
        most = CORES.get(row["scene"]) if row["scan"] == "rolling" else None
        made.append(Goal(f"{name}: cores, four processes", row["cores"], at_most=most))
        made.append(Goal(f"{name}: stamps that go backwards", row["backwards"], at_most=0))
        if "controllers" in name:
            alone = next(r for r in found["hops"] if r["scan"] == row["scan"] and r["scene"] == "moving")
            made.append(Goal(f"{name}: p50, of one controller's", row["p50_ms"] / alone["p50_ms"], at_most=UNNOTICED))
    if "stages" in found:
        ours = found["stages"]["cpu_ms"]["all rules"]
        for scene, most in (("untouched", 0.25), ("still", 0.5)):
            made.append(Goal(f"stages, {scene}: CPU of a moving touch's", ours[scene] / ours["moving"], at_most=most))
        made.append(Goal("growth of the stages' memory", found["stages"]["growth"], at_most=0.01))
    return made + scale.goals(found.get("scale", []))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench latency", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--seconds", type=real(), default=20.0, help="of each condition")
    parser.add_argument("--skins", type=whole(), nargs="+", default=[1, 4, 16, 32], help="whole scans")
    parser.add_argument("--in-parts", type=whole(), nargs="+", default=[1, 2, 4, 8], help="skins whose scans come so")
    parser.add_argument("--touched", type=real(itself=True), default=0.25, help="share of the skins")
    parser.add_argument("--quick", action="store_true", help="4 s of each condition, fewer skins and controllers")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    console, found = Console(width=150), dict[str, Any]()
    seconds, more = (4.0, 4) if args.quick else (args.seconds, CONTROLLERS)
    if "hops" in args.sections:
        found["hops"] = hops(seconds, more)
        console.print(hops_table(found["hops"]))
    if "stages" in args.sections:
        found["stages"] = stages(seconds, 2 if args.quick else ROUNDS)
        console.print(stages_table(found["stages"]))
    if "scale" in args.sections:
        counts = {"full": [1, 4], "rolling": [1]} if args.quick else {"full": args.skins, "rolling": args.in_parts}
        found["scale"] = [scale.scaled(n, s, args.touched, seconds) for s in SCANS for n in counts[s]]
        console.print(scale.table(found["scale"]))
    wanted = goals(found)
    console.print(_goals.table(wanted))
    write_report(args.out / "latency.json", argv, wanted, found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
