"""Rigs in simulated time, with a host at the other end of the line."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from firmware_stub.board import MeasuredScan
from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from models.patterns import pattern
from protocol import link

PAIRS = pattern("pairs").astype("u1")


@cache
def shared_sheet() -> Sheet:
    return Sheet("square16")


class Host:
    """Talks to a rig as a host would; time goes on only when it waits."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.now, self.decoder = rig, 0.0, link.Decoder()
        self.messages: list[link.Message] = []

    def send(self, message: link.Message) -> None:
        self.rig.feed(link.encode(message), self.now)

    def wait(self, seconds: float, step: float = 0.005) -> list[link.Message]:
        end, new = self.now + seconds, []
        while self.now < end - 1e-9:
            self.now = min(self.now + step, end)
            new += self.decoder.feed(self.rig.pull(self.now))
        self.messages += new
        return new

    def ask(self, message: link.Message) -> link.Message:
        self.wait(0.02)
        self.send(message)
        (answer,) = (m for m in self.wait(0.05) if isinstance(m, (link.Ack, link.Nak, link.Ident, link.Time)))
        return answer

    def start(self, scan: np.ndarray = PAIRS, points: int = 128):
        return self.started(link.Config(1, points, 80e3, scan))

    def started(self, config: link.Config):
        for message in (config, link.Start(config.config)):
            assert isinstance(self.ask(message), link.Ack)
        return self

    def frames(self, seconds: float) -> list[link.ScanFrame]:
        return [m for m in self.wait(seconds) if isinstance(m, link.ScanFrame)]

    def z(self, seconds: float = 0.2) -> np.ndarray:
        """(n, K) |Z| of the frames of the next seconds."""
        return np.abs([frame.z for frame in self.frames(seconds)])


@pytest.fixture
def host() -> Callable[..., Host]:
    return lambda **options: Host(Rig(shared_sheet(), seed=1, **options))


def middles(scan: MeasuredScan, count: int = 120) -> np.ndarray:
    """Instants [s] of a scan's measurements."""
    return scan.start + (np.arange(count) + 0.5) / count * (scan.end - scan.start)
