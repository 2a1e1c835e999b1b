"""A service that says what a test wants it to say: the sockets are real, the frames made up."""

import contextlib
import fcntl
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, ShapeFrame
from protocol.sockets import Publisher
from tests.needs import ROOT
from tests.waiting import end, until

SQUARE = [[0.01, -0.01], [0.03, -0.01], [0.03, 0.01], [0.01, 0.01]]
PLACED = {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "parent_frame_id": "wrist", "frame_id": "palm"}


def drop_image() -> np.ndarray:
    image = np.zeros((8, 8), "<f4")
    image[4, 6] = 0.3
    return image


class FakeService:
    """Publishes contacts and images of `palm` every `every_s`, one touch of 3 N at (0.02, 0), until told otherwise; and
    contacts of `sole`, which nothing touches.
    """

    def __init__(self) -> None:
        self.valid, self.silent, self.every_s, self.contact, self.scan = True, False, 0.04, 1, 0
        self.sent: list[tuple[int, int, bool]] = []  # scan, sample, valid
        self.subscribers: dict[str, int] = {}
        self.tares: list[str] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        publisher, inference, preprocessing = (Publisher(name) for name in ("publisher", "inference", "preprocessing"))
        tare = {"tare": lambda args: self.tares.append(args["skin"]) or {"frames": 64}}
        control = ControlServer("preprocessing", tare)
        outline = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
        preprocessing.send(InfoFrame(skin="palm", valid=True, info={**PLACED, "geometry": {"outline": outline}}))
        topics = {"contact": publisher, "shape": publisher, "image": inference, "delta": preprocessing}
        while not self._closing.wait(self.every_s):
            for each in {*topics.values()}:
                each.poll()
            control.serve_once()
            self.subscribers = {topic: each.subscribers(topic, "palm") for topic, each in topics.items()}
            if not self.silent:
                self._send(publisher, inference)
        for each in (*{*topics.values()}, control):
            each.close()

    def _send(self, publisher: Publisher, inference: Publisher) -> None:
        valid = self.valid  # the test may change it meanwhile
        self.scan += 1
        now = time.monotonic_ns() - 5_000_000
        head: dict[str, Any] = {"skin": "palm", "scan": self.scan, "source": "stub", "stamps": {"sample": now}}
        head |= {"valid": valid, "valid_for_s": 0.25, "reasons": [] if valid else ["frozen"]}
        touch = Contact(id=self.contact, position=[0.02, 0.0, 0.0], area_m2=3e-4, force_n=3.0, force_sigma_n=0.2)
        touch.wrench = [0, 0, -3.0, 0, 0.06, 0]
        shape: dict[str, Any] = {"outlines": [SQUARE], "orientation": [0.0], "probabilities": [[0.2] * 5]}
        publisher.send(ContactFrame(**head, frame_id="palm", contacts=[touch]))
        publisher.send(ContactFrame(**head | {"skin": "sole"}, frame_id="sole"))
        publisher.send(ShapeFrame(**head, **shape, ids=[touch.id]))
        grid: dict[str, Any] = {"metres_per_pixel": 0.01, "origin": [-0.04, -0.04]}
        inference.send(ImageFrame(**head, **grid, touched=True, image=drop_image()))
        self.sent.append((self.scan, now, valid))


@pytest.fixture
def fake(runtime: Path) -> Iterator[FakeService]:
    made = FakeService()
    yield made
    made._closing.set()
    made._thread.join()


@pytest.fixture
def domain() -> Iterator[int]:
    """A DDS domain that no other test of this host has meanwhile."""
    for number in range(10, 97):
        with contextlib.suppress(BlockingIOError), open(f"/tmp/eitskin-domain-{number}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield number
            return


class RunningBridge:
    """A bridge as its own process, started as the supervisor starts it."""

    def __init__(self, name: str, folder: Path, section: str) -> None:
        self.name = name
        config = folder / "bridge.toml"
        config.write_text(f'[skins.palm]\nport = "stub"\nbundle = "square16"\n[{name}]\n{section}\n')
        self._log = folder / "bridge.txt"
        with open(self._log, "wb") as log:
            environment = {**os.environ, "EITSKIN_CONFIG": str(config), "PYTHONUNBUFFERED": "1"}
            command = [sys.executable, "-m", "services.bridge", name]
            self.process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)

    def said(self) -> str:
        return self._log.read_text()

    def status(self) -> Any:
        """Its answer to the command `status`, once there is one."""

        def asked() -> Any:
            with contextlib.suppress(ControlError):
                return ControlClient(self.name, 1.0).call("status", skin="palm")

        return until(asked, self.process)

    def close(self) -> None:
        end(self.process)
        assert self.process.returncode == 0, self.said()
