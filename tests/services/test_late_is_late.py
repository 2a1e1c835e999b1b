"""Late is late, from the board to a controller's callback: real processes, the stub behind a socket, and one process
after the other stopped for a while, as a debugger, a swap or a suspend would.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

from protocol.client import Stale
from protocol.control import ControlClient
from protocol.frames import ContactFrame
from protocol.listener import ContactListener
from services.runtime.config import ROOT
from services.runtime.stage import PROCESSES
from tests.processes import pid_of

pytestmark = pytest.mark.live

STOPS_S = (0.45, 2.0)  # not much longer than a frame may be acted on, and much longer
TOLERANCE_S = 0.1  # between the client's judgement and its callback
PATIENCE_S = 90.0


class Controller:
    """Notes how old each frame is that it is to act on, at the moment when it is told of it."""

    def __init__(self) -> None:
        self.told: list[tuple[float, ContactFrame]] = []
        self.stale: list[Stale] = []

    def on_contact(self, frame: ContactFrame) -> None:
        self.told.append(((time.monotonic_ns() - frame.stamps["sample"]) * 1e-9, frame))

    def too_late(self) -> list[tuple[float, float]]:
        return [(age, f.valid_for_s) for age, f in self.told if not f.valid or age > f.valid_for_s + TOLERANCE_S]

    def until(self, enough: int) -> None:
        """Until it was told of so many frames more."""
        wanted, end = len(self.told) + enough, time.monotonic() + PATIENCE_S
        while len(self.told) < wanted:
            assert time.monotonic() < end, f"{len(self.told)} valid frames; {self.stale[-1:]}"
            time.sleep(0.01)


@pytest.fixture
def service(runtime: Path) -> Iterator[None]:
    """`skin up` with a stub that listens on TCP, where what a stopped reader does not take piles up."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = f"socket://127.0.0.1:{free.getsockname()[1]}"
    config = runtime / "skin.toml"
    config.write_text(f'[skins.palm]\nport = "{port}"\nbundle = "square16"\nframe_id = "palm"\n')
    environment = {**os.environ, "EITSKIN_CONFIG": str(config)}
    commands = (
        [sys.executable, "-m", "firmware_stub", "--listen", port],
        [sys.executable, str(ROOT / "skin"), "up", "--config", str(config)],
    )
    with open(runtime / "log.txt", "wb") as log:
        started = [subprocess.Popen(c, cwd=ROOT, env=environment, stdout=log, stderr=log) for c in commands]
        try:
            yield
        finally:
            for process in started[::-1]:
                process.send_signal(signal.SIGTERM)
                process.wait(20)


@pytest.mark.release
@pytest.mark.usefixtures("service")
def test_no_stopped_process_makes_a_controller_act_on_an_old_frame() -> None:
    robot = Controller()
    with ContactListener("palm", robot.on_contact, robot.stale.append):
        robot.until(30)
        for process, stopped_s in product(PROCESSES, STOPS_S):
            pid = pid_of(f"services.{process}")
            ControlClient("stub", 5.0).call("press", x=0.02, y=-0.01, force=3.0, seconds=60.0)
            robot.until(10)
            robot.stale.clear()
            os.kill(pid, signal.SIGSTOP)
            try:
                time.sleep(0.3 * stopped_s)
                ControlClient("stub", 5.0).call("release")
                time.sleep(0.7 * stopped_s)
            finally:
                os.kill(pid, signal.SIGCONT)
            assert robot.stale, f"{process} stood still, and nobody was told"
            robot.until(20)
            assert robot.too_late() == [], (process, stopped_s)
    assert len(robot.told) > 100
