"""The stub board at the other end of a line that holds bytes up, and acquisition's own source at this end, in simulated
time: gives its frames, and when they were really measured.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import Script, Timeline
from models.bundle import Bundle
from protocol import link
from protocol.frames import RawFrame
from services.board.host_time import HostTime
from services.board.source import BoardSource
from services.runtime.config import ScanMode, Skin

BOOTED_NS = 1_000_000_000_000  # what the host's clock shows as the simulation begins
READ_LATE_S = 0.002  # a scheduler's doing
LEAST_STEP_S = 2e-4

Delay = Callable[[float], float]
Happening = Callable[["DelayedLine"], object]


@dataclass(frozen=True)
class ReceivedFrame:
    """A frame as acquisition gave it out."""

    at_s: float  # true time
    frame: RawFrame
    true_age_s: float  # since the middle of the scan, or of the newest part, that its values were measured in first
    stated_age_s: float  # by its stamp

    @property
    def usable(self) -> bool:
        """Whether a reader may act on it: late frames are not valid to whoever hands them on."""
        return self.frame.valid and self.stated_age_s <= self.frame.valid_for_s


class DelayedLine(HostTime):
    """A port and the host's clock in one: time goes on while somebody waits for bytes, or sleeps.

    to_host, to_board: for how long [s] bytes are held up that enter the line at a time [s]; their order is kept.
    """

    url = "socket://simulated:1"

    def __init__(
        self,
        seed: int,
        *,
        to_host: Delay | None = None,
        to_board: Delay | None = None,
        answers_time: bool = True,
        scan: ScanMode = "full",
    ) -> None:
        self.scan = scan
        self.rig = Rig(_sheet(), seed=seed, answers_time=answers_time)
        self.rig.field.play(Timeline(Script("nothing"), 0.0, (), self.rig.sheet.electrodes), 0.0)
        self.true_s = 0.0
        self.captured: list[bytes] = []  # every scan that entered the line
        self._delays = to_host, to_board
        self._to_host: deque[tuple[float, bytes]] = deque()  # (when it arrives, what)
        self._to_board: deque[tuple[float, bytes]] = deque()
        self._happenings: list[tuple[float, Happening]] = []
        self._measured: dict[bytes, float] = {}  # values -> when they were measured first
        self._middles: dict[int, float] = {}  # of the scans since the board was started, by number
        self._decoder = link.Decoder()
        self._stop_s = self._suspended_s = 0.0
        self._rng = np.random.default_rng([seed, 11])

    # what a case may do

    def at(self, seconds: float, happening: Happening) -> None:
        """Let something happen at a time."""
        self._happenings.append((seconds, happening))
        self._happenings.sort(key=lambda entry: entry[0])

    def stop(self, seconds: float) -> None:
        """The process does not run for so long; the kernel keeps what comes."""
        self._stop_s = seconds

    def suspend(self, seconds: float) -> None:
        """The machine sleeps, and its monotonic clock with it; the board goes on."""
        self._go_on(self.true_s + seconds)
        self._suspended_s += seconds

    def inject(self, data: bytes) -> None:
        self._to_host.append((self.true_s, data))

    # HostTime

    def now_ns(self) -> int:
        return BOOTED_NS + round((self.true_s - self._suspended_s) * 1e9)

    def suspended_ns(self) -> int:
        return round(self._suspended_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self._go_on(self.true_s + seconds)
        self._stand_still()

    # the port

    def read(self, timeout_s: float) -> bytes:
        end = self.true_s + timeout_s
        while True:
            self._stand_still()
            data = b""
            while self._to_host and self._to_host[0][0] <= self.true_s:
                data += self._to_host.popleft()[1]
            if data or self.true_s >= end:
                return data
            self._step(end)
            if self._to_host and self._to_host[0][0] <= self.true_s:
                self._go_on(self.true_s + READ_LATE_S * float(self._rng.random()) ** 2)

    def write(self, data: bytes) -> None:
        self._hold_up(self._to_board, self._delays[1], data)

    def close(self) -> None:
        pass

    # the world

    def _stand_still(self) -> None:
        while self._stop_s:
            seconds, self._stop_s = self._stop_s, 0.0
            self._go_on(self.true_s + seconds)

    def _go_on(self, until: float) -> None:
        while self.true_s < until:
            self._step(until)

    def _step(self, until: float) -> None:
        """Go on to the next event, or to that time."""
        due = [self.true_s + max(LEAST_STEP_S, self.rig.wake_s(self.true_s)), until]
        if self._to_host and self._to_host[0][0] > self.true_s:
            due.append(self._to_host[0][0])
        due += [max(queue[0][0], self.true_s + LEAST_STEP_S) for queue in (self._to_board, self._happenings) if queue]
        self.true_s = min(due)
        while self._happenings and self._happenings[0][0] <= self.true_s:
            self._happenings.pop(0)[1](self)
        while self._to_board and self._to_board[0][0] <= self.true_s:
            self.rig.feed(self._to_board.popleft()[1], self.true_s)
        data = self.rig.pull(self.true_s)
        while self.rig.scans:
            scan, _, middle = self.rig.scans.popleft()
            self._middles[scan.seq] = middle
        for message in self._decoder.feed(data):
            if isinstance(message, link.ScanFrame):
                self._measured.setdefault(_values(message.z), self._middles[message.seq])
                self.captured.append(link.encode(message))
        if data:
            self._hold_up(self._to_host, self._delays[0], data)

    def _hold_up(self, queue: deque[tuple[float, bytes]], delay: Delay | None, data: bytes) -> None:
        arrives = self.true_s + (delay(self.true_s) if delay else 0.0)
        queue.append((max(arrives, queue[-1][0]) if queue else arrives, data))

    def seen(self, frame: RawFrame) -> ReceivedFrame:
        return ReceivedFrame(
            self.true_s,
            frame,
            self.true_s - self._measured[_values(frame.z[frame.new > 0] if frame.parts > 1 else frame.z)],
            (self.now_ns() - frame.stamps["sample"]) * 1e-9,
        )


class _Source(BoardSource):
    """Acquisition's source at the end of such a line."""

    def __init__(self, line: DelayedLine) -> None:
        super().__init__("palm", Skin(port=line.url, bundle="square16", scan=line.scan), _bundle(), line)
        self.line = line

    def open_port(self, url: str) -> DelayedLine:  # type: ignore[override]
        return self.line


def listen(line: DelayedLine, seconds: float) -> tuple[list[ReceivedFrame], BoardSource]:
    """What acquisition gives out of this line in so many seconds, and the source in the end."""
    source = _Source(line)
    return list(_frames(source, seconds)), source


def _frames(source: _Source, seconds: float) -> Iterator[ReceivedFrame]:
    for frame in source.frames():
        if source.line.true_s >= seconds:
            return
        if frame is not None:
            yield source.line.seen(frame)


def _values(z: NDArray[np.complex64]) -> bytes:
    """What tells these values from others: a part's are sent in another order than the pattern's."""
    return np.sort(z).tobytes()


@cache
def _sheet() -> Sheet:
    return Sheet("square16")


@cache
def _bundle() -> Bundle:
    return Bundle.load("square16")
