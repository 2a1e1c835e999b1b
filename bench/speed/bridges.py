"""Bridges: what each adds to a contact's way, what it loses, what it costs, and whether the pipeline notices.

    skin bench bridges [--seconds 20] [--rounds 4]

Real processes and the stub, a touch that slides, and on the other side of each bridge a process that listens. Rounds
without any bridge and with all of them alternate in one run, so that the machine's load is the same for both. Prints a
table and writes bridges.json.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from bench import REPORTS, ROOT
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.service import BEGIN, SQUARE, Outside, Service, end_on_sigterm, running_square
from models.command import real, whole
from protocol.sockets import ControlClient, ControlError
from services.bridge import NEEDS

LISTENED = ("ros2", "foxglove")  # those that bench/speed/bridge_listener.py can listen to
PAST_FRONT = "foxglove, past its front"  # listens at the SDK's own server: the difference is what the front adds
FRONT = "foxglove: what its front adds"
LISTENS = "0A"  # state of a listening socket in /proc/net/tcp
SETTLE_S = 3.0
NEAR_NS = 5_000_000  # two times of one scan, by two readings of the clocks
P99_MS, RATIO, GATE = 3.0, 1.1, 1.5


@dataclass
class HandedOn:
    """What came out of one bridge, all rounds together."""

    added_ms: list[float] = field(default_factory=list)
    sent: int = 0
    lost: int = 0
    cpu_s: float = 0.0
    seconds: float = 0.0


@dataclass
class SeenContact:
    """A contact frame as a plain controller saw it."""

    sample: int
    published: int
    since_read_ms: float
    valid: bool


class Listened:
    """One bridge and who listens to it, as processes."""

    def __init__(self, name: str, folder: Path, domain: int) -> None:
        self.name = name
        config = folder / f"{name}.toml"
        config.write_text(f'{SQUARE}[ros2]\ninterface = "lo"\ndomain = {domain}\n[foxglove]\nport = 0\n')
        environment = {**os.environ, "EITSKIN_CONFIG": str(config), "CYCLONEDDS_URI": ""}
        log = folder / f"{name}.txt"
        with log.open("wb") as out:
            command = [sys.executable, "-m", "services.bridge", name]
            self.bridge = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=out, stderr=out)
        self.listeners: dict[str, subprocess.Popen[str]] = {}
        where = {name: str(domain)}
        if name == "foxglove":
            where = {name: _said(r"open (ws://\S+)", log, self.bridge), PAST_FRONT: _inside(self.bridge.pid)}
        for heard, place in where.items():
            command = [sys.executable, "-m", "bench.speed.bridge_listener", name, place]
            self.listeners[heard] = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
            )

    def wait(self) -> None:
        """Until frames flow through it. Raises RuntimeError."""
        end = time.monotonic() + 30
        while time.monotonic() < end:
            try:
                status = ControlClient(self.name, 1.0).call("status", skin="palm")
                if not status["idle"] and status["flowing"]:
                    return
            except ControlError:
                pass
            time.sleep(0.1)
        raise RuntimeError(f"nothing flows through the bridge {self.name}")

    def cpu_s(self) -> float:
        threads = Path(f"/proc/{self.bridge.pid}/task").iterdir()
        return sum(int((t / "schedstat").read_text().split()[0]) for t in threads) * 1e-9

    def close(self) -> dict[str, list[tuple[int, int]]]:
        """End all; by who listened, (measured by the message's own time [Unix ns], came [monotonic ns]) of each
        message.
        """
        found = {}
        for heard, listener in self.listeners.items():
            listener.terminate()
            whole = [line.split() for line in listener.communicate(timeout=10)[0].splitlines()]
            found[heard] = [(int(parts[0]), int(parts[1])) for parts in whole if len(parts) == 2]
        self.bridge.send_signal(signal.SIGTERM)
        self.bridge.wait(10)
        return found

    def kill(self) -> None:
        processes: list[subprocess.Popen[Any]] = [*self.listeners.values(), self.bridge]
        for process in processes:
            if process.poll() is None:
                process.kill()
                process.wait()


def _said(pattern: str, log: Path, process: subprocess.Popen[bytes]) -> str:
    end = time.monotonic() + 30
    while not (found := re.search(pattern, log.read_text())):
        if time.monotonic() > end or process.poll() is not None:
            raise RuntimeError(f"the bridge did not start: {log.read_text()}")
        time.sleep(0.05)
    return found[1]


def _inside(pid: int) -> str:
    """Where the SDK's server listens, behind the bridge's front: another address of the loopback than 127.0.0.1."""
    for line in Path(f"/proc/{pid}/net/tcp").read_text().splitlines()[1:]:
        fields = line.split()
        address, _, port = fields[1].partition(":")
        host = ".".join(str(byte) for byte in reversed(bytes.fromhex(address)))
        hidden = fields[3] == LISTENS and host.startswith("127.") and host != "127.0.0.1"
        if hidden and _holds(pid, f"socket:[{fields[9]}]"):
            return f"ws://{host}:{int(port, 16)}"
    raise RuntimeError("the Foxglove bridge has no server behind its front")


def _holds(pid: int, opened: str) -> bool:
    """Whether a process has this file open."""
    for each in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):  # closed meanwhile
            if os.readlink(each) == opened:
                return True
    return False


def watch(contacts: Outside, seconds: float) -> list[SeenContact]:
    """Contact frames as they come."""
    found, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        if got := contacts.recv(0.2):
            stamps, at = got[0]["stamps"], got[1]
            since_ms = (at - stamps["read"]) * 1e-6
            found.append(SeenContact(stamps["sample"], stamps["publish"], since_ms, got[0]["valid"]))
    return found


def account(heard: HandedOn, seen: list[SeenContact], messages: list[tuple[int, int]]) -> None:
    """What the messages of a round say: the delay behind `publish`, and how many valid frames gave none."""
    ahead = time.time_ns() - time.monotonic_ns()
    times = np.array(sorted(ns - ahead for ns, _ in messages))
    arrival = {ns - ahead: at for ns, at in messages}
    for frame in (f for f in seen if f.valid):
        heard.sent += 1
        near = times[np.abs(times - frame.sample).argmin()] if len(times) else None
        if near is None or abs(int(near) - frame.sample) > NEAR_NS:
            heard.lost += 1
        else:
            heard.added_ms.append((arrival[int(near)] - frame.published) * 1e-6)


@contextmanager
def listened(names: list[str], folder: Path, domain: int) -> Iterator[list[Listened]]:
    with ExitStack() as stack:
        made = []
        for name in names:
            made.append(Listened(name, folder, domain))
            stack.callback(made[-1].kill)
        for each in made:
            each.wait()
        yield made


def run(seconds: float, rounds: int, names: list[str]) -> tuple[dict[str, list[float]], dict[str, HandedOn]]:
    """(since acquisition read a frame, ms: without and with all bridges; what each bridge did)"""
    since: dict[str, list[float]] = {"without": [], "with all": []}
    heard = {name: HandedOn() for name in names}
    with running_square("full") as service:
        BEGIN["moving"](service)
        contacts = Outside("contact", "palm", service.folder)
        time.sleep(SETTLE_S)
        for number in range(rounds):
            contacts.recv(0.2)
            since["without"] += [seen.since_read_ms for seen in watch(contacts, seconds / rounds)]
            _with_all(service, contacts, seconds / rounds, number, since, heard)
        contacts.close()
    return since, heard


def _with_all(
    service: Service,
    contacts: Outside,
    seconds: float,
    number: int,
    since: dict[str, list[float]],
    heard: dict[str, HandedOn],
) -> None:
    names = [name for name in heard if name in LISTENED]
    with listened(names, service.folder, 130 + (os.getpid() + number) % 90) as bridges:
        watch(contacts, SETTLE_S)  # whoever has just come finds the others
        before = {each.name: each.cpu_s() for each in bridges}
        seen = watch(contacts, seconds)
        for each in bridges:
            heard[each.name].cpu_s += each.cpu_s() - before[each.name]
            heard[each.name].seconds += seconds
        time.sleep(0.3)  # the last frame is on its way
        since["with all"] += [frame.since_read_ms for frame in seen]
        for each in bridges:
            said = each.close()
            account(heard[each.name], seen, said[each.name])
            if PAST_FRONT in said:
                before_ns, front = dict(said[PAST_FRONT]), heard.setdefault(FRONT, HandedOn())
                both = [(at, before_ns[ns]) for ns, at in said[each.name] if ns in before_ns]
                front.added_ms += [(at - before) * 1e-6 for at, before in both]
                front.sent += len(both)


def quantiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {"p50": float("nan"), "p99": float("nan")}
    return {"p50": float(np.quantile(values, 0.5)), "p99": float(np.quantile(values, 0.99))}


def goals(since: dict[str, list[float]], heard: dict[str, HandedOn]) -> list[Goal]:
    without, beside = quantiles(since["without"]), quantiles(since["with all"])
    found = [
        Goal("pipeline's p99 with all bridges, over without", beside["p99"] / without["p99"], at_most=RATIO, gate=None),
        Goal("pipeline's p50 with all bridges, over without", beside["p50"] / without["p50"], at_most=RATIO, gate=GATE),
    ]
    for name, each in ((name, each) for name, each in heard.items() if name in LISTENED):
        share = each.lost / each.sent if each.sent else None
        found += [
            Goal(f"{name}: added to a contact's way, p99 [ms]", quantiles(each.added_ms)["p99"], at_most=P99_MS),
            Goal(f"{name}: share of valid frames lost", share, at_most=0.0, gate=0.1),
        ]
    return found


def table(since: dict[str, list[float]], heard: dict[str, HandedOn]) -> Table:
    made = Table(title="bridges, a touch that slides", title_justify="left")
    for heading in ("", "frames", "p50 [ms]", "p99 [ms]", "lost", "cores"):
        made.add_column(heading, justify="left" if not heading else "right")
    for name, values in since.items():
        q = quantiles(values)
        made.add_row(f"pipeline {name}: read to recv", str(len(values)), f"{q['p50']:.2f}", f"{q['p99']:.2f}", "", "")
    for name, each in heard.items():
        q, cores = quantiles(each.added_ms), f"{each.cpu_s / each.seconds:.3f}" if each.seconds else ""
        figures = (str(each.sent), f"{q['p50']:.2f}", f"{q['p99']:.2f}", str(each.lost), cores)
        made.add_row(f"{name}: publish to its listener" if name in LISTENED else name, *figures)
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench bridges", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=real(), default=40.0, help="of each condition, all rounds together")
    parser.add_argument("--rounds", type=whole(), default=4)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    names = [name for name in LISTENED if importlib.util.find_spec(NEEDS[name]) is not None]
    left_out = [f"Left out: {name}, whose package is not installed." for name in LISTENED if name not in names]
    since, heard = run(args.seconds, args.rounds, names)
    Console(width=150).print(table(since, heard))
    wanted = goals(since, heard)
    Console(width=150).print(_goals.table(wanted))
    for line in left_out:
        print(line)
    rows: dict[str, Any] = {f"pipeline {name}": quantiles(values) for name, values in since.items()}
    for name, each in heard.items():
        rows[name] = {**quantiles(each.added_ms), "frames": each.sent, "lost": each.lost, "cpu_s": each.cpu_s}
    report = {**provenance("bridges", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    write_json(args.out / "bridges.json", {**report, "left_out": left_out})
    print(f"wrote {args.out / 'bridges.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
