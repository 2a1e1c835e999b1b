"""The host's end of the board's link: HELLO, IDENT, check, CONFIG, START, scans, TIME. A state machine without I/O.

`received` takes bytes in, `to_send` gives bytes out; both are given the time. Nothing the board does, or fails to do,
raises.
"""

from __future__ import annotations

from collections import Counter

from protocol import link
from protocol.frames import STATUS_OPEN, STATUS_RTIA
from services.board.clock import GOOD_NS, DeviceClock
from services.board.line_pace import LinePace
from services.board.other_end import OtherEnd, printable
from services.board.scan_check import ScanCheck
from services.board.scanning import Scanning, unfit
from services.board.time_questions import TimeQuestions

HELLO_EVERY_S = 0.2
ANSWER_S = 0.5  # a command that is not answered in this time is sent again
TRIES = 3  # then everything starts from HELLO
SILENT_S = 1.0  # a running board that sends nothing for so long is asked again
EXPLAIN_AFTER_S = 1.5  # of unanswered HELLOs
DEAD_SCANS = 10  # in a row with all measurements out of range: the board may have lost its registers
DEAD_AGAIN_S = 5.0  # then it is configured again, at most this often
REFUSED_AGAIN_S = 1.0  # a refused board is tried again, for it may be power-cycled or flashed
NO_CURRENT = STATUS_OPEN | STATUS_RTIA


class BoardLink:
    """One connection. `state` is hello, config, start, running or refused. `scanning`: what the board scans; whole
    where its firmware knows no parts. other_end: what names it where it is no board.

    `clock` maps the board's time to this host's. It begins anew only where START and its answer say so.
    """

    def __init__(self, scanning: Scanning, now_s: float, other_end: OtherEnd | None = None) -> None:
        self.scanning = scanning
        self._other_end = other_end or OtherEnd()
        self.knows_no_parts = False  # and so scans whole, although parts were wanted
        self.decoder = link.Decoder()
        self.clock = DeviceClock()
        self._check = ScanCheck(self.clock)
        self.reasons = self._check.reasons  # of the scans received last, by number: gap, clock, frozen
        self._questions = TimeQuestions()
        self._newest_us = 0  # newest time of the board's clock
        self._start_s: float | None = None  # when START was sent first in this state
        self._pace = LinePace(now_s)
        self.ident: link.Ident | None = None
        self.problem = ""  # what stands in the way, for a person; "" when all is well
        self.counts: Counter[str] = Counter()  # scans, missing, repeated, foreign, events, restarts, garbled
        self.state, self._since, self._due_s, self._tries = "hello", now_s, now_s, 0
        self._received_s = self._hello_since_s = now_s
        self._dead_scans, self._dead_s = 0, -DEAD_AGAIN_S

    @property
    def board(self) -> str:
        """The board's unique id, hexadecimal; "" until it has introduced itself."""
        return self.ident.unique_id.hex() if self.ident else ""

    @property
    def clock_unknown(self) -> bool:
        """Whether it is not known how old the board's scans are."""
        return self.clock.unknown(self._newest_us)

    @property
    def frozen(self) -> bool:
        """Whether the board sends the same scan again and again."""
        return self._check.frozen

    def received(self, data: bytes, now_s: float) -> list[link.ScanFrame]:
        """Returns the scans that `data` completes, in order; all other messages are dealt with here."""
        scans = []
        waited, bad = self.decoder.waiting, self.decoder.bad
        messages = self.decoder.feed(data)
        if self.state == "hello":
            self._other_end.receive(data, messages)
        dropped, waits = self.decoder.bad > bad, self.decoder.waiting
        began_s = self._pace.first_byte_s(now_s, waited=waited, dropped=dropped, complete=bool(messages), waits=waits)
        self.reasons.clear()
        for n, message in enumerate(messages):
            if isinstance(message, link.ScanFrame):
                first_byte_s = began_s if n == 0 else now_s
                self._pace.received(now_s - first_byte_s)
                if self._is_ours(message, first_byte_s, now_s):
                    self._received_s = now_s
                    scans.append(message)
                    self._watch(message, now_s)
            elif isinstance(message, link.Ident):
                self._introduced(message, now_s)
            elif isinstance(message, link.Ack):
                self._acknowledged(message, now_s)
            elif isinstance(message, link.Nak):
                self._not_accepted(message, now_s)
            elif isinstance(message, link.Event):
                self._happened(message, now_s)
            elif isinstance(message, link.Time):
                self._answered_time(message, now_s)
        return scans

    def pause_s(self, now_s: float) -> float:
        """Returns for how many seconds the next byte is not worth waking up for."""
        return self._pace.pause_s(now_s) if self.state == "running" and self.decoder.waiting else 0.0

    def to_send(self, now_s: float) -> bytes:
        """Returns the bytes that are due now."""
        if self.state == "running":
            if now_s - self._received_s <= SILENT_S:
                return self._asking(now_s)
            self._restart(now_s, f"the board went silent for {SILENT_S:g} s: asking it again")
        if self.state == "refused" and now_s - self._since >= REFUSED_AGAIN_S:
            self._to(now_s, "hello")
        if self.state == "refused" or now_s < self._due_s:
            return b""
        if self.state != "hello":
            return self._command(now_s)
        self._due_s = now_s + HELLO_EVERY_S
        if now_s - self._hello_since_s > EXPLAIN_AFTER_S:
            self.problem = self._other_end.sentence()
        return link.encode(link.Hello(schema_hash=link.SCHEMA_HASH))

    def _command(self, now_s: float) -> bytes:
        """Returns CONFIG or START, as the state is; after TRIES without an answer everything starts anew."""
        self._tries += 1
        if self._tries > TRIES:
            self._restart(now_s, f"the board does not answer {self.state.upper()}: asking it again")
            return b""
        self._due_s = now_s + ANSWER_S
        s = self.scanning
        if self.state == "start":
            self._start_s = now_s if self._start_s is None else self._start_s
            return link.encode(link.Start(config=s.config))
        rows = s.scan_list.astype("u1")
        return link.encode(link.Config.of(s.setting, config=s.config, rtia_ohm=s.rtia_ohm, scan=rows, parts=s.parts))

    def scan_as(self, scanning: Scanning, now_s: float) -> None:
        """What the board is to scan from now on. One that runs is configured anew, and goes on after some messages."""
        if self.knows_no_parts or scanning.config == self.scanning.config:
            return
        self.scanning = scanning
        if self.state in ("start", "running"):
            self._to(now_s, "config")

    def lost(self, why: str) -> str:
        """What stands in the way once the port is gone for this reason: of no board, what was there instead."""
        return self._other_end.closed(why) if self.ident is None else why

    def suspended(self, now_s: float) -> None:
        """This machine was suspended, and its clock with it, while the board's went on."""
        self.clock.reset()
        self._restart(now_s, "this machine was suspended: asking the board again")

    def _asking(self, now_s: float) -> bytes:
        """Returns a TIME_ASK where one is due."""
        if not self.clock.timed:
            return b""
        width_ns = self.clock.width_ns(self._newest_us)
        return self._questions.to_send(now_s, width_ns is not None and width_ns < GOOD_NS, self.decoder.waiting)

    def _answered_time(self, answer: link.Time, now_s: float) -> None:
        sent_s = self._questions.sent_s(answer)
        if sent_s is None or self.state != "running":
            return
        self._newest_us = max(self._newest_us, answer.device_us)
        if not self.clock.answered(_ns(sent_s), answer.device_us, _ns(now_s)):
            self._clock_jumped(now_s)

    def _clock_jumped(self, now_s: float) -> None:
        self.counts["clock_jumps"] += 1
        self._check.doubt()
        self._restart(now_s, "the board's clock jumped, or runs wrong by more than 1 ms/s: asking it again")

    def _to(self, now_s: float, state: str) -> None:
        self.state, self._since, self._due_s, self._tries = state, now_s, now_s, 0
        self._received_s, self._start_s = now_s, None
        if state == "hello":
            self._hello_since_s = now_s
            self._other_end = OtherEnd(self._other_end.url, self._other_end.baud)

    def _restart(self, now_s: float, why: str) -> None:
        self.counts["restarts"] += 1
        self.problem = why
        self._to(now_s, "hello")

    def _introduced(self, ident: link.Ident, now_s: float) -> None:
        self.ident = ident
        self.clock.timed = bool(ident.capabilities & link.Capability.TIME)
        if not ident.capabilities & link.Capability.PARTS:
            self.knows_no_parts = self.knows_no_parts or self.scanning.parts > 1
            self.scanning = self.scanning.whole
        if wrong := unfit(ident, self.scanning):
            self._refuse(wrong, now_s)
        elif self.state in ("hello", "refused"):
            self._to(now_s, "config")

    def _acknowledged(self, ack: link.Ack, now_s: float) -> None:
        if self.state == "config" and ack.of == link.Config.number:
            if ack.value == self.scanning.config:  # else a late answer to the one before
                self._to(now_s, "start")
        elif ack.of == link.Start.number and ack.value not in (0, self.scanning.config):  # 0: the board does not say
            return  # a late answer to another one
        elif self.state == "start" and ack.of == link.Start.number:
            self.problem = ""
            self._begin(ack, self._start_s, now_s)
            self._to(now_s, "running")
        elif self.state == "running" and ack.of == link.Start.number:
            self._check.started(ack.device_us)  # a START sent twice: scans count from 0 again

    def _begin(self, ack: link.Ack, sent_s: float | None, now_s: float) -> None:
        """START was carried out: what comes now is from after it, and its answer says what the board's clock shows."""
        self._check.started(ack.device_us)
        self._questions.begin(now_s)
        self._newest_us = ack.device_us
        if ack.device_us and sent_s is not None:
            self.clock.started(_ns(sent_s), ack.device_us, _ns(now_s))
        else:
            self.clock.reset()

    def _not_accepted(self, nak: link.Nak, now_s: float) -> None:
        """A NAK of nothing in particular answers noise on the line towards the board: our command is sent again anyway.
        Only a board of another schema cannot say what it refuses.
        """
        if nak.of == 0 and nak.reason != link.NakReason.SCHEMA:
            self.counts["garbled"] += 1
            return
        self._refuse(f"the board refuses: {printable(nak.text) or _reason(nak.reason)}", now_s)

    def _refuse(self, why: str, now_s: float) -> None:
        self.problem = why
        self._to(now_s, "refused")

    def _happened(self, event: link.Event, now_s: float) -> None:
        self.counts["events"] += 1
        if event.code in (link.EventCode.BOOT, link.EventCode.BROWN_OUT):
            self._restart(
                now_s, f"the board lost its configuration ({printable(event.text) or link.EventCode(event.code).name})"
            )

    def _watch(self, scan: link.ScanFrame, now_s: float) -> None:
        """Looks for a brown-out that lost the registers without a word: then no measurement has a current."""
        self._dead_scans = self._dead_scans + 1 if (scan.status & NO_CURRENT).all() else 0
        if self._dead_scans >= DEAD_SCANS * scan.parts and now_s - self._dead_s >= DEAD_AGAIN_S:
            self._dead_scans, self._dead_s = 0, now_s
            self._restart(
                now_s, "no current through any electrode: configuring the board again; is the skin connected?"
            )

    def _is_ours(self, scan: link.ScanFrame, first_byte_s: float, now_s: float) -> bool:
        """Returns whether this is to be believed as the board's next scan; counts what it is otherwise."""
        if self.state != "running" or not self.scanning.sent(scan):
            self.counts["foreign"] += 1
            return False
        # The first byte leaves as the scan ends; the last one as much later as the line is slow.
        what = self._check(scan, _ns(first_byte_s), fit=scan.part == scan.parts - 1)
        self.counts[what] += 1
        if self._check.jumped:
            self._clock_jumped(now_s)
        if what != "scans":
            return False
        self._newest_us = max(self._newest_us, scan.device_us + scan.duration_us)
        self.counts["missing"] += self._check.missing
        self.counts["frozen"] += self._check.frozen
        return True


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)


def _reason(number: int) -> str:
    """Returns a NAK's reason by name; a newer firmware may have others."""
    try:
        return link.NakReason(number).name
    except ValueError:
        return f"reason {number}"
