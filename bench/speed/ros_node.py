"""A genuine ROS 2 node beside the service for minutes: is any wrench lost, and how late does the bridge make it?

    skin bench ros_node [--minutes 10]

Real processes and the stub, which is pressed now and then; the bridge to ROS 2; and an rclpy node of Fast DDS
(tests/bridges/ros_node.py, in the virtual environment that `make ros-venv` makes). Every valid contact frame must give
one wrench and one array of poses, every one with contacts their markers, and every valid image one cloud. They are told
apart by their stamps: when the skin was measured. A frame that newer ones overtook in the bridge, or that was too old
when it came, is not handed on by design: the bridge counts it, and so does the table. A cloud is best effort.

Two delays: the bridge's own, from taking a frame to having handed on all of its messages, by the bridge's own status
each second; and from the publisher's `publish` stamp to the callback of the rclpy node, which is Python too.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench import REPORTS, ROOT
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.bridges import NEAR_NS, P99_MS, SETTLE_S, quantiles
from bench.speed.service import SQUARE, Service, end_on_sigterm, running_square
from bridges import views
from models.command import real
from protocol.control import ControlClient, ControlError
from protocol.errors import EitskinError
from protocol.frames import ContactFrame, ImageFrame, StatusFrame
from protocol.sockets import AllReader

BASE = "/eitskin/palm"
OF_CONTACTS = {"wrench": "contact", "contacts/poses": "contact", "contacts": "touched"}
OF_IMAGES = {"pressure": "image"}
"""Topic of ROS -> which of our frames give one of its messages."""
EVERY_S, HELD_S = 8.0, 3.0  # a press, and how long it is held
Row = dict[str, float]


class RosMissing(EitskinError, RuntimeError):
    """There is no ROS 2 to listen with. The text says what to do."""


def ros_python() -> Path:
    """The Python that has rclpy."""
    found = Path(os.environ.get("EITSKIN_ROS_PYTHON") or ROOT / ".venv-ros" / "bin" / "python")
    if not found.exists():
        raise RosMissing(f"no {found}: `make ros-venv` makes it (270 MB), or set EITSKIN_ROS_PYTHON")
    return found


class RosListener:
    """The rclpy node: what it heard of each topic, as (measured, came), both by the monotonic clock [ns]."""

    def __init__(self, environment: dict[str, str], log: Path) -> None:
        self.heard: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
        with log.open("wb") as out:
            self.process = subprocess.Popen(
                [str(ros_python()), str(ROOT / "tests/bridges/ros_node.py"), BASE, *OF_CONTACTS, *OF_IMAGES],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=out,
            )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            said = json.loads(line)
            if said.get("stamp") is not None:
                ahead = round(said["at"] * 1e9) - said["monotonic_ns"]
                measured = round(said["stamp"] * 1e9) - ahead
                self.heard[said["topic"].removeprefix(f"{BASE}/")].append((measured, said["monotonic_ns"]))

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._thread.join(5)


@contextmanager
def bridged(folder: Path, domain: int) -> Iterator[RosListener]:
    """The bridge and the node that listens to it. Raises RosMissing, RuntimeError where nothing flows."""
    config = folder / "ros2.toml"
    config.write_text(f'{SQUARE}[ros2]\ninterface = "lo"\ndomain = {domain}\n')
    told = {"EITSKIN_CONFIG": str(config), "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    environment = {**os.environ, **told, "CYCLONEDDS_URI": ""}
    listener = RosListener(environment, folder / "node.txt")
    with (folder / "bridge.txt").open("wb") as out:
        bridge = subprocess.Popen(
            [sys.executable, "-m", "services.bridge", "ros2"], cwd=ROOT, env=environment, stdout=out, stderr=out
        )
    try:
        end = time.monotonic() + 60
        while not all(listener.heard[name] for name in ("wrench", *OF_IMAGES)):
            if time.monotonic() > end or bridge.poll() is not None:
                said = "".join((folder / name).read_text()[-1000:] for name in ("bridge.txt", "node.txt"))
                raise RuntimeError(f"the ROS node hears nothing: {said}")
            time.sleep(0.1)
        yield listener
    finally:
        listener.close()
        bridge.send_signal(signal.SIGTERM)
        try:
            bridge.wait(10)
        except subprocess.TimeoutExpired:
            bridge.kill()


class SentFrames:
    """What the service published meanwhile, all of it: valid frames as (measured, published) [ns], by topic; and what
    the bridge said of itself.
    """

    def __init__(self) -> None:
        self.valid: dict[str, list[tuple[int, int]]] = {"contact": [], "touched": [], "image": []}
        self.not_valid = 0
        self.own: list[dict[str, float]] = []
        self._reader = AllReader(["contact", "image", "status"], "palm")

    def take(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            frame = self._reader.recv(min(left, 0.1))
            if isinstance(frame, StatusFrame) and frame.process == "ros2":
                self.own.append(dict(frame.latency))
            elif isinstance(frame, (ContactFrame, ImageFrame)):
                self._sort(frame)

    def _sort(self, frame: ContactFrame | ImageFrame) -> None:
        contact = isinstance(frame, ContactFrame)
        if not frame.valid:
            self.not_valid += contact
            return
        at = frame.stamps["sample"], frame.stamps.get("publish", 0)
        self.valid["contact" if contact else "image"].append(at)
        if isinstance(frame, ContactFrame) and views.present(frame):
            self.valid["touched"].append(at)

    @property
    def gaps(self) -> int:
        """Frames that this program itself did not get."""
        return self._reader.gaps

    def close(self) -> None:
        self._reader.close()


def matched(sent: list[tuple[int, int]], heard: list[tuple[int, int]]) -> list[float]:
    """From `publish` to the callback [ms], of each frame whose message came. Each message counts once."""
    messages = sorted(heard)
    times: NDArray[np.int64] = np.array([measured for measured, _ in messages] or [0], np.int64)
    delays, took = list[float](), set[int]()
    for measured, published in sent:
        at = int(np.abs(times - measured).argmin())
        if messages and abs(int(times[at]) - measured) <= NEAR_NS and at not in took:
            took.add(at)
            delays.append((messages[at][1] - published) * 1e-6)
    return delays


def press_now_and_then(service: Service, sent: SentFrames, minutes: float) -> int:
    """Presses the stub every EVERY_S seconds at random places, 1 to 5 N; how many presses those were."""
    rng, end, presses = np.random.default_rng(16), time.monotonic() + 60 * minutes, 0
    while (left := end - time.monotonic()) > 0:
        x, y = rng.uniform(-0.03, 0.03, 2)
        force, radius = rng.uniform(1, 5), rng.uniform(0.006, 0.014)
        service.stub("press", x=float(x), y=float(y), force=float(force), radius=float(radius), seconds=HELD_S)
        presses += 1
        sent.take(min(EVERY_S, left))
    return presses


def drops() -> dict[str, int]:
    """What the bridge counted as overtaken or too late."""
    end = time.monotonic() + 10
    while True:
        try:
            return dict(ControlClient("ros2", 5.0).call("status", skin="palm")["drops"])
        except ControlError:
            if time.monotonic() > end:
                raise
            time.sleep(0.2)


def run(minutes: float, domain: int) -> dict[str, Row]:
    with running_square("full") as service, bridged(service.folder, domain) as listener:
        sent = SentFrames()
        sent.take(SETTLE_S)
        before = drops()
        sent.valid = {name: [] for name in sent.valid}
        sent.own.clear()
        presses = press_now_and_then(service, sent, minutes)
        time.sleep(0.5)  # the last frame is on its way
        counted = {cause: n - before.get(cause, 0) for cause, n in drops().items()}
        sent.close()
    rows: dict[str, Row] = {}
    for name, frames in (OF_CONTACTS | OF_IMAGES).items():
        delays = matched(sent.valid[frames], listener.heard[name])
        rows[name] = {"sent": len(sent.valid[frames]), "received": len(delays)}
        if name not in OF_IMAGES:  # an image has not passed the publisher
            rows[name] |= {f"callback {q}": ms for q, ms in quantiles(delays).items()}
    keys = sorted({key for each in sent.own for key in each})
    rows["bridge"] = {key: float(np.median([each[key] for each in sent.own if key in each])) for key in keys}
    rows["bridge"] |= {f"largest {key}": max(each[key] for each in sent.own if key in each) for key in keys}
    rows["counts"] = {"presses": presses, "not valid": sent.not_valid, "not seen by us": sent.gaps, **counted}
    return rows


def goals(rows: dict[str, Row]) -> list[Goal]:
    overtaken = rows["counts"].get("skipped", 0) + rows["counts"].get("late", 0)
    found = []
    for name in OF_CONTACTS:
        lost = max(0.0, rows[name]["sent"] - rows[name]["received"] - overtaken)
        found.append(Goal(f"{name}: lost, beside what the bridge counted as overtaken", lost, at_most=0, gate=0))
    found.append(Goal("frames overtaken in the bridge, or too late, all counted", overtaken, at_most=0))
    clouds = rows["pressure"]
    lost = (clouds["sent"] - clouds["received"]) / max(clouds["sent"], 1)
    found.append(Goal("pressure (best effort): share lost", lost, at_most=0.01, gate=0.2))
    own = rows["bridge"].get("work_p99")
    found.append(Goal("bridge: from taking a frame to having handed it on, p99 [ms]", own, at_most=P99_MS))
    found.append(Goal("publish to the rclpy callback, p99 [ms]", rows["wrench"]["callback p99"], at_most=P99_MS))
    return found


def table(rows: dict[str, Row]) -> Table:
    made = Table(title="a ROS 2 node (rclpy) beside the service", title_justify="left")
    for heading in ("topic", "valid frames", "received", "p50 [ms]", "p99 [ms]"):
        made.add_column(heading, justify="left" if heading == "topic" else "right")
    for name in (*OF_CONTACTS, *OF_IMAGES):
        row = rows[name]
        delay = [f"{row[f'callback {q}']:.2f}" if f"callback {q}" in row else "" for q in ("p50", "p99")]
        made.add_row(f"{BASE}/{name}", f"{row['sent']:.0f}", f"{row['received']:.0f}", *delay)
    return made


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench ros_node", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=real(), default=10.0)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    try:
        rows = run(args.minutes, 20 + os.getpid() % 80)
    except RosMissing as why:
        print(why, file=sys.stderr)
        return 2
    Console(width=150).print(table(rows))
    for name in ("bridge", "counts"):
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in rows[name].items()))
    wanted = goals(rows)
    Console(width=150).print(_goals.table(wanted))
    targets = [goal.to_dict() for goal in wanted]
    write_json(args.out / "ros_node.json", {**provenance("ros_node", argv), "targets": targets, "rows": rows})
    return 0 if all(goal.passed for goal in wanted) else 1


if __name__ == "__main__":
    raise SystemExit(main())
