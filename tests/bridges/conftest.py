"""A service that says what a test wants it to say: the sockets are real, the frames made up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, ShapeFrame
from protocol.sockets import Publisher

ROOT = Path(__file__).resolve().parents[2]
EVERY_S = 0.04
SQUARE = [[0.01, -0.01], [0.03, -0.01], [0.03, 0.01], [0.01, 0.01]]


class FakeService:
    """Publishes contacts and images of `palm` every `every_s`, one touch of 3 N at (0.02, 0), until told otherwise."""

    def __init__(self) -> None:
        self.valid, self.silent = True, False
        self.every_s, self.contact = EVERY_S, 1
        self.scan = 0
        self.sent: list[tuple[int, int, bool]] = []  # scan, sample, valid
        self.subscribers: dict[str, int] = {}
        self.tares: list[str] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        publisher, inference, preprocessing = (Publisher(name) for name in ("publisher", "inference", "preprocessing"))
        control = ControlServer("preprocessing", {"tare": self._tare})
        told = {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "parent_frame_id": "wrist", "frame_id": "palm"}
        outline = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
        preprocessing.send(InfoFrame(skin="palm", valid=True, info={**told, "geometry": {"outline": outline}}))
        while not self._closing.wait(self.every_s):
            for each in (publisher, inference, preprocessing):
                each.poll()
            control.serve_once()
            topics = (("contact", publisher), ("shape", publisher), ("image", inference), ("delta", preprocessing))
            self.subscribers = {topic: each.subscribers(topic, "palm") for topic, each in topics}
            if not self.silent:
                self._send(publisher, inference)
        for each in (publisher, inference, preprocessing):
            each.close()
        control.close()

    def _send(self, publisher: Publisher, inference: Publisher) -> None:
        valid = self.valid  # the test may change it meanwhile
        self.scan += 1
        now = time.monotonic_ns() - 5_000_000
        head = {
            "skin": "palm",
            "scan": self.scan,
            "source": "stub",
            "valid": valid,
            "valid_for_s": 0.25,
            "reasons": [] if valid else ["frozen"],
            "stamps": {"sample": now},
        }
        touch = Contact(
            id=self.contact,
            position=[0.02, 0.0, 0.0],
            area_m2=3e-4,
            force_n=3.0,
            force_sigma_n=0.2,
            wrench=[0, 0, -3.0, 0, 0.06, 0],
        )
        publisher.send(ContactFrame(**head, frame_id="palm", contacts=[touch]))  # type: ignore[arg-type]
        publisher.send(
            ShapeFrame(**head, ids=[touch.id], outlines=[SQUARE], orientation=[0.0], probabilities=[[0.2] * 5])  # type: ignore[arg-type]
        )
        image = np.zeros((8, 8), "<f4")
        image[4, 6] = 0.3
        inference.send(ImageFrame(**head, touched=True, image=image, metres_per_pixel=0.01, origin=[-0.04, -0.04]))  # type: ignore[arg-type]
        self.sent.append((self.scan, now, valid))

    def _tare(self, args: dict[str, object]) -> dict[str, object]:
        self.tares.append(str(args["skin"]))
        return {"frames": 64}

    def close(self) -> None:
        self._closing.set()
        self._thread.join(10)


@pytest.fixture
def fake(runtime: Path) -> Iterator[FakeService]:
    made = FakeService()
    try:
        yield made
    finally:
        made.close()


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

    def status(self) -> dict[str, object]:
        """Its answer to the command `status`, once there is one."""
        end = time.monotonic() + 60
        while True:
            try:
                return ControlClient(self.name, 1.0).call("status", skin="palm")
            except ControlError:
                assert time.monotonic() < end and self.process.poll() is None, self.said()
                time.sleep(0.05)

    def close(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(20) == 0, self.said()
