"""Board, acquisition and the stages in one process and in simulated time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from firmware_stub.rig import Rig
from firmware_stub.timeline import Script, Timeline
from models.bundle import Bundle
from protocol.frames import ContactFrame
from services.board.boardlink import BoardLink
from services.board.source import BoardSource
from services.pipeline import Pipeline
from services.runtime.config import ScanMode, Skin

CHAIN_S = 0.002  # from a frame read to its contacts
STEP_S = 2e-4  # of the host's loop


@dataclass
class SimulatedHost:
    """A skin that nothing touches until `press` says so; `contacts` (when, frame) as a controller would get them."""

    scan: ScanMode = "rolling"
    snr_db: float = 70.0
    seed: int = 0
    now: float = 0.0
    contacts: list[tuple[float, ContactFrame]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rig = Rig("square16", snr_db=self.snr_db, seed=self.seed)
        self.rig.field.play(Timeline(Script("nothing"), 0.0, (), self.rig.sheet.electrodes), 0.0)
        skin, bundle = Skin(port="stub", bundle="square16", scan=self.scan), Bundle.load("square16")
        self.source = BoardSource("palm", skin, bundle)
        self.link = BoardLink(self.source.scanning, 0.0)
        self.newest = self.source.newest()
        self.pipeline = Pipeline(skin, "palm", bundle)
        self.pipeline.pre.warm_up()

    def press(self, **values: Any) -> None:
        self.rig.press(values, self.now)

    def release(self) -> None:
        self.rig.release(self.now)

    def until(self, end: float) -> None:
        while self.now < end:
            self.step(end)

    def step(self, end: float = np.inf) -> None:
        """Go on to the time of the next event."""
        wait = max(STEP_S, self.rig.wake_s(self.now))
        self.now = min(end, self.now + wait)
        if due := self.link.to_send(self.now):
            self.rig.feed(due, self.now)
        data = self.rig.pull(self.now)
        self.rig.scans.clear()
        for scan in self.link.received(data, self.now) if data else []:
            raw = self.source.handed_on(scan, self.link, round(self.now * 1e9), self.newest)
            if raw is not None and (contact := self.pipeline.step(raw)) is not None:
                self.contacts.append((self.now + CHAIN_S, contact))
