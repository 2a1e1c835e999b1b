"""Latency: from the last byte of a scan that the board writes to a controller's recv, hop by hop, beside the floor.

    skin bench latency [--seconds 20] [--controllers 1 4 16] [--parts-only]

Real processes, the stub's board behind its serial device, a plain pyzmq controller; then the same with a real-time
priority, where this machine grants one. The floor is the same stages on the same frames in one process without
sockets, each frame as it arrives: equally cold, and under the same load of the machine. Scans in parts are measured
too, with the CPU that they cost (latency_parts.py). Prints tables, writes latency.json and draws latency.png.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import drawn, write_json
from bench.machine import machine, provenance
from bench.speed import latency_parts
from bench.speed.service import BEGIN, Outside, Service, end_on_sigterm, running_square
from models.command import real, whole
from protocol.frames import RawFrame, TruthFrame
from protocol.sockets import AllReader
from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.stage import PROCESSES

HOPS = ("acquire", "preprocess", "infer", "publish", "receive")
TARGET_MS = {"p50": 2.0, "p99": 5.0}
HOP_MS = 0.15  # what a hop between processes may cost
UNNOTICED = 1.1  # p50 with more controllers over one's
FLOORS, NOTICED = 10.0, 2.0  # a short run's gates: p50 over the floor's, p50 with more controllers over one's
PRIORITY = 20  # SCHED_FIFO, of the rows that say so
REFUSED = "Not measured: a real-time priority, which this machine refuses (`ulimit -r`, CAP_SYS_NICE)."
SETTLE_S = 2.0
TARE_S = 6.0
CONTROLLER = """
import sys, zmq
from models.command import real, whole
s = zmq.Context.instance().socket(zmq.SUB)
s.setsockopt(zmq.CONFLATE, 1)
s.connect(sys.argv[1])
s.subscribe(b"contact/palm\\0")
while True:
    s.recv()
"""


@dataclass
class Sample:
    """n frames: hops (n, 5) and floor (n,), ms. Hops add up to what was seen outside."""

    hops: NDArray[np.float64]
    floor: NDArray[np.float64]

    @property
    def outside(self) -> NDArray[np.float64]:
        return np.asarray(self.hops.sum(axis=1))


class Watch:
    """A controller, and the floor beside it."""

    def __init__(self, service: Service) -> None:
        self.contacts = Outside("contact", "palm", service.folder)
        self.others = AllReader(["raw", "truth"], "palm")
        self.floor = Pipeline(Skin(port="stub", bundle="square16", frame_id="palm"))

    def sample(self, seconds: float) -> Sample:
        raw: dict[int, RawFrame] = {}
        written: dict[int, int] = {}
        seen: dict[int, tuple[dict[str, int], int]] = {}  # scan -> stamps, when received
        hops, floor = [], []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if got := self.contacts.recv(0.2):
                seen[got[0]["scan"]] = got[0]["stamps"], got[1]
            while frame := self.others.recv():
                if isinstance(frame, RawFrame):
                    raw[frame.scan] = frame
                elif isinstance(frame, TruthFrame):
                    written[frame.scan] = frame.stamps["publish"]
            for scan in seen.keys() & raw.keys() & written.keys():
                hops.append(chain(*seen.pop(scan), written.pop(scan)))
                began = time.perf_counter()
                self.floor.run(raw.pop(scan))
                floor.append((time.perf_counter() - began) * 1e3)
                self.floor.prepare()
        return Sample(np.array(hops), np.array(floor))

    def close(self) -> None:
        self.contacts.close()
        self.others.close()


def chain(stamps: dict[str, int], received: int, written: int) -> list[float]:
    """Milliseconds of each of HOPS; the first is from the board's last byte to acquisition's frame."""
    times = [written, *(stamps[key] for key in ("read", "preprocess", "infer", "publish")), received]
    hops = [b - a for a, b in zip(times, times[1:], strict=False)]
    return [hop * 1e-6 for hop in hops]


@contextmanager
def controllers(n: int, service: Service, stopped: bool = False) -> Iterator[None]:
    """n further controllers, each a process of its own; one of them stopped by SIGSTOP."""
    address = f"ipc://{service.folder}/publisher.ipc"
    made = [subprocess.Popen([sys.executable, "-c", CONTROLLER, address]) for _ in range(n)]
    try:
        time.sleep(SETTLE_S)
        if stopped:
            made[0].send_signal(signal.SIGSTOP)
        yield
    finally:
        for process in made:
            process.kill()
            process.wait()


def run(seconds: float, counts: list[int], priority: bool) -> tuple[dict[str, Sample], list[str]]:
    """(sample of each condition, what could not be measured)"""
    found: dict[str, list[Sample]] = {}
    with running_square("full") as service:
        watch = Watch(service)
        watch.sample(TARE_S)  # the floor takes its baseline
        for _ in range(2):  # each condition twice: the machine's load changes
            _scenes(service, watch, seconds / 2, found)
            many = [n for n in counts if n > 1]
            for n, stopped in [*((n, False) for n in many), *((n, True) for n in many[-1:])]:
                name = f"moving, {n} controllers" + (", one stopped" if stopped else "")
                BEGIN["moving"](service)
                with controllers(n - 1, service, stopped):
                    watch.sample(SETTLE_S)
                    found.setdefault(name, []).append(watch.sample(seconds / 2))
            service.stub("release")
            service.stub("scene", name="demo")
        watch.close()
    left_out = [REFUSED] if priority and not _with_priority(seconds, found) else []
    return {
        name: Sample(np.concatenate([p.hops for p in parts]), np.concatenate([p.floor for p in parts]))
        for name, parts in found.items()
    }, left_out


def _scenes(service: Service, watch: Watch, seconds: float, found: dict[str, list[Sample]], how: str = "") -> None:
    for scene, begin in BEGIN.items():
        begin(service)
        watch.sample(SETTLE_S)
        found.setdefault(scene + how, []).append(watch.sample(seconds))


def _with_priority(seconds: float, found: dict[str, list[Sample]]) -> bool:
    """The scenes with [realtime] priority; False where the processes did not get it."""
    with running_square("full", f"[realtime]\npriority = {PRIORITY}\n") as service:
        pids = service.pids()
        if any(os.sched_getscheduler(pids[name]) != os.SCHED_FIFO for name in PROCESSES):
            return False
        watch = Watch(service)
        watch.sample(TARE_S)
        _scenes(service, watch, seconds, found, f", SCHED_FIFO {PRIORITY}")
        watch.close()
    return True


def figures(sample: Sample) -> dict[str, Any]:
    p50, p99 = (float(np.percentile(sample.outside, q)) for q in (50, 99))
    floor = float(np.median(sample.floor))
    return {
        "frames": len(sample.hops),
        "backwards": int((sample.hops < 0).any(axis=1).sum()),
        "p50_ms": p50,
        "p99_ms": p99,
        "floor_p50_ms": floor,
        "floor_p99_ms": float(np.percentile(sample.floor, 99)),
        "hops_p50_ms": dict(zip(HOPS, np.median(sample.hops, axis=0).tolist(), strict=True)),
        "hops_p99_ms": dict(zip(HOPS, np.percentile(sample.hops, 99, axis=0).tolist(), strict=True)),
        "per_hop_above_floor_ms": (p50 - floor) / 4,
    }


def goals(rows: dict[str, dict[str, Any]]) -> list[Goal]:
    """The gates are ratios: to the floor of the same run, and of one condition to another."""
    found = []
    for name, row in rows.items():
        found.append(Goal(f"{name}: p50, ms", row["p50_ms"], at_most=TARGET_MS["p50"]))
        found.append(Goal(f"{name}: p99, ms", row["p99_ms"], at_most=TARGET_MS["p99"]))
        found.append(Goal(f"{name}: stamps that go backwards", row["backwards"], at_most=0, gate=0))
        if "SCHED_FIFO" in name:  # the floor has the usual priority
            continue
        found.append(Goal(f"{name}: p50 above the floor, ms a hop", row["per_hop_above_floor_ms"], at_most=HOP_MS))
        found.append(Goal(f"{name}: p50 of floor's", row["p50_ms"] / row["floor_p50_ms"], gate=FLOORS))
    alone = rows["moving"]["p50_ms"]
    for name, row in rows.items():
        if "controllers" in name:
            figure = f"{name}: p50, of one controller's"
            found.append(Goal(figure, row["p50_ms"] / alone, at_most=UNNOTICED, gate=NOTICED))
    return found


def table(rows: dict[str, dict[str, Any]]) -> Table:
    made = Table(title=f"board's last byte to controller's recv, ms, {machine()}", title_justify="left")
    for heading in ("", "frames", "p50", "p99", "floor p50", "floor p99", "a hop above it", *HOPS):
        made.add_column(heading, justify="left" if not heading else "right")
    for name, row in rows.items():
        cells = [row["p50_ms"], row["p99_ms"], row["floor_p50_ms"], row["floor_p99_ms"], row["per_hop_above_floor_ms"]]
        cells += row["hops_p50_ms"].values()
        made.add_row(name, str(row["frames"]), *(f"{v:.2f}" for v in cells))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench latency", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=real(), default=20.0, help="of each condition")
    parser.add_argument("--controllers", type=whole(), nargs="+", default=[1, 4, 16])
    parser.add_argument("--parts-only", action="store_true", help="scans in parts alone; writes no report")
    parser.add_argument("--usual-priority", action="store_true", help="without the rows of a real-time priority")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    parts = latency_parts.measured(args.seconds)
    Console(width=150).print(latency_parts.table(parts))
    if args.parts_only:
        Console(width=150).print(_goals.table(latency_parts.goals(parts)))
        return 0
    samples, left_out = run(args.seconds, sorted(args.controllers), not args.usual_priority)
    rows = {name: figures(sample) for name, sample in samples.items()}
    Console(width=150).print(table(rows))
    wanted = [*goals(rows), *latency_parts.goals(parts)]
    Console(width=150).print(_goals.table(wanted))
    for line in left_out:
        print(line)
    report = {**provenance("latency", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    report |= {"left_out": left_out, "parts": parts}
    write_json(args.out / "latency.json", report)
    drawn(args.out / "latency.json")
    print(f"wrote {args.out / 'latency.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
