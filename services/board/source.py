"""Sources of raw frames: a board, a recording, an imported file, with one interface.

A source blocks for at most POLL_S at a time, and never raises for what its device or file does.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import replace

from models.bundle import Bundle
from models.measurement.responses.tables import tells_touches
from protocol import link
from protocol.frames import RawFrame
from protocol.part_size import parts_on_line
from protocol.pause import pause
from services.board import port as ports
from services.board.boardlink import BoardLink
from services.board.clock import UNSETTLED_NS
from services.board.host_time import STOOD_STILL_S, HostTime, Suspensions
from services.board.newest_values import NewestValues
from services.board.other_end import NETWORK, OtherEnd
from services.board.remarks import Remarks
from services.board.rolling_order import parts_of, rolling_order
from services.board.scanning import Scanning
from services.runtime.config import Skin
from services.runtime.stage import Health, add_reason, valid_for_s

POLL_S = 0.1
REOPEN_S = 0.2  # between attempts to open a port
MOST_REOPEN_S = 5.0  # the same where no board was found behind it, again and again: twice as long each time
INTRODUCE_S = 0.6  # for a board under another name to say who it is
COUNT_EVERY_S = 0.1
MOST_WAITING = 4_000_000  # bytes read in one go after a standstill

LOG_AGAIN_S = 10.0  # the same trouble that comes and goes is logged at most so often

log = logging.getLogger(__name__)


class Source(ABC):
    """A Source gives the raw frames of one skin."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        self.name, self.skin, self.bundle = name, skin, bundle
        self.problem = ""
        self.counts: Counter[str] = Counter()
        self.ending = threading.Event()
        """The process is on its way out: a board that goes too (the stub does) is nothing to tell a person."""

    @abstractmethod
    def frames(self) -> Iterator[RawFrame | None]:
        """Yields frames as they come, for ever; None at least every POLL_S while none comes."""

    def health(self) -> Health:
        return Health("ERROR" if self.problem else "OK", [self.problem] if self.problem else [], dict(self.counts))

    def _ended(self, problem: str) -> Iterator[None]:
        """There is nothing more to come, for this reason or for one that was found before."""
        self.problem = self.problem or problem
        while True:
            pause(POLL_S)
            yield None

    def close(self) -> None:  # noqa: B027  (nothing to close is a valid case)
        pass

    @property
    def pattern_name(self) -> str:
        return str(self.bundle.skin.get("pattern", "custom"))


def in_parts(scanning: Scanning, bundle: Bundle, baud: int) -> Scanning:
    """The same in as many parts as the line carries; whole where it carries none."""
    parts = parts_on_line(len(bundle.pattern), parts_of(bundle), scanning.setting, baud)
    return replace(scanning, parts=parts, order=rolling_order(bundle)) if parts > 1 else scanning


class BoardSource(Source):
    """A board behind a serial port. Opens, asks, configures, starts, and does so again whenever anything goes wrong."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle, host: HostTime | None = None) -> None:
        super().__init__(name, skin, bundle)
        self.host = host or HostTime()
        self.remarks = Remarks()
        self._logged: dict[str, float] = {}  # what was logged lately, and when
        self.scanning = Scanning(bundle.pattern, skin.setting, skin.rtia_ohm)
        if skin.scan == "rolling" and tells_touches(bundle):  # a measured map gains nothing from parts
            self.scanning = in_parts(self.scanning, bundle, skin.baud)
        self.whole = False  # for now, though it could scan in parts; another thread's to say
        self.in_parts = self.scanning.parts > 1  # where the load allows it, as far as the board is known
        self._port: ports.Port | None = None
        self._board = ""  # unique id of the board that we know
        self._usb_serial: str | None = None
        self._strangers = 0  # connections in a row that were lost before a scan came, or that a network refused

    def frames(self) -> Iterator[RawFrame | None]:
        while True:
            for n, url in enumerate(ports.candidates(self.skin.port, self.name, self._usb_serial, bool(self._board))):
                try:
                    self._port = self.open_port(url)
                except ports.PortError as why:
                    self._trouble(str(why) if n == 0 else self.problem)  # the configured name is the one to speak of
                    self._strangers += self.skin.port.lower().startswith(NETWORK)
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
            yield from self._wait_to_reopen()

    def _wait_to_reopen(self) -> Iterator[None]:
        again = self._now() + min(MOST_REOPEN_S, REOPEN_S * 2 ** min(self._strangers, 8))
        while not self.ending.is_set() and (left := again - self._now()) > 0:
            self.host.sleep(min(REOPEN_S, left))
            yield None

    def open_port(self, url: str) -> ports.Port:
        """Raises PortError."""
        return ports.Port(url, self.skin.baud)

    def health(self) -> Health:
        return self.remarks.added_to(super().health())

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _connection(self, port: ports.Port, must_be: str) -> Generator[RawFrame | None, None, bool]:
        """Yields a connection's frames until the port is gone (PortError), or turns out to be another board than
        `must_be` (returns True).
        """
        opened = last = self._now()
        board = BoardLink(self.scanning, opened, OtherEnd(port.url, self.skin.baud))
        suspensions = Suspensions(self.host)
        newest, whole = self.newest(), False
        seen: Counter[str] = Counter()
        counted = 0.0
        try:
            while True:
                now = self._now()
                if whole != self.whole:
                    whole, newest = self.whole, self.newest()
                    board.scan_as(self.scanning.whole if whole else self.scanning, now)
                wait_s = POLL_S if board.state == "running" else 0.02
                # After a standstill what waits is read first: the board was not silent, and not asked either.
                due = board.to_send(now) if now - last < STOOD_STILL_S else b""
                if due:
                    port.write(due)
                self.host.sleep(board.pause_s(self._now()))
                data = port.read(wait_s)
                stood_s = self._now() - last
                if stood_s > STOOD_STILL_S:
                    data += self._waiting(port)
                if suspensions.happened():
                    board.suspended(self._now())
                read_ns = self.host.now_ns()
                last = read_ns * 1e-9
                scans = board.received(data, last) if data else []
                if must_be and (board.board or now - opened > INTRODUCE_S) and board.board != must_be:
                    return True
                if board.state == "running" and self._board != board.board:
                    self._board, self._usb_serial = board.board, ports.usb_serial_number(port.url)
                if board.problem or board.state == "running":  # until then what was the matter is
                    self._trouble(board.problem)
                came = bool(scans)
                if stood_s > STOOD_STILL_S:
                    scans = self._newest(scans, board, stood_s, last)
                frames = [self.handed_on(scan, board, read_ns, newest) for scan in scans]
                if last - counted > COUNT_EVERY_S or not came:
                    counted = last
                    self._count(board, seen)
                    self.remarks.look(board, last, whole)
                    self.in_parts = self.scanning.parts > 1 and not board.knows_no_parts
                yield from (frame for frame in frames if frame is not None)
                if not came:
                    yield None
        except ports.PortError as why:
            self._strangers = 0 if board.counts["scans"] else self._strangers + 1
            raise ports.PortError(board.lost(str(why))) from None
        finally:
            self._count(board, seen)

    def _now(self) -> float:
        return self.host.now_ns() * 1e-9

    def _waiting(self, port: ports.Port) -> bytes:
        """Returns everything that has come while this process stood still."""
        data = b""
        while len(data) < MOST_WAITING and (more := port.read(0.0)):
            data += more
        return data

    def _newest(
        self, scans: list[link.ScanFrame], board: BoardLink, stood_s: float, now_s: float
    ) -> list[link.ScanFrame]:
        """Returns the newest of the scans that waited while this process stood still: it alone goes on."""
        skipped = max(0, len(scans) - 1)
        if skipped:
            board.reasons[scans[-1].seq] = sorted({"gap", *board.reasons.get(scans[-1].seq, ())})
        self.counts["standstills"] += 1
        self.counts["skipped"] += skipped
        self.remarks.stood_still(stood_s, skipped, now_s)
        return scans[-1:]

    def newest(self) -> NewestValues | None:
        """Returns what collects a new connection's values, where they come in parts."""
        return None if self.scanning.order is None else NewestValues(self.scanning.order)

    def handed_on(
        self, scan: link.ScanFrame, board: BoardLink, read_ns: int, newest: NewestValues | None
    ) -> RawFrame | None:
        """Returns what goes on to preprocessing; None while values are missing."""
        if newest is not None and not newest.take(scan, "gap" in board.reasons.get(scan.seq, ())):
            return None
        frame = self.raw_frame(scan, board, read_ns)
        return frame if newest is None else newest.frame(frame, scan)

    def raw_frame(self, scan: link.ScanFrame, board: BoardLink, read_ns: int) -> RawFrame:
        """Returns the raw frame of a board's scan, with this host's stamps; `read_ns`: when its last byte was read."""
        scan_s = scan.duration_us * scan.parts * 1e-6
        middle_us = scan.device_us + scan.duration_us // 2
        unknown, sigma_ns = board.clock.unknown(middle_us), board.clock.sigma_ns(middle_us)
        reasons = list(board.reasons.get(scan.seq, ()))
        valid = not unknown and not {"clock", "frozen"} & set(reasons)
        if unknown or sigma_ns >= UNSETTLED_NS:
            add_reason(reasons, "clock")
        assert board.ident is not None
        return RawFrame(
            skin=self.name,
            scan=scan.seq,
            stamps={"sample": min(read_ns, board.clock.host_ns(middle_us)), "read": read_ns},
            sample_sigma_ns=sigma_ns,
            source="stub" if "stub" in board.ident.firmware.lower() else "board",
            valid=valid,
            reasons=reasons,
            valid_for_s=valid_for_s(scan_s),
            z=scan.z,
            status=scan.status,
            device_us=scan.device_us,
            config=scan.config,
            pattern=self.pattern_name,
            board=board.board,
        )

    def _trouble(self, problem: str) -> None:
        """Says what is the matter, once each time it changes."""
        if problem == self.problem or self.ending.is_set():
            return
        self.problem, now = problem, self._now()
        if now - self._logged.get(problem, -LOG_AGAIN_S) < LOG_AGAIN_S:
            return
        self._logged = {text: t for text, t in self._logged.items() if now - t < LOG_AGAIN_S} | {problem: now}
        if problem:
            log.warning("%s: %s", self.name, problem)
        else:
            log.info("%s: the board is running", self.name)

    def _count(self, board: BoardLink, seen: Counter[str]) -> None:
        """Adds what is new in the connection's counts to ours."""
        now = board.counts + Counter({f"line_{what}": n for what, n in board.decoder.counts.items() if what != "good"})
        if now != seen:
            self.counts += now - seen
            seen.clear()
            seen.update(now)
