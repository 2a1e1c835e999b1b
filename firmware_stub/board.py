"""The board's firmware: answers commands and scans. Bytes in, messages out, time as an argument."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol import link
from protocol.ad5940 import LEAST_RTIA_OHM, MOST_RTIA_OHM
from protocol.link import EventCode, NakReason, SelfTestFault
from protocol.scan_setting import ScanSettingError

from .analog import Analog
from .faults import Faults
from .field import Field

FIRMWARE = "eitskin-stub 1.0"
KEPT_CONFIGS = 8
CAPABILITIES = link.Capability.SWITCHES | link.Capability.SELF_TEST | link.Capability.VARIABLE_DFT
EVENT_PAUSE_S = 1.0  # the same event is reported at most that often


@dataclass(frozen=True)
class MeasuredScan:
    """A scan, or a part of one, that was measured, whether or not it reached the host. Times in seconds since the stub
    started.
    """

    seq: int  # of its message: a part has one too
    start: float
    end: float


class Board:
    """The state machine. It is scanning from START to STOP, a scan every `pair_s` of its setting times its list's
    length.

    speed: how many times faster than a real board it measures. crystal_ppm: how much too fast its clock runs.
    answers_time, knows_parts: whether its firmware knows TIME_ASK, and scans in parts. on_scan is called with each
    scan, or part of one, once it is measured.
    """

    def __init__(
        self,
        field: Field,
        analog: Analog,
        faults: Faults,
        *,
        electrodes: int = 16,
        speed: float = 1.0,
        crystal_ppm: float = 12.0,
        unique_id: bytes = b"eitskin-stub",
        answers_time: bool = True,
        knows_parts: bool = True,
        on_scan: Callable[[MeasuredScan], None] | None = None,
    ) -> None:
        self.field, self.analog, self.faults = field, analog, faults
        self.electrodes, self.speed, self.crystal_ppm, self.unique_id = electrodes, speed, crystal_ppm, unique_id
        self.answers_time, self.knows_parts, self.on_scan = answers_time, knows_parts, on_scan
        self.power_cycle(0.0)

    # --- life ---

    def power_cycle(self, now: float) -> None:
        """Begin again as after power came back: nothing is configured, the clock is at zero."""
        self.faults.power_cycled()
        self._decoder = link.Decoder()
        self._booted = now
        self._sent: dict[tuple[int, int], tuple[NDArray[np.complex64], NDArray[np.uint8]]] = {}
        """The last values of each configuration and part."""
        self._configs: dict[int, link.Config] = {}
        self._running: link.Config | None = None
        self._next: link.Config | None = None
        self._scan_start = now
        self._seq = self._part = 0
        self._reported: dict[EventCode, float] = {}
        self._out: list[tuple[float, bytes]] = []
        self._say(link.Event(EventCode.BOOT, f"{FIRMWARE} is up"), now)

    @property
    def scanning(self) -> bool:
        return self._running is not None

    @property
    def received(self) -> dict[str, int]:
        """What came from the host: counts of good and bad messages."""
        return dict(self._decoder.counts)

    def next_s(self) -> float:
        """When the scan under way ends; infinite while stopped."""
        return self._scan_start + self._duration(self._running) if self._running else math.inf

    # --- bytes in, messages out ---

    def feed(self, data: bytes, now: float) -> None:
        """Bytes from the host; the answers come out of the next `advance`."""
        if self.faults.active("hang", now) is not None:
            return
        before = self._decoder.bad
        for message in self._decoder.feed(data):
            self._obey(message, now)
        if self._decoder.bad > before:
            reason = NakReason.SCHEMA if self._decoder.peer_schema != link.SCHEMA_HASH else NakReason.UNKNOWN
            self._say(link.Nak(0, reason, self._decoder.last_error[: link.MAX_TEXT]), now)

    def advance(self, now: float) -> list[tuple[float, bytes]]:
        """What the board had to say by `now`: when, and the encoded message."""
        while self._running is not None and self.next_s() <= now:
            self._scan()
        out, self._out = self._out, []
        return out

    def skip_to(self, now: float) -> None:
        """Go on after the host machine slept, and count the scans that nobody measured."""
        if self._running is not None and (missed := int((now - self._scan_start) / self._duration(self._running))) > 0:
            self._seq += missed
            self._scan_start += missed * self._duration(self._running)

    # --- commands ---

    def _obey(self, message: link.Message, now: float) -> None:
        kind = type(message)
        if isinstance(message, link.Hello):
            self._say(
                link.Ident(
                    schema_hash=self._schema(now),
                    chip_id=self._chip_id(now),
                    unique_id=self.unique_id[:12].ljust(12, b"\0"),
                    capabilities=CAPABILITIES
                    | (link.Capability.TIME if self.answers_time else 0)
                    | (link.Capability.PARTS if self.knows_parts else 0),
                    electrodes=self.electrodes,
                    max_scan=link.MAX_SCAN,
                    firmware=FIRMWARE,
                ),
                now,
            )
        elif kind.sender != "host":
            self._refuse(message, NakReason.UNKNOWN, f"{kind.wire_name} is the board's to send", now)
        elif self.faults.active("wrong_schema", now) is not None:
            self._refuse(message, NakReason.SCHEMA, f"this firmware has schema {self._schema(now):08x}", now)
        elif isinstance(message, link.Config):
            self._configure(message, now)
        elif isinstance(message, link.Start):
            self._start(message, now)
        elif isinstance(message, link.Stop):
            self._running = self._next = None
            self._done(message, 0, now)
        elif isinstance(message, link.SelfTest):
            if self._running is not None:
                self._refuse(message, NakReason.BUSY, "scanning: STOP first", now)
            else:
                self._done(message, self._self_test(now), now)
        elif isinstance(message, link.TimeAsk):
            if self.answers_time:
                self._say(link.Time(message.nonce, self.device_us(now)), now)
            else:
                self._refuse(message, NakReason.UNKNOWN, "this firmware does not know TIME_ASK", now)

    def _configure(self, config: link.Config, now: float) -> None:
        wrong = _no_setting(config)
        if wrong:
            pass
        elif not LEAST_RTIA_OHM <= config.rtia_ohm <= MOST_RTIA_OHM:
            wrong = f"RTIA of {config.rtia_ohm:g} ohm: {LEAST_RTIA_OHM:g} to {MOST_RTIA_OHM:g}"
        elif config.scan.max() >= self.electrodes:
            wrong = f"electrode {config.scan.max()}: 0 to {self.electrodes - 1}"
        elif (config.scan[:, 0] == config.scan[:, 1]).any() or (config.scan[:, 2] == config.scan[:, 3]).any():
            wrong = "a measurement drives or senses one electrode against itself"
        elif config.parts not in (link.PARTS if self.knows_parts else (1,)) or len(config.scan) % config.parts:
            wrong = f"{config.parts} parts of {len(config.scan)} measurements: 1, 2, 4, 5 or 10 equal ones, where known"
        if wrong:
            self._refuse(config, NakReason.BAD_CONFIG, wrong, now)
            return
        self._configs.pop(config.config, None)
        self._configs[config.config] = config
        if len(self._configs) > KEPT_CONFIGS:
            self._configs.pop(next(iter(self._configs)))
        if self._running is not None and self._running.config == config.config:
            self._next = config
        self.faults.clear("brown_out")
        self._done(config, config.config, now)

    def _start(self, start: link.Start, now: float) -> None:
        config = self._configs.get(start.config)
        if config is None:
            known = ", ".join(map(str, self._configs)) or "none"
            self._refuse(start, NakReason.NOT_CONFIGURED, f"no configuration {start.config}; there are: {known}", now)
        elif self._chip_id(now) != link.CHIP_ID:
            text = f"chip id {self._chip_id(now):#06x}, expected {link.CHIP_ID:#06x}: power-cycle the board"
            self._refuse(start, NakReason.CHIP_ID, text, now)
        else:
            if self._running is None:
                self._running, self._seq, self._part, self._scan_start = config, 0, 0, now
            else:
                self._next = config
            self._done(start, start.config, now)

    def _self_test(self, now: float) -> int:
        def bad(*names: str) -> bool:
            return any(self.faults.active(name, now) is not None for name in names)

        result = 0
        if self._chip_id(now) != link.CHIP_ID:
            result |= SelfTestFault.CHIP_ID
        if bad("brown_out", "rtia_overrange"):
            result |= SelfTestFault.CALIBRATION
        if bad("mux_stuck", "mux_disabled"):
            result |= SelfTestFault.MULTIPLEXER
        if bad("fifo_overflow", "fifo_underflow", "fifo_misaligned", "missed_interrupt"):
            result |= SelfTestFault.FIFO
        if not result:
            self.faults.clear("stale_rtia")  # the self-test calibrates
        return int(result)

    # --- scanning ---

    def _duration(self, config: link.Config) -> float:
        """Seconds until the board sends something: of a scan, or of a part."""
        return len(config.scan) // config.parts * config.setting.pair_s / self.speed

    def _scan(self) -> None:
        config = self._running
        assert config is not None
        start, end = self._scan_start, self.next_s()
        seq, self._seq = self._seq, self._seq + 1 & 0xFFFFFFFF
        self._scan_start = end
        part, self._part = self._part, (self._part + 1) % config.parts
        if self._next is not None and not self._part:
            self._running, self._next = self._next, None
        if self._chip_id(start) != link.CHIP_ID:
            self._running = None
            self._event(EventCode.CHIP_ID, f"chip id {self._chip_id(start):#06x}: stopped", end)
            return
        scan = np.split(np.asarray(config.scan, np.int64), config.parts)[part]
        instants = np.asarray(start + (np.arange(len(scan)) + 0.5) * ((end - start) / len(scan)))
        transfer, weights = self.field.over(instants)
        z, status = self.analog.measure(transfer, scan, config.setting, config.rtia_ohm, start, weights, instants)
        if self.faults.active("frozen", start) is not None:
            z, status = self._sent.get((config.config, part), (z, status))
        self._sent[config.config, part] = z, status
        self._notice(start, end)
        self._send(seq, start, end, config, part, z, status)
        if self.on_scan is not None:
            self.on_scan(MeasuredScan(seq, start, end))

    def _send(
        self,
        seq: int,
        start: float,
        end: float,
        config: link.Config,
        part: int,
        z: NDArray[np.complex64],
        status: NDArray[np.uint8],
    ) -> None:
        gap = self.faults.active("sequence_gaps", start)
        if gap is not None and self.analog.rng.random() < gap["fraction"]:
            return
        duration_us = round((end - start) * 1e6)
        begun_us = self.device_us(start)
        frame = link.ScanFrame(seq, begun_us, duration_us, config.config, z, status, part, config.parts)
        self._say(frame, end)

    def device_us(self, t: float) -> int:
        """The microcontroller's clock at time t."""
        return max(0, round((t - self._booted) * 1e6 * (1 + self.crystal_ppm * 1e-6)))

    def jump(self, seconds: float) -> None:
        """The microcontroller's clock goes forward at once, or back."""
        self._booted -= seconds

    def _notice(self, start: float, end: float) -> None:
        """Report what the firmware can notice by itself."""
        for name, code in (
            ("brown_out", EventCode.BROWN_OUT),
            ("missed_interrupt", EventCode.MISSED_INTERRUPT),
            ("fifo_overflow", EventCode.FIFO_OVERFLOW),
            ("fifo_underflow", EventCode.FIFO_UNDERFLOW),
        ):
            if (fault := self.faults.active(name, start)) is not None and not fault["silent"]:
                self._event(code, name.replace("_", " "), end)

    # --- saying ---

    def _event(self, code: EventCode, text: str, now: float) -> None:
        if now - self._reported.get(code, -math.inf) >= EVENT_PAUSE_S:
            self._reported[code] = now
            self._say(link.Event(code, text), now)

    def _done(self, command: link.Message, value: int, now: float) -> None:
        self._say(link.Ack(command.number, value, self.device_us(now)), now)

    def _refuse(self, message: link.Message, reason: NakReason, text: str, now: float) -> None:
        self._say(link.Nak(message.number, reason, text), now)

    def _say(self, message: link.Message, now: float) -> None:
        if self.faults.active("hang", now) is None:
            self._out.append((now, link.encode(message, self._schema(now))))

    def _chip_id(self, now: float) -> int:
        wrong = self.faults.active("wrong_chip_id", now)
        return link.CHIP_ID if wrong is None else wrong["id"] & 0xFFFF

    def _schema(self, now: float) -> int:
        wrong = self.faults.active("wrong_schema", now)
        return link.SCHEMA_HASH if wrong is None else wrong["schema"] & 0xFFFFFFFF


def _no_setting(config: link.Config) -> str:
    """Why pairs cannot be measured so; "" where they can."""
    try:
        return "" if config.setting else ""
    except ScanSettingError as why:
        return str(why)
