"""Sources of raw frames: a board, a recording, an imported file, with one interface.

A source blocks for at most POLL_S at a time, and never raises for what its device or file does.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace

from models.bundle import Bundle
from models.measurement.tables import tells_touches
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
    return replace(scanning, parts=parts_on_line(len(bundle.pattern), parts_of(bundle), scanning.setting, baud))


@dataclass
class _Connection:
    """One connection to what is behind a port."""

    port: ports.Port
    board: BoardLink
    suspensions: Suspensions
    newest: NewestValues | None
    opened_s: float
    read_s: float  # when the port was read last
    whole: bool = False  # whether the board scans whole for now
    counted_s: float = 0.0
    counted: Counter[str] = field(default_factory=Counter)

    def is_stranger(self, must_be: str, now: float) -> bool:
        """Whether this is not the board `must_be`, or does not say in time which one it is."""
        late = now - self.opened_s > INTRODUCE_S
        return bool(must_be) and self.board.board != must_be and bool(self.board.board or late)


class BoardSource(Source):
    """A board behind a serial port. Opens, asks, configures, starts, and does so again whenever anything goes wrong."""

    def __init__(self, name: str, skin: Skin, bundle: Bundle, host: HostTime | None = None) -> None:
        super().__init__(name, skin, bundle)
        self.host = host or HostTime()
        self.remarks = Remarks()
        self._logged: dict[str, float] = {}  # what was logged lately, and when
        tells = tells_touches(bundle)  # a measured map gains nothing from when each value was measured
        order = rolling_order(bundle) if tells else None
        self.scanning = Scanning(bundle.pattern, skin.setting, skin.rtia_ohm, order=order)
        if tells and skin.scan == "rolling":
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
                if (yield from self._attempt(url, configured=n == 0)):
                    break
            yield from self._wait_to_reopen()

    def _attempt(self, url: str, configured: bool) -> Generator[RawFrame | None, None, bool]:
        """Yields the frames of what is at `url`; returns False where it cannot be opened, or is another board than ours
        and not `configured`.
        """
        try:
            self._port = self.open_port(url)
        except ports.PortError as why:
            self._trouble(str(why) if configured else self.problem)  # the configured name is the one to speak of
            self._strangers += self.skin.port.lower().startswith(NETWORK)
            return False
        try:
            return not (yield from self._frames_of(self._port, must_be="" if configured else self._board))
        except ports.PortError as why:
            self._trouble(str(why))
            self.counts["disconnects"] += 1
            return True
        finally:
            self.close()

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

    def _frames_of(self, port: ports.Port, must_be: str) -> Generator[RawFrame | None, None, bool]:
        """Yields a connection's frames until the port is gone (PortError), or turns out to be another board than
        `must_be` (returns True).
        """
        now = self._now()
        board = BoardLink(self.scanning, now, OtherEnd(port.url, self.skin.baud))
        connection = _Connection(port, board, Suspensions(self.host), self.newest(), opened_s=now, read_s=now)
        try:
            while True:
                now = self._now()
                data, stood_s = self._exchange(connection, now)
                read_ns = self.host.now_ns()
                connection.read_s = read_ns * 1e-9
                scans = board.received(data, connection.read_s) if data else []
                if connection.is_stranger(must_be, now):
                    return True
                self._recognise(connection)
                if stood_s > STOOD_STILL_S:
                    scans = self._newest(scans, board, stood_s, connection.read_s)
                frames = [self.handed_on(scan, board, read_ns, connection.newest) for scan in scans]
                self._report(connection, at_once=not scans)
                yield from (frame for frame in frames if frame is not None)
                if not scans:
                    yield None
        except ports.PortError as why:
            self._strangers = 0 if board.counts["scans"] else self._strangers + 1
            raise ports.PortError(board.lost(str(why))) from None
        finally:
            self._count(connection)

    def _exchange(self, connection: _Connection, now: float) -> tuple[bytes, float]:
        """Sends what is due. Returns what arrived, and for how long [s] nothing was read before it."""
        board, port = connection.board, connection.port
        if connection.whole != self.whole:
            connection.whole, connection.newest = self.whole, self.newest()
            board.scan_as(self.scanning.whole if connection.whole else self.scanning, now)
        wait_s = POLL_S if board.state == "running" else 0.02
        # After a standstill what waits is read first: the board was not silent, and not asked either.
        due = board.to_send(now) if now - connection.read_s < STOOD_STILL_S else b""
        if due:
            port.write(due)
        self.host.sleep(board.pause_s(self._now()))
        data = port.read(wait_s)
        stood_s = self._now() - connection.read_s
        if stood_s > STOOD_STILL_S:
            data += self._waiting(port)
        if connection.suspensions.happened():
            board.suspended(self._now())
        return data, stood_s

    def _recognise(self, connection: _Connection) -> None:
        """Keeps which board runs here, to find it under another name; says what is the matter with it."""
        board = connection.board
        if board.state == "running" and self._board != board.board:
            self._board, self._usb_serial = board.board, ports.usb_serial_number(connection.port.url)
        if board.problem or board.state == "running":  # until then what was the matter is
            self._trouble(board.problem)

    def _report(self, connection: _Connection, at_once: bool) -> None:
        """Brings counts and remarks up to date, every COUNT_EVERY_S where frames come."""
        if at_once or connection.read_s - connection.counted_s > COUNT_EVERY_S:
            connection.counted_s = connection.read_s
            self._count(connection)
            self.remarks.look(connection.board, connection.read_s, connection.whole)
            self.in_parts = self.scanning.parts > 1 and not connection.board.knows_no_parts

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
        """Returns what collects a new connection's values, where they come in an order of their own."""
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

    def _count(self, connection: _Connection) -> None:
        """Adds what is new in the connection's counts to ours."""
        board = connection.board
        now = board.counts + Counter({f"line_{what}": n for what, n in board.decoder.counts.items() if what != "good"})
        if now != connection.counted:
            self.counts += now - connection.counted
            connection.counted = now
