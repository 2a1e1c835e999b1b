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
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.service import Outside, Service, end_on_sigterm, running
from bench.speed.skip import scenes
from bench.tracking.scene import Recorded
from protocol.frames import pack
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
    lines, moving = [], [(k + 0.5) * touched % 1 < touched and touched > 0 for k in range(n)]
    for k in range(n):
        recorded = of["moving" if moving[k] else "untouched"]
        name = f"s{k:02d}"
        _write(folder / f"{name}.mcap", name, recorded, phase_s=(k * 0.618) % 1 / RATE_HZ)
        lines.append(f'[skins.{name}]\nport = "{folder / name}.mcap"\nbundle = "square16"\n')
    path = folder / "skin.toml"
    path.write_text("\n".join(lines))
    return path, sum(moving), 1 / float(np.median(np.diff(of["untouched"].seconds)))


def _write(path: Path, skin: str, recorded: Recorded, phase_s: float) -> None:
    with RecordingWriter(path) as writer:
        for k in range(len(recorded)):
            frame = recorded.frame(k)
            frame.skin = skin
            frame.stamps["sample"] += round(phase_s * 1e9) * (k > 0)
            topic, _, body = pack(frame).partition(b"\0")
            writer.write(topic.decode(), body, frame.stamps["sample"])


def measure(service: Service, n: int, seconds: float, rate_hz: float) -> dict[str, Any]:
    """What one controller that takes everything sees of n skins."""
    socket = Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 100_000)
    for process in PROCESSES:
        socket.connect(f"ipc://{service.folder}/{process}.ipc")
    for topic in (b"contact/", b"status/"):
        socket.subscribe(topic)
    latency: list[float] = []
    seen = Counter[str]()
    dropped: dict[tuple[str, str], list[int]] = {}  # said by status frames: the last before we count, those after
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
            counts = dropped.setdefault(key, [])
            if now < began:
                counts.clear()
            counts.append(sum(frame["drops"].values()))
        elif began <= now < began + seconds:
            seen[frame["skin"]] += 1
            latency.append((at - frame["stamps"]["read"]) * 1e-6)
    took = time.monotonic() - began
    used = {name: seconds_used - cpu[name] for name, seconds_used in service.cpu_s().items()}
    socket.close(0)
    frames = seen.total()
    expected = max(frames, n * (int(rate_hz * seconds) - 1))  # one may lie on the window's edge
    reported = sum(counts[-1] - counts[0] for counts in dropped.values())
    return {
        "skins": n,
        "skins_seen": len(seen),
        "frames": frames,
        "lost": (expected - frames) / max(expected, 1),
        "reported_dropped": reported,
        "unreported": max(0, expected - frames - reported) / max(expected, 1),
        "p50_ms": float(np.percentile(latency or [np.inf], 50)),
        "p99_ms": float(np.percentile(latency or [np.inf], 99)),
        "cores": sum(used.values()) / took,
        "cores_by_process": {k: v / took for k, v in used.items()},
        "memory_mb": {k: v / 1e6 for k, v in service.memory_bytes().items()},
    }


def scaled(n: int, touched: float, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="eitskin-scale") as folder:
        path, moving, rate_hz = recordings(Path(folder), n, touched, seconds + 2 * STATUS_S + MARGIN_S)
        with running("--config", str(path), skin="s00") as service:
            _wait_for_touch(service, touched)
            return {"touched": moving / n, **measure(service, n, seconds, rate_hz)}


def _wait_for_touch(service: Service, touched: float) -> None:
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
    parser.add_argument("--skins", type=int, nargs="+", default=[1, 4, 16, 32, 64])
    parser.add_argument("--seconds", type=float, default=15.0, help="of each measurement")
    parser.add_argument("--touched", type=float, nargs="+", default=[0.25, 1.0], help="shares of the skins")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    rows = [scaled(n, share, args.seconds) for share in args.touched for n in args.skins]
    Console(width=120).print(table(rows))
    wanted = goals(rows)
    Console(width=120).print(_goals.table(wanted))
    report = {**provenance("scale", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    write_json(args.out / "scale.json", report)
    from bench import plots  # matplotlib takes a while

    plots.draw(args.out / "scale.json")
    print(f"wrote {args.out / 'scale.json'} and scale.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
