"""Where raw frames come from: a board, a recording, an imported file. One interface, so that acquisition does not care.

A source blocks for at most POLL_S at a time, and never raises for what its device or file does.
"""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

from models.bundle import Bundle
from protocol import link
from protocol.frames import DeltaFrame, RawFrame
from protocol.sockets import NewestReader
from services.board import port as ports
from services.board.adaptive import AdaptiveScan
from services.board.boardlink import BoardLink, Scanning
from services.board.clock import UNSETTLED_NS, DeviceClock
from services.config import Skin
from services.stage import Health
from services.touches.sentinel import sentinel_of

POLL_S = 0.1
REOPEN_S = 0.2  # between attempts to open a port
INTRODUCE_S = 0.6  # for a board under another name to say who it is
COUNT_EVERY_S = 0.1
SCANS_VALID = 3  # a frame is valid until this many scans later

log = logging.getLogger(__name__)


class Source(ABC):
    """Raw frames of one skin."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        self.name, self.skin, self.bundle = name, skin, bundle
        self.problem = ""
        self.counts: Counter[str] = Counter()

    @abstractmethod
    def frames(self) -> Iterator[RawFrame | None]:
        """Frames as they come, for ever; None at least every POLL_S while none comes."""

    def health(self) -> Health:
        return Health("ERROR" if self.problem else "OK", [self.problem] if self.problem else [], dict(self.counts))

    def _ended(self, problem: str) -> Iterator[None]:
        """There is nothing more to come, for this reason or for one that was found before."""
        self.problem = self.problem or problem
        while True:
            time.sleep(POLL_S)
            yield None

    def close(self) -> None:  # noqa: B027  (nothing to close is a valid case)
        pass

    @property
    def pattern_name(self) -> str:
        return str(self.bundle.skin.get("pattern", "custom"))


class BoardSource(Source):
    """A board behind a serial port. Opens, asks, configures, starts, and does so again whenever anything goes wrong."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name, skin, bundle)
        self.scanning = Scanning(bundle.pattern, skin.dft_points, skin.rtia_ohm)
        self.idling: Scanning | None = None
        self._verdicts: NewestReader | None = None  # what preprocessing makes of the frames
        if skin.scan == "adaptive":
            self.idling = Scanning(bundle.pattern[sentinel_of(bundle).rows], skin.dft_points, skin.rtia_ohm)
        self._port: ports.Port | None = None
        self._board = ""  # unique id of the board that we know
        self._usb_serial: str | None = None
        self._lost = ""
        self._full_s = 0.0  # duration of the last full scan

    def frames(self) -> Iterator[RawFrame | None]:
        while True:
            for n, url in enumerate(ports.candidates(self.skin.port, self.name, self._usb_serial, bool(self._board))):
                try:
                    self._port = ports.Port(url)
                except ports.PortError as why:
                    self._trouble(str(why) if n == 0 else self.problem)  # the configured name is the one to speak of
                    continue
                try:
                    stranger = yield from self._connection(self._port, must_be=self._board if n else "")
                    if stranger:
                        continue
                except ports.PortError as why:
                    self._trouble(str(why))
                    self.counts["disconnects"] += 1
                finally:
                    self.close()
                break
            time.sleep(REOPEN_S)
            yield None

    def close(self) -> None:
        if self._verdicts is not None:
            self._verdicts.close()
            self._verdicts = None
        if self._port is not None:
            self._port.close()
            self._port = None

    def _connection(self, port: ports.Port, must_be: str) -> Generator[RawFrame | None, None, bool]:
        """Until the port is gone (PortError), or turns out to be another board than `must_be` (returns True)."""
        opened = time.monotonic()
        board, clock = BoardLink(self.scanning, opened, self.idling), DeviceClock()
        adaptive = self.adaptive()
        seen: Counter[str] = Counter()
        counted_ns = 0
        while True:
            now = time.monotonic()
            wait_s = POLL_S if board.state == "running" else 0.02
            if adaptive is not None:
                self._listen(adaptive, now)
                if board.state != "running" or not board.switches:
                    adaptive.interrupted()
                else:
                    self.steer(board, adaptive, now)
                    wait_s = min(wait_s, adaptive.due_s(now))
            due = board.to_send(now)
            if due:
                port.write(due)
            if adaptive is None:  # its lists differ in length, and it cannot wait
                time.sleep(board.pause_s(time.monotonic()))
            data = port.read(wait_s)
            read_ns = time.monotonic_ns()
            scans = board.received(data, read_ns * 1e-9) if data else []
            if read_ns - counted_ns > COUNT_EVERY_S * 1e9 or not scans:
                counted_ns = read_ns
                self._count(board, seen, adaptive)
            if must_be and (board.board or now - opened > INTRODUCE_S) and board.board != must_be:
                return True
            if board.state == "running" and self._board != board.board:
                self._board, self._usb_serial = board.board, ports.usb_serial_number(port.url)
            if board.problem != self.problem:
                self._trouble(board.problem)
            for scan in scans:
                passed = adaptive.scanned(scan, read_ns * 1e-9) if adaptive else [(scan, "full")]
                for what, kind in passed:
                    yield self.raw_frame(what, board, clock, read_ns, kind)
            if not scans:
                yield None

    def adaptive(self) -> AdaptiveScan | None:
        """What decides which list a new connection's board scans, where skin.toml wants that."""
        return AdaptiveScan(sentinel_of(self.bundle), self.idling.config) if self.idling else None

    def steer(self, board: BoardLink, adaptive: AdaptiveScan, now_s: float) -> None:
        """Have the board scan what `adaptive` wants."""
        assert self.idling is not None
        confirmed = "full" if board.confirmed is self.scanning else "sentinel"
        board.switch(self.scanning if adaptive.wants(now_s, confirmed) == "full" else self.idling)

    def _listen(self, adaptive: AdaptiveScan, now_s: float) -> None:
        """Preprocessing's newest verdict, in the thread that the socket belongs to."""
        if self._verdicts is None:
            self._verdicts = NewestReader("delta", self.name)
        while (delta := self._verdicts.recv()) is not None:
            if isinstance(delta, DeltaFrame):
                adaptive.heard(delta, now_s)

    def raw_frame(
        self, scan: link.Frame, board: BoardLink, clock: DeviceClock, read_ns: int, kind: str = "full"
    ) -> RawFrame:
        """A scan of the board with this host's stamps; `read_ns`: when its last byte was read.

        Only full scans set the clock: one that is shorter on the line arrives sooner.
        """
        if kind == "full":
            # The first byte leaves as the scan ends; the last one as much later as the line is slow.
            arrived_ns = round(board.began_s.get(scan.seq, read_ns * 1e-9) * 1e9)
            clock.observe(scan.device_us + scan.duration_us, min(arrived_ns, read_ns))
            self._full_s = scan.duration_us * 1e-6
        reasons = ["gap"] if board.gap else []
        if clock.sigma_ns >= UNSETTLED_NS:
            reasons.append("clock")
        assert board.ident is not None
        return RawFrame(
            skin=self.name,
            scan=scan.seq,
            stamps={"sample": min(read_ns, clock.host_ns(scan.device_us + scan.duration_us // 2)), "read": read_ns},
            sample_sigma_ns=clock.sigma_ns,
            source="stub" if "stub" in board.ident.firmware.lower() else "board",
            valid=True,
            reasons=reasons,
            valid_for_s=max(0.05, SCANS_VALID * self._full_s),
            z=scan.z,
            kind=kind,
            status=scan.status,
            device_us=scan.device_us,
            config=scan.config,
            pattern=self.pattern_name,
            board=board.board,
        )

    def _trouble(self, problem: str) -> None:
        """Say what is the matter, once each time it changes."""
        if problem == self.problem:
            return
        if problem:
            log.warning("%s: %s", self.name, problem)
        else:
            log.info("%s: the board is running", self.name)
        self.problem = problem

    def _count(self, board: BoardLink, seen: Counter[str], adaptive: AdaptiveScan | None) -> None:
        """Add what is new in the connection's counts to ours."""
        now = board.counts + Counter({f"line_{what}": n for what, n in board.decoder.counts.items() if what != "good"})
        if adaptive is not None:
            now += adaptive.counts
        if now != seen:
            self.counts += now - seen
            seen.clear()
            seen.update(now)


def open_source(name: str, skin: Skin, bundle: Bundle) -> Source:
    """The source that a skin's `port` names."""
    from services.board.file_source import FileSource, RecordingSource  # here: they are sources themselves

    kind = {".mcap": RecordingSource, ".npz": FileSource}.get(Path(skin.port).suffix, BoardSource)
    return kind(name, skin, bundle)
