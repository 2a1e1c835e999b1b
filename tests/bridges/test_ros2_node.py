"""The bridge to ROS 2 beside the whole service, heard by a genuine ROS 2 node (ros_node.py, by `make ros-venv`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bridges.ros2.definitions import type_hash
from protocol.control import ControlClient
from tests import needs
from tests.waiting import WAIT_S, end, until

CONFIG = """bridges = ["ros2"]
ros2 = {{ interface = "lo", domain = {}, commands = true }}
skins.palm = {{ port = "stub", bundle = "square16", frame_id = "palm" }}"""
TYPES = {"/eitskin/palm/wrench": "geometry_msgs/WrenchStamped", "/eitskin/palm/valid": "std_msgs/Bool"}


@pytest.mark.live
@pytest.mark.release
def test_a_ros_node_hears_what_the_service_says_and_that_it_is_not_valid(runtime: Path, domain: int) -> None:
    needs.ROS_2.here()
    config = runtime / "skin.toml"
    config.write_text(CONFIG.format(domain))
    told = {"EITSKIN_CONFIG": str(config), "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    options: dict[str, Any] = {"env": {**os.environ, **told}, "stdin": subprocess.PIPE, "text": True}
    command = [str(needs.ROS_PYTHON), str(Path(__file__).with_name("ros_node.py"))]
    up = subprocess.Popen([sys.executable, str(needs.ROOT / "skin"), "up"], **options, stdout=subprocess.DEVNULL)
    node = subprocess.Popen(command, **options, stdout=subprocess.PIPE)
    heard: list[dict[str, Any]] = []
    threading.Thread(target=lambda: heard.extend(map(json.loads, node.stdout)), daemon=True).start()

    def first(topic: str, since: float, fits: Callable[[Any], bool]) -> Any:
        def new() -> list[Any]:
            return [m for m in list(heard) if m["topic"].endswith(topic) and m["at"] >= since and fits(m["value"])]

        return until(new, up, node)[0]["value"]

    stub = ControlClient("stub", WAIT_S)
    try:
        assert first("hashes", 0, lambda found: all(found.values())) == {t: [type_hash(m)] for t, m in TYPES.items()}
        began = time.time()
        stub.call("press", x=0.02, y=-0.01, force=3.0, radius=0.01, shape="circle", seconds=600.0)
        first("wrench", began, lambda w: w == pytest.approx([-3.0, 0.03, 0.06], rel=0.2))
        stub.call("release")
        began = time.time()
        stub.call("faults", name="frozen", args={}, clear=False, seconds=2.0)
        first("valid", began, lambda valid: valid is False)
        done = False
        while not done:  # at first the answer is that too few untouched frames have come since
            began = time.time()
            print("tare", file=node.stdin, flush=True)
            done, said = first("tare", began, lambda answer: True)
            assert said.startswith("new baseline from 64 frames" if done else "only "), said
        first("valid", began, lambda valid: valid is True)
    finally:
        for process in (node, up):
            end(process)
