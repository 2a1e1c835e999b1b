"""The ROS 1 example against Debian's rospy and a real roscore."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol.control import ControlClient
from tests import needs

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
SYSTEM_PYTHON = "/usr/bin/python3"
LISTENER = """
import rospy
from geometry_msgs.msg import WrenchStamped
rospy.init_node("listener", disable_signals=True)
def heard(m):
    print(m.header.frame_id, m.header.stamp.to_sec(), rospy.get_time(), m.wrench.force.z, m.wrench.torque.y, flush=True)
rospy.Subscriber("/eitskin/palm/wrench", WrenchStamped, heard, tcp_nodelay=True)
rospy.spin()
"""


def test_a_node_of_ros_1_hears_the_wrench(shared_service: Path, tmp_path: Path) -> None:
    needs.ROS_1.here()
    if subprocess.run([SYSTEM_PYTHON, "-c", "import rospy, geometry_msgs.msg"], capture_output=True).returncode:
        needs.ROS_1.lack("rospy or geometry_msgs")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(tmp_path),
        "ROS_LOG_DIR": str(tmp_path),
    }
    log = open(tmp_path / "log.txt", "wb")
    commands = (
        ["roscore", "-p", str(port)],
        [sys.executable, "-m", "examples.ros1_bridge", "--skin", "palm"],
        [SYSTEM_PYTHON, "-c", LISTENER],
    )
    started: list[subprocess.Popen[bytes]] = []
    try:
        for command in commands:
            out = subprocess.PIPE if command[0] == SYSTEM_PYTHON else log
            started.append(subprocess.Popen(command, cwd=ROOT, env=environment, stdout=out, stderr=log))
            end = time.monotonic() + 60
            while command[0] == "roscore":
                with socket.socket() as probe:
                    if probe.connect_ex(("127.0.0.1", port)) == 0:
                        break
                assert time.monotonic() < end and started[0].poll() is None, (tmp_path / "log.txt").read_text()
                time.sleep(0.1)
        ControlClient("stub", 5.0).call("press", x=0.02, y=-0.01, force=3.0, seconds=60.0)
        end, listener = time.monotonic() + 60, started[-1]
        assert listener.stdout is not None
        while True:
            assert time.monotonic() < end, (tmp_path / "log.txt").read_text()
            frame_id, stamp, now, fz, ty = listener.stdout.readline().decode().split()
            if abs(-float(fz) - 3.0) < 0.6:
                break
        assert frame_id == "palm" and 0 < float(now) - float(stamp) < 2.0
        assert abs(float(ty) / -float(fz) - 0.02) < 0.003
    finally:
        for process in started[::-1]:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
        log.close()
