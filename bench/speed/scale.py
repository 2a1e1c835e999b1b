"""Many skins on one set of processes: frames lost, latency, CPU and memory against their number.

    skin bench scale [--skins 1 4 16 32 64] [--seconds 15] [--touched 0.25 1.0]

Every skin is a recording of the stub's board, played at its own 22 frames a second and phase through the real
processes. `touched`: the share of the skins that a moving touch is on all the time; the others have none. Latency is
from a frame read by acquisition to one controller's recv, which takes the contacts of all skins. Prints a table,
writes scale.json and draws scale.png.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zmq
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import drawn, write_json
from bench.machine import machine, provenance
from bench.speed.service import Outside, Service, end_on_sigterm, running
from bench.speed.skip import scenes
from models.command import real, whole
from protocol.frames import RawFrame, pack
from protocol.transport import Context
from services.recordings.recording import RecordingWriter
from services.runtime.stage import PROCESSES

RATE_HZ = 22.0
TARGET = {"skins": 32, "p99_ms": 20.0}
START_S = 30.0  # of a recording, untouched: processes start, the tare
MARGIN_S = 3.0  # of a recording, beyond what is measured
STATUS_S = 1.5  # for the last status frames to tell what was dropped


def recordings(folder: Path, n: int, touched: float, seconds: float) -> tuple[Path, int, float]:
    """n recordings and the skin.toml that plays them: its path, how many are touched, their frames a second."""
    of = scenes(seconds, START_S)
    frames = {name: [recorded.frame(k) for k in range(len(recorded))] for name, recorded in of.items()}
    path, moving = written(folder, n, touched, frames, 1 / RATE_HZ, "")
    return path, moving, 1 / float(np.median(np.diff(of["untouched"].seconds)))


def written(
    folder: Path, n: int, touched: float, frames: Mapping[str, Sequence[RawFrame]], period_s: float, settings: str
) -> tuple[Path, int]:
    """The skin.toml that plays recordings of `frames["moving"]` and `frames["untouched"]`, each at a phase of its own
    within period_s, and how many of the n are touched. settings: further lines of TOML of each skin.
    """
    lines, moving = [], [(k + 0.5) * touched % 1 < touched and touched > 0 for k in range(n)]
    for k in range(n):
        name = f"s{k:02d}"
        _write(
            folder / f"{name}.mcap", name, frames["moving" if moving[k] else "untouched"], (k * 0.618) % 1 * period_s
        )
        lines.append(f'[skins.{name}]\nport = "{folder / name}.mcap"\nbundle = "square16"\n{settings}')
    path = folder / "skin.toml"
    path.write_text("\n".join(lines))
    return path, sum(moving)


def _write(path: Path, skin: str, frames: Sequence[RawFrame], phase_s: float) -> None:
    with RecordingWriter(path) as writer:
        for k, frame in enumerate(frames):
            later = {**frame.stamps, "sample": frame.stamps["sample"] + round(phase_s * 1e9) * (k > 0)}
            topic, _, body = pack(replace(frame, skin=skin, stamps=later)).partition(b"\0")
            writer.write(topic.decode(), body, later["sample"])


@dataclass(frozen=True)
class Said:
    """What a process said of a skin: in the last status before the measurement, and in the newest one."""

    first: dict[str, Any]
    last: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Between the two."""
        return float(self.last["stamps"]["publish"] - self.first["stamps"]["publish"]) * 1e-9

    @property
    def dropped(self) -> int:
        return int(sum(self.last["drops"].values()) - sum(self.first["drops"].values()))

    def counted(self, name: str) -> int:
        return int(self.last.get("counters", {}).get(name, 0) - self.first.get("counters", {}).get(name, 0))


@dataclass
class Traffic:
    """What one controller that takes everything saw within the seconds measured."""

    latency_ms: list[float]
    seen: Counter[str]  # contact frames, by skin
    missing: int  # between those seen, by their numbers
    said: dict[tuple[str, str], Said]  # by process and skin
    cores: dict[str, float]
    memory_mb: dict[str, float]

    def row(self) -> dict[str, Any]:
        """What is reported of any traffic."""
        return {
            "skins_seen": len(self.seen),
            "frames": self.seen.total(),
            "p50_ms": float(np.percentile(self.latency_ms or [np.inf], 50)),
            "p99_ms": float(np.percentile(self.latency_ms or [np.inf], 99)),
            "cores": sum(self.cores.values()),
            "cores_by_process": self.cores,
            "memory_mb": self.memory_mb,
        }


def listen(service: Service, seconds: float) -> Traffic:
    socket = Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 100_000)
    for process in PROCESSES:
        socket.connect(f"ipc://{service.folder}/{process}.ipc")
    for topic in (b"contact/", b"status/"):
        socket.subscribe(topic)
    latency: list[float] = []
    seen, numbers, missing = Counter[str](), dict[str, int](), 0
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
        else:
            missing += frame["seq"] - numbers.get(frame["skin"], frame["seq"] - 1) - 1
            numbers[frame["skin"]] = frame["seq"]
            if began <= now < began + seconds:
                seen[frame["skin"]] += 1
                latency.append((at - frame["stamps"]["read"]) * 1e-6)
    took = time.monotonic() - began
    cores = {name: (used - cpu[name]) / took for name, used in service.cpu_s().items()}
    socket.close(0)
    said = {key: Said(first[key], last[key]) for key in first}
    memory_mb = {name: used / 1e6 for name, used in service.memory_bytes().items()}
    return Traffic(latency, seen, missing, said, cores, memory_mb)


def measure(service: Service, n: int, seconds: float, rate_hz: float) -> dict[str, Any]:
    """What one controller that takes everything sees of n skins."""
    traffic = listen(service, seconds)
    frames = traffic.seen.total()
    expected = max(frames, n * (int(rate_hz * seconds) - 1))  # one may lie on the window's edge
    reported = sum(said.dropped for said in traffic.said.values())
    return {
        "skins": n,
        **traffic.row(),
        "lost": (expected - frames) / max(expected, 1),
        "reported_dropped": reported,
        "unreported": max(0, expected - frames - reported) / max(expected, 1),
    }


def scaled(n: int, touched: float, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="eitskin-scale") as folder:
        path, moving, rate_hz = recordings(Path(folder), n, touched, seconds + 2 * STATUS_S + MARGIN_S)
        with running("--config", str(path), skin="s00") as service:
            wait_for_touch(service, touched)
            return {"touched": moving / n, **measure(service, n, seconds, rate_hz)}


def wait_for_touch(service: Service, touched: float) -> None:
    """Wait until the recordings' quiet beginning is over: the first skin is a touched one, if any is."""
    contacts = Outside("contact", "s00", service.folder)
    end = time.monotonic() + START_S + MARGIN_S
    while time.monotonic() < end and touched > 0:
        got = contacts.recv(0.5)
        if got and got[0]["contacts"]:
            break
    contacts.close()


def goals(rows: list[dict[str, Any]]) -> list[Goal]:
    found = []
    for row in rows:
        which = f"{row['skins']} skins, {100 * row['touched']:.0f} % touched"
        if row["skins"] == TARGET["skins"]:
            found.append(Goal(f"{which}: p99, ms", row["p99_ms"], at_most=TARGET["p99_ms"]))
        found.append(Goal(f"{which}: skins not seen", row["skins"] - row["skins_seen"], at_most=0, gate=0))
        found.append(Goal(f"{which}: share of frames lost", row["lost"]))
        found.append(Goal(f"{which}: lost without a word, share", row["unreported"], at_most=0.0, gate=0.0))
    for share in sorted({row["touched"] for row in rows}):
        mine = sorted((r for r in rows if r["touched"] == share), key=lambda row: row["skins"])
        if len(mine) > 1:
            one, many = mine[0], mine[-1]
            ratio = many["cores"] / many["skins"] / (one["cores"] / one["skins"])
            which = f"CPU a skin with {many['skins']}, of one's with {one['skins']}, {100 * share:.0f} % touched"
            found.append(Goal(which, ratio, gate=1.0))
    return found


def table(rows: list[dict[str, Any]]) -> Table:
    made = Table(title=f"skins at {RATE_HZ:g} frames/s from recordings, {machine()}", title_justify="left")
    for heading in ("skins", "touched", "frames", "lost %", "said", "p50 ms", "p99 ms", "cores", "memory MB"):
        made.add_column(heading, justify="right")
    for row in rows:
        made.add_row(
            str(row["skins"]),
            f"{100 * row['touched']:.0f} %",
            str(row["frames"]),
            f"{100 * row['lost']:.2f}",
            str(row["reported_dropped"]),
            f"{row['p50_ms']:.2f}",
            f"{row['p99_ms']:.2f}",
            f"{row['cores']:.2f}",
            f"{sum(row['memory_mb'].values()):.0f}",
        )
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench scale", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--skins", type=whole(), nargs="+", default=[1, 4, 16, 32, 64])
    parser.add_argument("--seconds", type=real(), default=15.0, help="of each measurement")
    parser.add_argument("--touched", type=real(itself=True), nargs="+", default=[0.25, 1.0], help="shares of the skins")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    rows = [scaled(n, share, args.seconds) for share in args.touched for n in args.skins]
    Console(width=120).print(table(rows))
    wanted = goals(rows)
    Console(width=120).print(_goals.table(wanted))
    report = {**provenance("scale", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    write_json(args.out / "scale.json", report)
    drawn(args.out / "scale.json")
    print(f"wrote {args.out / 'scale.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
