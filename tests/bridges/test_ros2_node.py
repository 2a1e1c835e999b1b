"""The bridge to ROS 2 beside the whole service, heard by a genuine ROS 2 node: rclpy, Fast DDS (ros_node.py).

`make ros-venv` makes the virtual environment that node needs.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bridges.ros2.definitions import type_hash
from protocol.control import ControlClient
from protocol.frames import ContactFrame, ImageFrame
from protocol.sockets import AllReader
from tests import needs

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
BASE = "/eitskin/palm"
CONFIG = """
bridges = ["ros2"]
[skins.palm]
port = "stub"
bundle = "square16"
scan = "{scan}"
frame_id = "palm"
[ros2]
interface = "lo"
domain = {domain}
commands = true
"""
TYPES = {
    "/wrench": "geometry_msgs/WrenchStamped",
    "/contacts/slot0": "geometry_msgs/WrenchStamped",
    "/contacts": "visualization_msgs/MarkerArray",
    "/contacts/poses": "geometry_msgs/PoseArray",
    "/pressure": "sensor_msgs/PointCloud2",
    "/image": "sensor_msgs/Image",
    "/valid": "std_msgs/Bool",
}
SCAN_S = 0.0436  # a whole scan of 120 measurements
NEAR_S = 0.002  # stamps of one frame, by two clocks
RATE_HZ = 100  # of the bridge, unless set otherwise
EVERY_S = 0.25  # far more than from one scan to the next: two messages of one stamp are one frame's


class World:
    """The service with its bridge, the ROS node, and a client of ours that keeps every contact frame."""

    def __init__(self, folder: Path, domain: int, scan: str) -> None:
        self.folder = folder
        config = folder / "skin.toml"
        config.write_text(CONFIG.format(domain=domain, scan=scan))
        told = {
            "EITSKIN_CONFIG": str(config),
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        environment = {**os.environ, **told}
        self._log = open(folder / "log.txt", "wb")
        needs.ROS_2.here()
        self._up = subprocess.Popen(
            [sys.executable, str(ROOT / "skin"), "up"], cwd=ROOT, env=environment, stdout=self._log, stderr=self._log
        )
        self._node = subprocess.Popen(
            [str(needs.ROS_PYTHON), str(ROOT / "tests/bridges/ros_node.py"), BASE],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )
        self.heard: list[dict[str, Any]] = []
        self.frames: list[ContactFrame] = []
        self.imaged: list[int] = []  # for when
        self._reader = AllReader(["contact", "image"], "palm")
        self._closing = False
        self._threads = [threading.Thread(target=self._listen), threading.Thread(target=self._keep)]
        for thread in self._threads:
            thread.start()

    def _listen(self) -> None:
        assert self._node.stdout is not None
        for line in self._node.stdout:
            self.heard.append(json.loads(line))

    def _keep(self) -> None:
        while not self._closing:
            frame = self._reader.recv(0.1)
            if isinstance(frame, ContactFrame):
                self.frames.append(frame)
            elif isinstance(frame, ImageFrame):
                self.imaged.append(frame.stamps["sample"])
        self._reader.close()

    def of(self, topic: str, since: float = 0.0) -> list[dict[str, Any]]:
        name = topic if topic in ("/diagnostics", "hashes", "tare", "service") else BASE + topic
        return [message for message in list(self.heard) if message["topic"] == name and message["at"] >= since]

    def until(
        self, what: str, topic: str, since: float, fits: Any = lambda message: True, seconds: float = 60.0
    ) -> Any:
        """The first message of a topic that fits."""
        end = time.monotonic() + seconds
        while not (found := [message for message in self.of(topic, since) if fits(message["value"])]):
            assert time.monotonic() < end, f"never: {what}\n{(self.folder / 'log.txt').read_text()[-2000:]}"
            time.sleep(0.05)
        return found[0]

    def order(self, text: str) -> None:
        assert self._node.stdin is not None
        self._node.stdin.write(text.encode() + b"\n")
        self._node.stdin.flush()

    def close(self) -> None:
        self._closing = True
        assert self._node.stdin is not None
        self._node.stdin.close()
        try:
            self._node.wait(20)
        except subprocess.TimeoutExpired:
            self._node.kill()
        self._up.send_signal(signal.SIGTERM)
        self._up.wait(20)
        for thread in self._threads:
            thread.join(10)
        self._log.close()


@pytest.fixture
def world(runtime: Path, request: pytest.FixtureRequest) -> Iterator[World]:
    made = World(runtime, 20 + os.getpid() % 80, request.param)
    try:
        yield made
    finally:
        made.close()


def away_s(at: float, stamps: np.ndarray) -> float:
    """From the nearest of these."""
    return float(np.abs(stamps - at).min())


def is_true(w: list[float]) -> bool:
    """Whether a wrench is that of 3 N at (0.02, -0.01): by its force, and by its moments. A touch is measured roughly
    while it comes.
    """
    fz, tx, ty = w[2:5]
    return abs(fz + 3.0) < 0.6 and abs(ty / -fz - 0.02) < 0.003 and abs(tx / fz + 0.01) < 0.003


def stub(command: str, **args: Any) -> dict[str, Any]:
    return ControlClient("stub", 5.0).call(command, skin="palm", **args)


@pytest.mark.parametrize(
    ("world", "seconds"),
    [
        pytest.param("rolling", 3.0, id="parts"),
        pytest.param("rolling", 60.0, id="parts-minute", marks=pytest.mark.release),
        pytest.param("full", 3.0, id="whole", marks=pytest.mark.release),
    ],
    indirect=["world"],
)
def test_a_ros_node_hears_what_the_service_says_and_nothing_while_it_is_not_valid(world: World, seconds: float) -> None:
    world.until("a wrench", "/wrench", 0.0, seconds=120.0)
    for topic in TYPES:
        world.until(f"a message on {topic}", topic, 0.0)

    # types: as ROS 2's own type support knows them
    hashes = world.until("hashes", "hashes", 0.0, lambda found: all(found.values()))["value"]
    assert {topic: hashes[BASE + topic] for topic in TYPES} == {
        topic: [type_hash(message)] for topic, message in TYPES.items()
    }
    assert hashes["/diagnostics"] == [type_hash("diagnostic_msgs/DiagnosticArray")]

    # a press, against the truth
    began = time.time()
    stub("press", x=0.02, y=-0.01, force=3.0, radius=0.01, shape="circle", seconds=seconds)
    pressed = world.until("3 N at the right place", "/wrench", began, is_true)
    assert pressed["frame"] == "palm" and 0 < pressed["at"] - pressed["stamp"] < 1.0
    world.until("the same in the strongest slot", "/contacts/slot0", began, is_true)
    assert not [m for m in world.of("/contacts/slot1", began) if m["value"][2] < -0.5]  # one contact alone
    world.until("its pose", "/contacts/poses", began, lambda p: bool(p) and math.dist(p[0][:2], (0.02, -0.01)) < 0.003)
    marks = world.until("markers", "/contacts", began, lambda found: any("N" in m[4] for m in found))["value"]
    assert {mark[0] for mark in marks} == {"patch", "force", "label"}
    # an image of a scan in which the touch came is rough, and comes after the wrench: one of a scan after that
    later = pressed["at"] + 3 * SCAN_S
    cloud = world.until("a cloud with the touch", "/pressure", later, lambda c: c["peak"][3] > 0)["value"]
    assert abs(cloud["peak"][0] - 0.02) < 0.01 and abs(cloud["peak"][1] + 0.01) < 0.01
    picture = world.until("an image with the touch", "/image", later, lambda i: i["most"] > 0)["value"]
    rows, columns = picture["size"]
    assert picture["encoding"] == "32FC1" and picture["peak"][0] > rows / 2 and picture["peak"][1] > columns / 2
    time.sleep(seconds)
    world.until("released", "/wrench", time.time(), lambda w: w[2] == 0.0)

    # a fault: nothing of what is not valid is published, and diagnostics say why
    faulty = time.time()
    stub("faults", name="frozen", args={}, clear=False, seconds=2.0)
    world.until("not valid", "/valid", faulty, lambda valid: valid is False)
    world.until("why", "/diagnostics", faulty, lambda found: any("not published" in d["message"] for d in found))
    world.until("valid again", "/valid", faulty + 2.0, lambda valid: valid is True)
    hung = time.time()
    stub("faults", name="hang", args={}, clear=False, seconds=2.0)
    world.until("silent", "/valid", hung, lambda valid: valid is False)
    world.until("valid after the silence", "/valid", hung + 2.0, lambda valid: valid is True)

    # tare by service
    stub("release")
    for _ in range(20):  # at first the answer is that too few untouched frames have come since
        asked = time.time()
        world.order("tare")
        done, said = world.until("an answer", "tare", asked)["value"]
        if done:
            break
        assert re.match("only [0-9]+ of 64 (untouched )?frames", said), said
        time.sleep(1.0)
    assert said == "new baseline from 64 frames" and world.of("service")[-1]["value"] is True
    world.until("valid after the tare", "/valid", time.time(), lambda valid: valid is True)

    # each valid frame became one wrench, and no other frame did
    time.sleep(0.5)
    offset = time.time() - time.monotonic()
    wrenches = world.of("/wrench")
    first, last = wrenches[0]["stamp"], wrenches[-1]["stamp"]
    sampled = {f.stamps["sample"]: f for f in world.frames if "sample" in f.stamps}
    within = [
        (at, f) for f in sampled.values() if first - NEAR_S < (at := f.stamps["sample"] * 1e-9 + offset) < last + NEAR_S
    ]
    valid_at = [at for at, frame in within if frame.valid]
    refused = [at for at, frame in within if not frame.valid]
    assert refused, "the fault made no frame invalid"
    published = np.array([message["stamp"] for message in wrenches])
    assert not [at for at in refused if away_s(at, published) < NEAR_S]
    # parts come faster than the bridge hands on
    missing = [at for at in valid_at if away_s(at, published) > NEAR_S + 1 / RATE_HZ]
    drops = ControlClient("ros2", 5.0).call("status", skin="palm")["drops"]
    counted = drops["skipped"] + drops["late"]  # a busy machine: the newest frame overtakes older ones, and is counted
    lost = len(missing) - counted
    assert lost <= 0.02 * len(valid_at), f"{lost} of {len(valid_at)} valid frames are lost, {counted} were counted"

    # clouds are best effort, 184 kB each: in Cyclone's usual 14 datagrams half of them did not arrive whole
    clouds = np.sort([message["stamp"] for message in world.of("/pressure")])
    imaged = [at for sample in world.imaged if clouds[0] < (at := sample * 1e-9 + offset) < clouds[-1]]
    stamps = np.array(valid_at)
    valid = [at for at in imaged if away_s(at, stamps) < NEAR_S]
    assert len(clouds) + counted >= 0.85 * len(valid), f"{len(clouds)} clouds of {len(valid)} images came whole"
