"""Many skins on one set of processes, each a recording of the stub's board played at its own rate and phase: latency
from a frame read to one controller's recv, frames that were overtaken, CPU and memory.

A frame that is left out is to be counted in `status`; of scans in parts, parts are, in preprocessing.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from rich.table import Table

from bench.goals import Goal, titled
from bench.machine import machine
from bench.speed.recorded import recorded
from bench.speed.service import Service, running, subscribed
from protocol.frames import RawFrame, pack
from services.recordings.recording import RecordingWriter
from services.runtime.config import ScanMode
from services.runtime.stage import PROCESSES

TARGET_MS = 20.0
TARGET_SKINS = {"full": 32, "rolling": 8}
START_S = 30.0  # of a recording, untouched: processes start, the tare
MARGIN_S = 3.0  # of a recording, beyond what is measured
STATUS_S = 1.5  # for the last status frames to tell what was dropped


def scaled(n: int, scan: ScanMode, touched: float, seconds: float) -> dict[str, Any]:
    """A row of n skins, a share `touched` of them with a moving touch."""
    moving = [(k + 0.5) * touched % 1 < touched and touched > 0 for k in range(n)]
    length_s = seconds + 2 * STATUS_S + MARGIN_S
    played = [recorded(scan, "moving" if each else "untouched", length_s, START_S) for each in moving]
    period_s = 1e-9 * float(np.median(np.diff([f.stamps["sample"] for f in played[0]])))
    with tempfile.TemporaryDirectory(prefix="eitskin-scale") as folder:
        lines = []
        for k in range(n):
            path = Path(folder, f"s{k:02d}.mcap")
            _write(path, path.stem, played[k], (k * 0.618) % 1 * period_s)
            lines.append(f'[skins.{path.stem}]\nport = "{path}"\nbundle = "square16"\nscan = "{scan}"\n')
        config = Path(folder, "skin.toml")
        config.write_text("\n".join(lines))
        with running("--config", str(config), skin="s00") as service:
            if moving[0]:  # until the quiet beginning of the recordings is over
                service.until("s00", lambda frame: frame["contacts"], START_S + MARGIN_S)
            return {"scan": scan, "skins": n, "touched": sum(moving) / n, **measured(service, seconds, n / period_s)}


def _write(path: Path, skin: str, frames: Sequence[RawFrame], phase_s: float) -> None:
    with RecordingWriter(path) as writer:
        for k, frame in enumerate(frames):
            later = {**frame.stamps, "sample": frame.stamps["sample"] + round(phase_s * 1e9) * (k > 0)}
            topic, _, body = pack(replace(frame, skin=skin, stamps=later)).partition(b"\0")
            writer.write(topic.decode(), body, later["sample"])


def measured(service: Service, seconds: float, played_hz: float) -> dict[str, Any]:
    """What a controller that takes every contact sees, and what the processes say that they left out."""
    socket = subscribed(service.folder, PROCESSES, b"contact/", b"status/")
    latency: list[float] = []
    seen = set[str]()
    first: dict[tuple[str, str], dict[str, Any]] = {}
    last: dict[tuple[str, str], dict[str, Any]] = {}
    cpu: dict[str, float] = {}
    began = time.monotonic() + STATUS_S
    while (now := time.monotonic()) < began + seconds + STATUS_S:
        if now >= began and not cpu:
            cpu = service.cpu_s()
        if not socket.poll(100):
            continue
        message = socket.recv()
        at = time.monotonic_ns()
        name, _, body = message.partition(b"\0")
        frame = msgpack.unpackb(body)
        if name.startswith(b"status/"):
            key = frame["process"], frame["skin"]
            last[key] = frame
            if now < began or key not in first:
                first[key] = frame
        elif began <= now < began + seconds:
            seen.add(frame["skin"])
            latency.append((at - frame["stamps"]["read"]) * 1e-6)
    took = time.monotonic() - began
    cores = sum(used - cpu[name] for name, used in service.cpu_s().items()) / took
    socket.close(0)
    sample_s = np.mean([(last[k]["stamps"]["publish"] - first[k]["stamps"]["publish"]) * 1e-9 for k in last])
    dropped = sum(sum(last[k]["drops"].values()) - sum(first[k]["drops"].values()) for k in last)
    return {
        "skins_seen": len(seen),
        "frames": len(latency),
        "p50_ms": float(np.percentile(latency or [np.inf], 50)),
        "p99_ms": float(np.percentile(latency or [np.inf], 99)),
        "overtaken": int(dropped) / max(played_hz * float(sample_s), 1.0),
        "cores": cores,
        "memory_mb": sum(service.memory_bytes().values()) / 1e6,
    }


def goals(rows: Sequence[dict[str, Any]]) -> list[Goal]:
    found = []
    for row in rows:
        which = f"{row['skins']} skins {'in whole scans' if row['scan'] == 'full' else 'in parts'}"
        most = TARGET_MS if row["skins"] == TARGET_SKINS[row["scan"]] else None
        found.append(Goal(f"{which}: p99, ms", row["p99_ms"], at_most=most))
        found.append(Goal(f"{which}: skins not seen", row["skins"] - row["skins_seen"], at_most=0))
        found.append(Goal(f"{which}: share of what was measured overtaken by newer", row["overtaken"]))
        found.append(Goal(f"{which}: cores", row["cores"]))
    return found


def table(rows: Sequence[dict[str, Any]]) -> Table:
    headings = "scan", "skins", "touched", "contacts", "overtaken %", "p50 ms", "p99 ms", "cores", "memory MB"
    made = titled(f"skins from recordings on one set of processes, {machine()}", headings)
    for row in rows:
        numbers = [100 * row["overtaken"], row["p50_ms"], row["p99_ms"], row["cores"], row["memory_mb"]]
        cells = f"{row['skins']}", f"{100 * row['touched']:.0f} %", f"{row['frames']}"
        made.add_row(row["scan"], *cells, *(f"{value:.2f}" for value in numbers))
    return made
