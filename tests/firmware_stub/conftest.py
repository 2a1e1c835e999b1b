"""Rigs in simulated time, with a host at the other end of the line."""

from functools import cache

import numpy as np
import pytest

from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from models.patterns import pattern
from protocol import link

PAIRS = pattern("pairs").astype("u1")


@cache
def shared_sheet():
    return Sheet("square16")


class Host:
    """Talks to a rig as a host would; time goes on only when it waits."""

    def __init__(self, rig):
        self.rig, self.now, self.decoder = rig, 0.0, link.Decoder()
        self.messages: list[link.Message] = []

    def send(self, message):
        self.rig.feed(link.encode(message), self.now)

    def wait(self, seconds, step=0.005):
        end, new = self.now + seconds, []
        while self.now < end - 1e-9:
            self.now = min(self.now + step, end)
            new += self.decoder.feed(self.rig.pull(self.now))
        self.messages += new
        return new

    def ask(self, message):
        self.wait(0.02)
        self.send(message)
        (answer,) = (m for m in self.wait(0.05) if isinstance(m, (link.Ack, link.Nak, link.Ident, link.Time)))
        return answer

    def start(self, scan=PAIRS, points=128):
        return self.started(link.Config(1, points, 80e3, scan))

    def started(self, config):
        for message in (config, link.Start(config.config)):
            assert isinstance(self.ask(message), link.Ack)
        return self

    def frames(self, seconds):
        return [m for m in self.wait(seconds) if isinstance(m, link.ScanFrame)]

    def z(self, seconds=0.2):
        """(n, K) |Z| of the frames of the next seconds."""
        return np.abs([frame.z for frame in self.frames(seconds)])


@pytest.fixture
def host():
    return lambda **options: Host(Rig(shared_sheet(), seed=1, **options))


def middles(scan, count=120):
    """Instants [s] of a scan's measurements."""
    return scan.start + (np.arange(count) + 0.5) / count * (scan.end - scan.start)
