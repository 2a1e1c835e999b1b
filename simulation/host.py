"""A skin in its caller's time: stub board, line, acquisition's own source and the stages. Bytes in, contact frames out.

    host = SimulatedHost("rolling", snr_db=80.0, seed=3)     # or tared("rolling"), which costs a tenth of a second less
    host.until(6.0)
    host.press(x=0.02, y=-0.01, force=2.0)
    host.until(7.0)
    when, frame = host.contacts[-1]

A cable that is pulled out is found again after REOPEN_S, with a new link, as in services/board/source.py.
"""

from __future__ import annotations

import io
import pickle
import threading
import time
from collections import deque
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Script
from firmware_stub.world import World
from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame, pack, unpack
from services.board.boardlink import BoardLink
from services.board.source import REOPEN_S, BoardSource
from services.pipeline import Pipeline
from services.runtime.config import ScanMode, Skin
from services.runtime.stage import Refused
from simulation.halting import HaltingPipeline
from simulation.sheets import solved_sheet
from simulation.truth import TruePaths, WrongFrame, what_is_wrong

CHAIN_S = 0.002  # from a frame read to its contacts
LATE_S = 0.002  # a scheduler's doing
IN_FLIGHT = 256  # scans that were measured and have not arrived
TARED_S = 6.0
FIT_S = 300.0  # a fit of the mounting takes seconds


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


@dataclass
class SimulatedHost:
    """A skin that nothing touches until `press` or a script says so; `contacts`: (when, frame), as a controller would
    get them. `now` [s] only goes on with `step` and `until`.

    skin, bundle: where square16 as `scan` says is not it. sheet, world: what is measured, see Rig; `rig`: one of the
    caller's own instead. script: what is played from the beginning on. late_s: how much later a scheduler may let the
    host read, at most. halting: stages may stand still, see HaltingPipeline. keep: `raws`, as they were handed on, and
    `felt`, what each measured.
    """

    scan: ScanMode = "rolling"
    snr_db: float = 70.0
    seed: int = 0
    now: float = 0.0
    contacts: list[tuple[float, ContactFrame]] = field(default_factory=list)
    skin: Skin = field(default=None, kw_only=True)  # type: ignore[assignment]
    bundle: Bundle = field(default=None, kw_only=True)  # type: ignore[assignment]
    sheet: Sheet | None = field(default=None, kw_only=True)
    world: str = field(default="", kw_only=True)
    rig: Rig = field(default=None, kw_only=True)  # type: ignore[assignment]
    script: Script | None = field(default=None, kw_only=True)
    late_s: float = field(default=0.0, kw_only=True)
    halting: bool = field(default=False, kw_only=True)
    keep: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.rig is None:
            own = self.sheet or ("square16" if self.world else solved_sheet())
            self.rig = Rig(own, snr_db=self.snr_db, seed=self.seed, world=self.world)
            self.play(self.script or Script("nothing"))
        elif self.script is not None:
            self.play(self.script)
        self.skin = self.skin or Skin(port="stub", bundle="square16", scan=self.scan)
        self.bundle = self.bundle or loaded(self.skin.bundle)
        self.source = BoardSource("palm", self.skin, self.bundle)
        self.raws: list[RawFrame] = []
        self.felt: list[Felt] = []
        self.problems: list[tuple[float, str]] = []  # what acquisition said of the board, and since when
        self._rng = np.random.default_rng([self.seed, 7])
        self._felt: dict[int, Felt] = {}
        self._lately: deque[Felt] = deque(maxlen=self.source.scanning.parts)
        self._reopened_s: float | None = None  # when a cable that was out can be opened again
        self._connect()

    @cached_property
    def pipeline(self) -> Pipeline:
        """The stages, made when they are first asked for."""
        made = (HaltingPipeline if self.halting else Pipeline)(self.skin, "palm", self.bundle)
        made.pre.warm_up()
        return made

    @property
    def problem(self) -> str:
        """What acquisition would say of the board; "" when all is well."""
        return "the port is gone" if self._reopened_s is not None else self.link.problem

    # --- what is done to the skin ---

    def press(self, **values: Any) -> None:
        self.rig.press(values, self.now)

    def release(self) -> None:
        self.rig.release(self.now)

    def play(self, script: Script) -> None:
        """Whose times count from now on; ends what was played."""
        self.rig.field.play(self.rig.timeline(script, self.now), self.now)

    def tare(self) -> bool:
        """A person says that nothing touches, whether that is so or not. False: the stages refused."""
        return tare(self.pipeline)

    def outage(self, start: float, seconds: float, how: str) -> None:
        """Go on to `start`, and let nothing through for so long. how: lost, a fault of the board without arguments, or
        the stage that stands still, of a halting host.
        """
        self.until(start)
        if isinstance(self.pipeline, HaltingPipeline) and how in self.pipeline.names.values():
            self.pipeline.still = how
            self.until(start + seconds)
            self.pipeline.still = ""
            return
        name, args = ("sequence_gaps", {"fraction": 1.0}) if how == "lost" else (how, {})
        self.rig.fault(name, args, start, seconds)

    def close(self) -> None:
        self.rig.close()

    # --- time ---

    def until(self, end: float) -> None:
        while self.now < end:
            self.step(end)

    def step(self, end: float = np.inf) -> None:
        """Go on to the time of the next event, not beyond `end`."""
        for raw, felt in self.acquired(end):
            self.take(raw, felt)

    def take(self, raw: RawFrame, felt: Felt) -> None:
        """Let the stages have a frame."""
        if self.keep:
            self.raws.append(as_received(raw))
            self.felt.append(felt)
        if isinstance(self.pipeline, HaltingPipeline):
            made = self.pipeline.run_all(raw)
        else:
            contact = self.pipeline.step(raw)
            made = [] if contact is None else [contact]
        self.contacts += [(self.now + CHAIN_S, frame) for frame in made]

    def acquired(self, end: float = np.inf) -> list[tuple[RawFrame, Felt]]:
        """As `step`, but the stages get nothing: the raw frames that came, and what each measured."""
        self.now = min(end, self.now + self._waits_s())
        if self._reopened_s is None and (due := self.link.to_send(self.now)):
            self.rig.feed(due, self.now)
        data = self.rig.pull(self.now)
        self._note_scans()
        if self.rig.unplugged is not None:
            self._reopened_s = self.now + REOPEN_S
        elif self._reopened_s is not None and self.now >= self._reopened_s:
            self._connect()
        frames = self._handed_on(data) if data and self._reopened_s is None else []
        if self.problem != (self.problems[-1][1] if self.problems else ""):
            self.problems.append((self.now, self.problem))
        return frames

    # --- what the frames say ---

    def valid(self, since: float) -> list[tuple[float, ContactFrame]]:
        return [(at, frame) for at, frame in self.contacts if at >= since and frame.valid]

    def wrong(self, since: float) -> list[WrongFrame]:
        """What valid frames show that is not there, or hide of what is, by the tracks that are played."""
        truth = TruePaths(self.rig.field.timeline.script.tracks, self.rig.sheet)
        return [wrong for at, frame in self.valid(since) for wrong in what_is_wrong(at, frame, truth)]

    # --- inside ---

    def _waits_s(self) -> float:
        wakes_s = self.rig.wake_s(self.now)
        if not self.late_s:
            return max(2e-4, wakes_s)
        return max(1e-3, min(wakes_s, 0.02)) + self.late_s * float(self._rng.random()) ** 2

    def _note_scans(self) -> None:
        while self.rig.scans:
            scan, world, middle = self.rig.scans.popleft()
            first = self.rig.field.segment(scan.start).at(scan.start)
            self._felt[scan.seq] = Felt(scan.start, middle, first, world, self.rig.faults.listing(scan.start))
            if len(self._felt) > IN_FLIGHT:  # the oldest were lost on their way
                self._felt.pop(next(iter(self._felt)))

    def _handed_on(self, data: bytes) -> list[tuple[RawFrame, Felt]]:
        found, read_ns = [], round(self.now * 1e9)
        for scan in self.link.received(data, self.now):
            if scan.seq in self._felt:  # a relay's frames may have any number
                self._lately.append(self._felt[scan.seq])
            raw = self.source.handed_on(scan, self.link, read_ns, self.newest)
            if raw is not None:
                found.append((raw, replace(self._lately[-1], first=self._lately[0].first)))
        return found

    def _connect(self) -> None:
        self.link, self.newest = BoardLink(self.source.scanning, self.now), self.source.newest()
        self._reopened_s = None


def as_received(raw: RawFrame) -> RawFrame:
    """As it would reach another process."""
    frame = unpack(pack(raw))
    assert isinstance(frame, RawFrame)
    return frame


def tare(pipeline: Pipeline) -> bool:
    """As a person would ask for it; a fit that this begins is waited for. False: refused, since something touches, or
    too few frames agree.
    """
    try:
        pipeline.pre.command("tare", {})
    except Refused:
        return False
    waited = time.monotonic() + FIT_S
    while pipeline.pre.linearisation.busy and time.monotonic() < waited:
        pipeline.prepare()
        time.sleep(0.02)
    return True


# --- a host that has its baseline ---


def tared(scan: ScanMode = "rolling", snr_db: float = 80.0, seed: int = 0, **more: Any) -> SimulatedHost:
    """A host of its own after TARED_S untouched, copied from one that was made before with the same arguments."""
    kept, copy_of = _tared(scan, snr_db, seed, tuple(sorted(more.items())))
    return _HostReader(io.BytesIO(kept), copy_of).load()  # type: ignore[no-any-return]


@cache
def loaded(bundle: str) -> Bundle:
    return Bundle.load(bundle)


@cache
def _tared(scan: ScanMode, snr_db: float, seed: int, more: tuple[tuple[str, Any], ...]) -> tuple[bytes, dict[int, Any]]:
    host = SimulatedHost(scan, snr_db, seed, **dict(more))
    host.until(TARED_S)
    file = io.BytesIO()
    writer = _HostWriter(file)
    writer.dump(host)
    return file.getvalue(), writer.shared


LOCKS = {type(make()): make for make in (threading.Lock, threading.RLock)}
SHARED = ("Bundle", "Sheet", "SolvedSheet", "InferenceSession")
"""Classes whose objects do not change once they are made."""


class _HostWriter(pickle.Pickler):
    """Leaves out what copies share, and locks."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.shared: dict[int, Any] = {}

    def persistent_id(self, obj: Any) -> int | None:
        if type(obj) not in LOCKS and type(obj).__name__ not in SHARED:
            return None
        self.shared[id(obj)] = obj
        return id(obj)


class _HostReader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, shared: dict[int, Any]) -> None:
        super().__init__(file)
        self._shared = {key: LOCKS[type(obj)]() if type(obj) in LOCKS else obj for key, obj in shared.items()}

    def persistent_load(self, pid: int) -> Any:
        return self._shared[pid]
