"""Scans in parts, live: from the last byte of a part to recv of the frame made from it, and the CPU that it costs."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import zmq
from rich.table import Table

from bench.goals import Goal
from bench.machine import machine
from bench.speed.service import BEGIN, Service, running_square
from protocol.frames import ContactFrame, TruthFrame, unpack
from protocol.transport import Context
from services.runtime.stage import PROCESSES

TARGET_MS = {"p50": 2.0, "p99": 5.0}
CORES = {"untouched": 0.30, "still": 0.5, "moving": 1.0}  # of the four processes
OF_HELD = 1.0  # a short run's gate: CPU while nothing touches, over that of a held touch
SETTLE_S = 3.0


def measured(seconds: float) -> dict[str, dict[str, Any]]:
    """The figures of each scene."""
    with running_square("rolling") as service:
        socket = Context.instance().socket(zmq.SUB)
        socket.setsockopt(zmq.RCVHWM, 100_000)
        for process, topic in (("publisher", b"contact/palm\0"), ("stub", b"truth/palm\0")):
            socket.connect(f"ipc://{service.folder}/{process}.ipc")
            socket.subscribe(topic)
        rows = {}
        for scene, begin in BEGIN.items():
            begin(service)
            _heard(socket, SETTLE_S)
            rows[scene] = _figures(service, socket, seconds)
        socket.close(0)
        service.stub("release")
    return rows


def _figures(service: Service, socket: zmq.Socket[bytes], seconds: float) -> dict[str, Any]:
    cpu, began = service.cpu_s(), time.monotonic()
    heard = _heard(socket, seconds)
    took = time.monotonic() - began
    used = {name: (after - cpu[name]) / took for name, after in service.cpu_s().items()}
    written, received = dict[int, int](), dict[int, int]()
    for message, at_ns in heard:
        frame = unpack(message)
        if isinstance(frame, TruthFrame):
            written[frame.scan] = frame.stamps["publish"]
        elif isinstance(frame, ContactFrame):
            received[frame.scan] = at_ns
    ms = [1e-6 * (received[scan] - written[scan]) for scan in received.keys() & written.keys()] or [np.inf]
    return {
        "frames": len(ms),
        "rate_hz": len(received) / took,
        "parts_hz": len(written) / took,
        "p50_ms": float(np.percentile(ms, 50)),
        "p99_ms": float(np.percentile(ms, 99)),
        "cores": sum(used[name] for name in PROCESSES),
        "cores_by_process": used,
    }


def _heard(socket: zmq.Socket[bytes], seconds: float) -> list[tuple[bytes, int]]:
    """(message, when it came) of so long; nothing is decoded meanwhile."""
    found, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        if socket.poll(int(1000 * left) + 1):
            found.append((socket.recv(), time.monotonic_ns()))
    return found


def goals(rows: dict[str, dict[str, Any]]) -> list[Goal]:
    """The gate is a ratio."""
    found = []
    for scene, row in rows.items():
        found.append(Goal(f"in parts, {scene}: p50, ms", row["p50_ms"], at_most=TARGET_MS["p50"]))
        found.append(Goal(f"in parts, {scene}: p99, ms", row["p99_ms"], at_most=TARGET_MS["p99"]))
        found.append(Goal(f"in parts, {scene}: cores, four processes", row["cores"], at_most=CORES[scene]))
    # Of a part, as a skin scans whole for a while where the computer does not keep up.
    free, held = (rows[scene]["cores"] / max(rows[scene]["parts_hz"], 1e-9) for scene in ("untouched", "still"))
    found.append(
        Goal("in parts, untouched: CPU of a part, of a held touch's", free / held, at_most=OF_HELD, gate=OF_HELD)
    )
    return found


def table(rows: dict[str, dict[str, Any]]) -> Table:
    made = Table(title=f"scans in parts: last byte of a part to recv, ms, {machine()}", title_justify="left")
    for heading in ("", "parts/s", "frames/s", "p50", "p99", "cores", *PROCESSES):
        made.add_column(heading, justify="right" if heading else "left")
    for scene, row in rows.items():
        cells = [f"{row['p50_ms']:.2f}", f"{row['p99_ms']:.2f}", f"{row['cores']:.2f}"]
        cells += [f"{row['cores_by_process'][name]:.3f}" for name in PROCESSES]
        made.add_row(scene, f"{row['parts_hz']:.0f}", f"{row['rate_hz']:.0f}", *cells)
    return made
