"""Acquisition without threads, sockets or a clock: a rig, the board's line, and its link, clock included.

Time is simulated: the host reads at most READ_LATE_S after the board has sent something, as a scheduler would. A cable
that is pulled out is found again after REOPEN_S, with a new link, as in services/board/source.py.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from firmware_stub.rig import Rig
from firmware_stub.world import World
from models.bundle import Bundle
from protocol.frames import RawFrame
from services.board.boardlink import BoardLink
from services.board.source import REOPEN_S, BoardSource
from services.runtime.config import Skin

READ_LATE_S = 0.002  # a scheduler's doing
IN_FLIGHT = 256  # scans that were measured and have not arrived


@dataclass(frozen=True)
class Felt:
    """What one scan measured, or the newest part of one. Seconds of simulated time; faults: in force when it began,
    name -> arguments.
    """

    start: float
    middle: float
    first: World  # when the oldest value of its frame was measured
    world: World  # at its middle
    faults: dict[str, dict[str, Any]]


class Host:
    """The host's end of a rig's line. `now` [s] only goes on with `step`."""

    def __init__(self, rig: Rig, seed: int, skin: Skin | None = None, bundle: Bundle | None = None) -> None:
        self.rig, self.now = rig, 0.0
        skin, bundle = skin or Skin(port="stub", bundle="square16"), bundle or Bundle.load("square16")
        self.source = BoardSource("palm", skin, bundle)
        self._rng = np.random.default_rng([seed, 7])
        self._felt: dict[int, Felt] = {}
        self._lately: deque[Felt] = deque(maxlen=self.source.scanning.parts)
        self._reopened_s: float | None = None  # when a cable that was out can be opened again
        self._connect()

    @property
    def problem(self) -> str:
        """What acquisition would say of the board; "" when all is well."""
        return "the port is gone" if self._reopened_s is not None else self.link.problem

    def step(self) -> Iterator[tuple[RawFrame, Felt]]:
        """Go on to the board's next event, and a little later; returns the frames that came by then."""
        self.now += max(1e-3, min(self.rig.wake_s(self.now), 0.02)) + READ_LATE_S * float(self._rng.random()) ** 2
        if self._reopened_s is None and (due := self.link.to_send(self.now)):
            self.rig.feed(due, self.now)
        data = self.rig.pull(self.now)
        while self.rig.scans:
            scan, world, middle = self.rig.scans.popleft()
            first = self.rig.field.segment(scan.start).at(scan.start)
            self._felt[scan.seq] = Felt(scan.start, middle, first, world, self.rig.faults.listing(scan.start))
            if len(self._felt) > IN_FLIGHT:  # the oldest were lost on their way
                self._felt.pop(next(iter(self._felt)))
        if self.rig.unplugged is not None:
            self._reopened_s = self.now + REOPEN_S
        elif self._reopened_s is not None and self.now >= self._reopened_s:
            self._connect()
        if self._reopened_s is not None or not data:
            return
        read_ns = round(self.now * 1e9)
        for scan_frame in self.link.received(data, self.now):
            self._lately.append(self._felt[scan_frame.seq])  # a message may come twice
            frame = self.source.handed_on(scan_frame, self.link, read_ns, self._newest)
            if frame is not None:
                yield frame, replace(self._lately[-1], first=self._lately[0].first)

    def _connect(self) -> None:
        self.link, self._newest = BoardLink(self.source.scanning, self.now), self.source.newest()
        self._reopened_s = None
