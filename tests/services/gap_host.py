"""A skin whose measurements or stages stop for a while, in simulated time, beside what truly touches it: bytes in,
contact frames out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from bench.tracking.host import Host
from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Script, Timeline, TouchPath
from firmware_stub.world import Touch, pressed
from models.bundle import Bundle
from protocol.frames import ContactFrame, DeltaFrame, Frame, ImageFrame, PartFrame, RawFrame
from services.pipeline import ALL, Pipeline
from services.runtime.config import ScanMode, Skin
from services.runtime.stage import Stage

FAR_M = 0.015
SCAN_S = 0.0436
STAGES = "Preprocessing", "Inference", "Publishing"
GONE_S = 1e-3  # of simulated time by which the board's clock and ours may differ


@dataclass(frozen=True)
class Press:
    """Newtons from one time to another [s], with a force that grows and falls over `ramp` seconds."""

    x: float
    y: float
    start: float
    end: float
    force: float = 3.0
    ramp: float = 0.0
    radius: float = 0.01

    def path(self) -> TouchPath:
        full = pressed("circle", self.x, self.y, self.radius, self.force)
        if not self.ramp:
            return TouchPath((self.start, self.end), (full, full))
        none = Touch("circle", self.x, self.y, self.radius, 0.0)
        times = (self.start, self.start + self.ramp, self.end - self.ramp, self.end)
        return TouchPath(times, (none, full, full, none))


class HaltingPipeline(Pipeline):
    """`every`: by a stage's name, of how many frames that come it reads the newest, as where the machine is too slow;
    0: it stands still. As in protocol/sockets.py:StageReader the frame is read too whose stack or image that one holds,
    and no part of an image that was not.
    """

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        super().__init__(skin, "palm", bundle)
        self.every: dict[str, int] = {}
        self._names = dict(zip((self.pre, self.inference, self.publishing), STAGES, strict=True))
        self._came: Counter[str] = Counter()
        self._seen = -1  # scan of the image that publisher read last
        self._holder: dict[str, DeltaFrame | ImageFrame] = {}  # that came last, by the stage that did not read it

    def run_all(self, raw: RawFrame) -> list[ContactFrame]:
        frames: list[Frame] = [raw]
        for stage in (self.pre, self.inference, self.publishing):
            frames = [made for frame in frames for made in self._made(stage, frame)]
        return [frame for frame in frames if isinstance(frame, ContactFrame)]

    def _made(self, stage: Stage, frame: Frame) -> list[Frame]:
        if stage is self.inference and isinstance(frame, PartFrame):
            return [frame]
        name = self._names[stage]
        part = isinstance(frame, PartFrame)
        if part and frame.after != self._seen:
            return []
        self._came[name] += not part
        every = self.every.get(name, 1)
        waited = self._holder.get(name)
        if not every or self._came[name] % every:
            if isinstance(frame, DeltaFrame | ImageFrame) and not frame.held:
                self._holder[name] = frame
            return []
        if isinstance(frame, ImageFrame):
            self._seen = frame.scan
        self._holder.pop(name, None)
        made = []
        if isinstance(frame, DeltaFrame | ImageFrame) and frame.held and waited is not None:
            made = stage.everything(waited, ALL) if waited.reconstructed == frame.reconstructed else []
        made = [*made, *stage.everything(frame, ALL)]
        if self.publishing.lacks:
            self.inference.joined("image")
        return made


@dataclass(frozen=True)
class Wrong:
    at_s: float
    what: str
    frame: ContactFrame

    def __str__(self) -> str:
        shown = [(c.id, c.state, np.round(c.position[:2], 3).tolist(), c.force_n) for c in self.frame.contacts]
        return f"{self.at_s:.4f} s, part {self.frame.part}: {self.what}; {self.frame.reasons} {shown}"


class GapHost:
    """Frames are judged against the presses by their own `sample`, with the whole scan about it in doubt."""

    def __init__(self, scan: ScanMode, seed: int, presses: Sequence[Press]) -> None:
        self.presses = presses
        self.rig = Rig(_sheet(), snr_db=80.0, seed=seed)
        paths = tuple(press.path() for press in presses)
        self.rig.field.play(Timeline(Script("gap", tracks=paths), 0.0, (), self.rig.sheet.electrodes), 0.0)
        skin = Skin(port="stub", bundle="square16", scan=scan)
        self.host = Host(self.rig, seed, skin, _bundle())
        self.pipeline = HaltingPipeline(skin, _bundle())
        self.frames: list[tuple[float, ContactFrame]] = []

    def until(self, end: float) -> None:
        while self.host.now < end:
            for raw, _ in self.host.step():
                self.frames += [(self.host.now, frame) for frame in self.pipeline.run_all(raw)]

    def outage(self, start: float, seconds: float, how: str) -> None:
        """Let nothing through from `start` on for so long. how: lost, hang, unplug, or the stage that stands still."""
        self.until(start)
        if how in ("lost", "hang", "unplug"):
            name, args = ("sequence_gaps", {"fraction": 1.0}) if how == "lost" else (how, {})
            self.rig.fault(name, args, start, seconds)
            return
        self.pipeline.every = {how: 0}
        self.until(start + seconds)
        self.pipeline.every = {}

    def close(self) -> None:
        self.rig.close()

    def valid(self, since: float) -> Iterator[tuple[float, ContactFrame]]:
        return ((at, frame) for at, frame in self.frames if at >= since and frame.valid)

    def wrong(self, since: float) -> list[Wrong]:
        """Valid frames that show what is not there, or hide what is."""
        return [
            Wrong(at, what, frame) for at, frame in self.valid(since) for what in what_is_wrong(frame, self.presses)
        ]


def what_is_wrong(frame: ContactFrame, presses: Sequence[Press], clocks_s: float = GONE_S) -> Iterator[str]:
    """What a valid frame shows of what is not there, and hides of what is. clocks_s: by which `sample` may be off."""
    middle = frame.stamps["sample"] * 1e-9
    first, last = middle - SCAN_S - clocks_s, middle + SCAN_S / 2 + clocks_s
    may = [p for p in presses if p.start <= last and p.end >= first]
    must = [p for p in presses if p.start + p.ramp <= first and p.end - p.ramp >= last]
    shown = [c for c in frame.contacts if c.state != "end"]
    for contact in shown:
        if not any(np.hypot(contact.position[0] - p.x, contact.position[1] - p.y) <= FAR_M for p in may):
            yield f"{contact.force_n} N at {contact.position[:2]}, where nothing is"
    for p in must:
        if not any(np.hypot(c.position[0] - p.x, c.position[1] - p.y) <= FAR_M for c in shown):
            yield f"nothing at ({p.x}, {p.y}), where {p.force:g} N are"


@cache
def _sheet() -> Sheet:
    return Sheet("square16")


@cache
def _bundle() -> Bundle:
    return Bundle.load("square16")
