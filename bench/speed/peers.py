"""Beside others, in one run: a frame through pyEIT's solve, and a relay of four hops over rospy and eclipse-zenoh.

    skin bench peers [--frames 100] [--rounds 3]

Part one: one scan of 120 measurements through pyEIT's solvers, through the matrices and the network of our stages, and
a touch's frames through all of our stages, in turns. Part two: messages of the sizes of the service's hops through four
hops between processes, at 22 frames a second, the transports in turns: bare pyzmq, the service's own checked frames,
eclipse-zenoh, rospy. A peer that is not installed is left out and said so (Debian: python3-rospy, python3-roslaunch).
Prints tables, writes peers.json.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.accuracy.peers import PyEIT, name
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import machine, provenance
from bench.speed.relay_frames import HOPS, sizes
from bench.speed.service import end_on_sigterm
from bench.speed.skip import ENDS_S, QUIET_S, scenes
from bench.tracking.scene import Recorded
from models.command import whole
from services.networks import Network
from services.pipeline import Pipeline
from services.recordings.replay_session import stop
from services.runtime.config import Skin

RELAY = Path(__file__).with_name("relay.py")
SYSTEM_PYTHON = "/usr/bin/python3"  # rospy is Debian's
START_S = 30.0
MOVING_S = 6.0
SLOWER, CHECKED, LOST = 4.0, 6.0, 0.1  # a short run's gates
EACH = 200  # times that a frame is solved in a round


def solvers(recorded: Recorded) -> dict[str, Callable[[], Any]]:
    """What to time: each takes one and the same touched frame."""
    pipeline = _pipeline()
    results = [pipeline.run(recorded.frame(k)) for k in range(len(recorded))]
    touched = next(r.delta for r in reversed(results) if r.delta.averaged)
    operator = pipeline.pre.pre.condition(touched.sigma.astype(float))
    d, network, stack = touched.difference.astype(float), pipeline.inference._network, pipeline.inference.stack(touched)
    assert isinstance(network, Network) and stack is not None
    found: dict[str, Callable[[], Any]] = {
        "eitskin, pre-reconstruction (nine images)": lambda: operator.stack(d),
        "eitskin, network": lambda: network.run(stack),
    }
    for method in ("jac", "greit", "bp"):
        peer = PyEIT(method, pairs=True)
        found[f"{name()} {method}, its own mesh"] = lambda peer=peer: peer(d)  # type: ignore[misc]
    return found


def _pipeline() -> Pipeline:
    return Pipeline(Skin(port="stub", bundle="square16", frame_id="palm"))


def all_stages(recorded: Recorded) -> list[float]:
    """Milliseconds of each frame with a moving touch through all of our stages, frames in their order."""
    pipeline, took = _pipeline(), []
    for k, s in enumerate(recorded.seconds):
        began = time.perf_counter()
        pipeline.run(recorded.frame(k))
        if QUIET_S + 1 < s < QUIET_S + MOVING_S - 2 * ENDS_S:
            took.append((time.perf_counter() - began) * 1e3)
        pipeline.prepare()
    return took


def solved(rounds: int) -> dict[str, dict[str, float]]:
    """method -> milliseconds a frame, the methods in turns."""
    recorded = scenes(MOVING_S)["moving"]
    took: dict[str, list[float]] = {}
    for _ in range(rounds):
        for method, run in solvers(recorded).items():
            run()
            for _ in range(EACH):
                began = time.perf_counter()
                run()
                took.setdefault(method, []).append((time.perf_counter() - began) * 1e3)
        took.setdefault("eitskin, all stages: frame to contacts", []).extend(all_stages(recorded))
    return {
        method: {"p50_ms": float(np.median(times)), "p99_ms": float(np.percentile(times, 99))}
        for method, times in took.items()
    }


@contextmanager
def started(command: list[str], environment: dict[str, str], log: Path, **more: Any) -> Iterator[subprocess.Popen[str]]:
    """A process until the block ends."""
    with log.open("a") as errors:
        process = subprocess.Popen(command, env=os.environ | environment, stderr=errors, text=True, **more)
    try:
        yield process
    finally:
        stop(process)


class Relay:
    """Three nodes and both ends of one transport, running until `stack` closes."""

    def __init__(
        self, transport: str, where: str, python: str, environment: dict[str, str], log: Path, stack: ExitStack
    ):
        command = [python, str(RELAY), transport, where]
        for position in range(1, len(HOPS)):
            arguments = [*command, str(position), json.dumps(sizes())]
            stack.enter_context(started(arguments, environment, log, stdout=subprocess.DEVNULL))
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.ends = stack.enter_context(started([*command, "0", json.dumps(sizes())], environment, log, **pipes))

    def run(self, frames: int) -> list[float]:
        """Milliseconds of each frame that came through. Raises RuntimeError where none can."""
        assert self.ends.stdin is not None and self.ends.stdout is not None
        self.ends.stdin.write(f"{frames}\n")
        self.ends.stdin.flush()
        line = self.ends.stdout.readline()
        if not line:
            raise RuntimeError(f"a relay ended by itself, exit status {self.ends.wait()}")
        return [float(ms) for ms in json.loads(line)]


def relays(folder: Path, stack: ExitStack) -> tuple[dict[str, Relay], list[str]]:
    """The transports that there are, and what to say of those that there are not."""
    log, missing = folder / "log.txt", []
    port = _free_ports(1 + len(HOPS))  # roscore's, then zenoh's
    found = {
        "bare pyzmq": Relay("zmq", str(folder), sys.executable, {}, log, stack),
        "eitskin": Relay("eitskin", str(folder), sys.executable, {}, log, stack),
    }
    try:
        title = f"eclipse-zenoh {version('eclipse-zenoh')}"
        found[title] = Relay("zenoh", str(port + 1), sys.executable, {}, log, stack)
    except PackageNotFoundError:
        missing.append("eclipse-zenoh is not installed (make venv EXTRAS=peers): left out")
    ros = _ros_version()
    if ros and shutil.which("roscore"):
        at_home = {
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder / "ros"),
            "PYTHONPATH": "",
        }
        core = ["roscore", "-p", str(port)]
        stack.enter_context(started(core, at_home, log, stdout=subprocess.DEVNULL))
        _wait_for(port)
        found[f"rospy {ros}"] = Relay("rospy", str(folder), SYSTEM_PYTHON, at_home, log, stack)
    else:
        missing.append("rospy is not installed (apt install python3-rospy python3-roslaunch): left out")
    return found, missing


def _ros_version() -> str:
    """ "" where Debian's Python has no rospy."""
    ask = "import rospy, std_msgs.msg, rosgraph; from importlib.metadata import version; print(version('rospy'))"
    try:
        done = subprocess.run([SYSTEM_PYTHON, "-c", ask], capture_output=True, text=True, timeout=START_S)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def _free_ports(n: int) -> int:
    """The first of n free ports in a row on the loopback interface."""
    for first in range(20_000, 60_000, n):
        with ExitStack() as stack:
            try:
                for port in range(first, first + n):
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", port))
                return first
            except OSError:
                continue
    raise RuntimeError(f"no {n} free ports in a row on 127.0.0.1")


def _wait_for(port: int) -> None:
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise RuntimeError(f"roscore does not answer on port {port} after {START_S:.0f} s")


def relayed(frames: int, rounds: int) -> tuple[dict[str, dict[str, float]], list[str]]:
    """(transport -> milliseconds over four hops, what was left out)."""
    took: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory(prefix="eitskin-relay", dir="/tmp") as folder, ExitStack() as stack:
        found, missing = relays(Path(folder), stack)
        for relay in found.values():
            relay.run(5)
        for _ in range(rounds):
            for transport, relay in found.items():
                took.setdefault(transport, []).extend(relay.run(frames))
    missing += [f"{transport} relayed nothing: left out" for transport, times in took.items() if not times]
    sent = frames * rounds
    return {
        transport: {
            "p50_ms": float(np.percentile(times, 50)),
            "p99_ms": float(np.percentile(times, 99)),
            "lost": sent - len(times),
            "sent": sent,
        }
        for transport, times in took.items()
        if times
    }, missing


def goals(solving: dict[str, dict[str, float]], relaying: dict[str, dict[str, float]]) -> list[Goal]:
    """Ours over theirs, medians."""
    ours, found = solving["eitskin, pre-reconstruction (nine images)"]["p50_ms"], []
    for method, row in solving.items():
        if method.startswith("pyEIT"):
            figure = f"pre-reconstruction's time, of {method}'s"
            found.append(Goal(figure, ours / row["p50_ms"], gate=SLOWER if "jac" in method else None))
    for transport, row in relaying.items():
        if transport != "eitskin":
            figure = f"four hops of checked frames, of {transport}'s opaque bytes"
            found.append(Goal(figure, relaying["eitskin"]["p50_ms"] / row["p50_ms"], gate=CHECKED))
    lost = relaying["eitskin"]["lost"] / relaying["eitskin"]["sent"]
    return [*found, Goal("share of our frames lost in the relay", lost, at_most=0.0, gate=LOST)]


def table(title: str, rows: dict[str, dict[str, float]], reference: str) -> Table:
    made = Table(title=title, title_justify="left")
    for heading in ("", "p50 ms", "p99 ms", "times ours", "lost"):
        made.add_column(heading, justify="right" if heading else "left")
    for label, row in rows.items():
        ratio = f"{row['p50_ms'] / rows[reference]['p50_ms']:.2f}"
        made.add_row(label, f"{row['p50_ms']:.3f}", f"{row['p99_ms']:.3f}", ratio, str(row.get("lost", "")))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench peers", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--frames", type=whole(), default=100, help="of each transport in a round")
    parser.add_argument("--rounds", type=whole(), default=3)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    solving = solved(args.rounds)
    console = Console(width=110)
    console.print(table(f"one scan of 120 measurements, warm, {machine()}", solving, next(iter(solving))))
    relaying, missing = relayed(args.frames, args.rounds)
    of = " + ".join(f"{n / 1024:.1f}" for n in sizes())
    console.print(table(f"four hops between processes, {of} kB, 22 frames/s", relaying, "eitskin"))
    for line in missing:
        print(line)
    wanted = goals(solving, relaying)
    console.print(_goals.table(wanted))
    report = {**provenance("peers", argv), "targets": [goal.to_dict() for goal in wanted]}
    write_json(args.out / "peers.json", report | {"solve": solving, "relay": relaying, "left_out": missing})
    print(f"wrote {args.out / 'peers.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
