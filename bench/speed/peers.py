"""A relay of four hops between processes, beside others: bare pyzmq, the service's own frames, eclipse-zenoh, rclpy.

    skin bench peers [--frames 100] [--rounds 3] [--quick]

Messages of the sizes of the service's hops, at 22 frames a second, the transports in turns. A peer that is not
installed is left out and said so (`make ros-venv`, `make venv EXTRAS=peers`). Prints a table, writes peers.json. (The
time of a frame in pyEIT and in our stages is in `skin bench accuracy`.)
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal, titled
from bench.json_file import write_report
from bench.speed.relay_frames import HOPS, sizes
from bench.speed.service import end_on_sigterm
from models.command import whole
from services.recordings.replay_session import stop

RELAY = Path(__file__).with_name("relay.py")
ROS_PYTHON = Path(__file__).parents[2] / ".venv-ros" / "bin" / "python"
START_S = 30.0


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
    port = _free_ports(len(HOPS))
    found = {
        "bare pyzmq": Relay("zmq", str(folder), sys.executable, {}, log, stack),
        "eitskin": Relay("eitskin", str(folder), sys.executable, {}, log, stack),
    }
    try:
        title = f"eclipse-zenoh {version('eclipse-zenoh')}"
        found[title] = Relay("zenoh", str(port), sys.executable, {}, log, stack)
    except PackageNotFoundError:
        missing.append("eclipse-zenoh is not installed (make venv EXTRAS=peers): left out")
    if ROS_PYTHON.is_file():
        ask = "from importlib.metadata import version; print(version('ros-rclpy'))"
        told = subprocess.run([ROS_PYTHON, "-c", ask], capture_output=True, text=True, check=True, timeout=START_S)
        alone = {"ROS_DOMAIN_ID": "99", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        found[f"rclpy {told.stdout.strip()}"] = Relay("rclpy", str(folder), str(ROS_PYTHON), alone, log, stack)
    else:
        missing.append("rclpy is not installed (make ros-venv): left out")
    return found, missing


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


def goals(relaying: dict[str, dict[str, float]]) -> list[Goal]:
    """Ours over theirs, medians."""
    ours, found = relaying["eitskin"], []
    for transport, row in relaying.items():
        if transport != "eitskin":
            figure = f"four hops of checked frames, of {transport}'s opaque bytes"
            found.append(Goal(figure, ours["p50_ms"] / row["p50_ms"]))
        found.append(Goal(f"four hops of {transport}, p50, ms", row["p50_ms"]))
    return [*found, Goal("share of our frames lost in the relay", ours["lost"] / ours["sent"], at_most=0.0)]


def table(title: str, rows: dict[str, dict[str, float]], reference: str) -> Table:
    made = titled(title, ("", "p50 ms", "p99 ms", "times ours", "lost"))
    for label, row in rows.items():
        ratio = f"{row['p50_ms'] / rows[reference]['p50_ms']:.2f}"
        made.add_row(label, f"{row['p50_ms']:.3f}", f"{row['p99_ms']:.3f}", ratio, str(row.get("lost", "")))
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench peers", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--frames", type=whole(), default=100, help="of each transport in a round")
    parser.add_argument("--rounds", type=whole(), default=3)
    parser.add_argument("--quick", action="store_true", help="30 frames, two rounds")
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    frames, rounds = (30, 2) if args.quick else (args.frames, args.rounds)
    console = Console(width=110)
    relaying, missing = relayed(frames, rounds)
    of = " + ".join(f"{n / 1024:.1f}" for n in sizes())
    console.print(table(f"four hops between processes, {of} kB, 22 frames/s", relaying, "eitskin"))
    for line in missing:
        print(line)
    wanted = goals(relaying)
    console.print(_goals.table(wanted))
    found = {"relay": relaying, "left_out": missing}
    write_report(args.out / "peers.json", argv, wanted, found, picture=False)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
