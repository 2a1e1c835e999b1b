"""Rigs in simulated time, with a host at the other end of the line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest

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
        """Messages that arrive in the next seconds."""
        end, new = self.now + seconds, []
        while self.now < end - 1e-9:
            self.now = min(self.now + step, end)
            new += self.decoder.feed(self.rig.pull(self.now))
        self.messages += new
        return new

    def ask(self, message: link.Message) -> link.Message:
        """The answer to a command."""
        self.wait(0.02)
        self.send(message)
        (answer,) = (m for m in self.wait(0.05) if isinstance(m, (link.Ack, link.Nak, link.Ident, link.Time)))
        return answer

    def start(self, scan: np.ndarray = PAIRS, points: int = 128, config: int = 1) -> None:
        assert isinstance(self.ask(link.Config(config, points, 80e3, scan)), link.Ack)
        assert isinstance(self.ask(link.Start(config)), link.Ack)

    def frames(self, seconds: float) -> list[link.ScanFrame]:
        return [m for m in self.wait(seconds) if isinstance(m, link.ScanFrame)]

    def z(self, seconds: float = 0.2) -> np.ndarray:
        """(n, K) |Z| of the frames of the next seconds."""
        return np.abs([frame.z for frame in self.frames(seconds)])


@pytest.fixture
def host() -> Iterator[Callable[..., Host]]:
    made: list[Host] = []

    def make(**options: object) -> Host:
        made.append(Host(Rig(shared_sheet(), seed=1, **options)))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for one in made:
        one.rig.close()
