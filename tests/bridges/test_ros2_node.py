"""The node of eitskin_ros as `make ros-venv` builds it, heard by another ROS node, which knows its messages alone."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bridges.export.entries import Entry
from bridges.export.to_ros2 import write_ros2
from protocol.control import ControlClient
from protocol.sockets import AllReader
from tests import needs
from tests.bridges.conftest import FakeService
from tests.waiting import WAIT_S, end, until

pytestmark = [pytest.mark.live, pytest.mark.release]
STARTED = [*map(str, (needs.ROS_PYTHON, needs.ROS_NODE)), "--ros-args"]
NODE = [*STARTED, "-r", "__node:=palm", "-r", "__ns:=/left"]
OTHER_NODE = [*STARTED, "-r", "__node:=sole", "-r", "__ns:=/right", "-p", "skin:=sole"]
ADMITTANCE = [str(needs.ROS_PYTHON), str(needs.ROS_NODE.with_name("admittance")), "--ros-args"]


class Heard:
    """The node of the skin palm, and the stranger's."""

    def __init__(self, domain: int) -> None:
        needs.ROS_2.here()
        told = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.options: dict[str, Any] = {"env": {**os.environ, **told}, "text": True}
        given = [*NODE, "-p", "reference_topic:=/ft/wrench"]
        self.node = subprocess.Popen(given, **self.options)
        command = [str(needs.ROS_PYTHON), str(Path(__file__).with_name("ros_stranger.py"))]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.stranger = subprocess.Popen(command, **pipes, **self.options)
        self.all: list[dict[str, Any]] = []
        threading.Thread(target=lambda: self.all.extend(map(json.loads, self.stranger.stdout)), daemon=True).start()

    def of(self, topic: str) -> list[dict[str, Any]]:
        return [each for each in list(self.all) if each["topic"] in (topic, f"/left/palm/{topic}")]

    def until(self, topic: str, fits: Callable[[Any], Any] = lambda value: True, since: float = 0.0) -> Any:
        """The first value that fits, of those measured since then."""
        new = lambda: [m["value"] for m in self.of(topic) if m["stamp"] >= since and fits(m["value"])]  # noqa: E731
        return until(new, self.node, self.stranger)[0]

    def order(self, *words: object) -> None:
        print(*words, file=self.stranger.stdin, flush=True)


@pytest.fixture
def heard(runtime: Path, domain: int) -> Iterator[Heard]:
    both = Heard(domain)
    yield both
    for process in (both.stranger, both.node):
        end(process)
    assert both.node.returncode == 0, "ended by SIGTERM, as a launch file does"


def test_a_stranger_hears_all_of_a_skin_and_that_it_is_not_valid(heard: Heard, fake: FakeService) -> None:
    assert heard.until("contacts", lambda c: c[0]) == [True, [], [[1, 3.0, 0.02, 0.0]], "palm"]
    assert heard.until("wrench") == [-3.0, 0.06] and heard.until("markers") == [3, 0, 0, 0]
    assert heard.until("conductivity_drop") == pytest.approx(0.3)
    assert heard.until("image") == ["32FC1", pytest.approx(0.3)]
    assert heard.until("/tf_static") == [["wrist", "palm"]]
    heard.until("/diagnostics", lambda d: d.get("eitskin palm: contacts") == [0, "valid"])
    fake.valid = False
    heard.until("contacts", lambda c: c[:3] == [False, ["frozen"], []])
    fake.silent = True
    heard.until("contacts", lambda c: c[:3] == [False, ["silent"], []])
    assert heard.until("markers", lambda actions: len(actions) == 1) == [3]
    again, fake.valid, fake.silent = time.time(), True, False
    heard.until("wrench", since=again)
    offset = time.time() - time.monotonic()
    bad = [sample * 1e-9 + offset for _, sample, good in fake.sent if not good]
    assert not [m for m in heard.of("wrench") if min(abs(m["stamp"] - at) for at in bad) < 5e-3]


def test_tare_parameters_quality_of_service_and_the_robots_own_sensor(
    heard: Heard, fake: FakeService, tmp_path: Path
) -> None:
    heard.until("contacts", lambda c: c[0])
    heard.order("tare")
    assert heard.until("tare") == [True, "new baseline from 64 frames"] and fake.tares == ["palm"]
    heard.order("tell")
    (refused,), (texts, spans) = heard.until("set_parameters"), heard.until("describe_parameters")
    assert refused[0] is False and "use_sim_time is true, expected false" in refused[1]
    assert all(texts) and spans == [[], [1000.0]]
    offered = dict(m["value"] for m in heard.of("qos"))
    assert offered["/left/palm/contacts"] == [["BEST_EFFORT", 250_000_000]]
    assert offered["/left/palm/wrench"][0][0] == offered["/left/palm/image"][0][0] == "RELIABLE"
    reader = AllReader(["reference"], "palm")
    pressed = until(lambda: (heard.order("press", 2.5), reader.recv(0.1))[1])
    assert (pressed.force_n, pressed.valid) == (2.5, True)
    reader.close()
    tmp_path.chmod(0o755)
    for wrong, runtime, says in (
        ("use_sim_time:=true", "", "expected false"),
        ("reference_axis:=up", "", "one of x, y, z"),
        ("marker_rate:=0.0", "", "out of range"),
        ("skin:=palm", str(tmp_path), "has mode 0755, expected 0700"),
    ):
        given = [*NODE, "-p", wrong, *(() if runtime else ("-p", "reference_topic:=/ft"))]
        environment = heard.options["env"] | ({"EITSKIN_RUNTIME": runtime} if runtime else {})
        ran = subprocess.run(given, env=environment, text=True, capture_output=True, timeout=WAIT_S)
        assert ran.returncode == 1 and says in ran.stderr and "Traceback" not in ran.stderr, ran.stderr


def test_two_skins_in_two_namespaces(heard: Heard, fake: FakeService) -> None:
    other = subprocess.Popen(OTHER_NODE, **heard.options)
    try:
        assert heard.until("/right/sole/contacts", lambda c: c[0]) == [True, [], [], "sole"]
        assert heard.until("contacts", lambda c: c[0])[3] == "palm"
    finally:
        end(other)
    assert other.returncode == 0


def test_a_robot_that_gives_way_stands_still_once_a_bag_begins_anew(heard: Heard) -> None:
    given = [*ADMITTANCE, "-p", "use_sim_time:=true", "-r", "wrench:=/bag/wrench", "-r", "twist:=/bag/twist"]
    admittance = subprocess.Popen(given, **heard.options)
    speeds = lambda start: [m["value"] for m in heard.of("/bag/twist") if start <= m["stamp"] < start + 1]  # noqa: E731
    played = lambda start, force: (heard.order("bag", start, force), time.sleep(0.5), speeds(start))[2]  # noqa: E731
    try:
        pushed = until(lambda: played(100, 3), admittance)
        assert -0.075 <= min(pushed) < -0.01
        assert set(until(lambda: played(50, 0), admittance)) == {0.0}
    finally:
        end(admittance)


def test_an_exported_recording_is_played_to_a_stranger(heard: Heard, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    from tests.bridges.test_export import frames

    write_ros2((Entry(ns, frame) for ns, frame in frames()), tmp_path / "bag.mcap")
    with open(tmp_path / "bag.mcap", "rb") as file:
        played = [(s.name, m.data) for s, c, m in make_reader(file).iter_messages() if c.topic == "/palm/contacts"]
    heard.until("contacts", lambda c: c[:2] == [False, ["silent"]])
    heard.order("play", "/bag/contacts", played[3][0], base64.b64encode(played[3][1]).decode())
    assert heard.until("/bag/contacts") == [True, [], [[7, 3.0, 0.02, 0.01]], "wrist"]


def test_a_press_of_the_stub_is_heard_in_newtons_and_metres(heard: Heard, runtime: Path) -> None:
    config = runtime / "skin.toml"
    config.write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    command = [sys.executable, str(needs.ROOT / "skin"), "up", "--config", str(config)]
    up = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        heard.until("contacts", lambda c: c[0])
        press = {"x": 0.02, "y": -0.01, "force": 3.0, "radius": 0.01, "shape": "circle", "seconds": 600.0}
        ControlClient("stub", WAIT_S).call("press", **press)
        right = pytest.approx([3.0, 0.02, -0.01], abs=0.15), pytest.approx([0.02, -0.01], abs=5e-4)
        heard.until("contacts", lambda c: [touch[1:] for touch in c[2]] == [right[0]] and c[2][0][2:] == right[1])
    finally:
        end(up)
