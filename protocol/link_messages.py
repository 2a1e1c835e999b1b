"""The messages of the board's link: their numbers, fields and layout.

A body is the message's number and its fields, packed, little-endian. link.py puts bodies on the line and takes them
off it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from .errors import EitskinError
from .scan_setting import COHERENT, WINDOWS, ScanSetting

LINK_VERSION = 1
MAX_SCAN = 512
"""Most measurements in a scan list."""
PARTS = (1, 2, 4, 5, 10)
"""Into how many equal parts a scan may be sent."""
MAX_BODY = 8192
"""Longest body with its CRC, in bytes; a receiver drops what is longer."""
MAX_TEXT = 200
"""Longest text in a message, in UTF-8 bytes; a longer one is cut."""
CHIP_ID = 0x5502
"""What a healthy AD5940 says it is."""


class LinkError(EitskinError, ValueError):
    """A message's fields cannot be sent, or do not fit their message: says which, what was found, what is allowed."""


class Capability(IntFlag):
    """Bits of Ident.capabilities."""

    SWITCHES = 1
    SELF_TEST = 2
    VARIABLE_DFT = 4
    TIME = 8
    PARTS = 16


class NakReason(IntEnum):
    """Why a command was refused."""

    UNKNOWN = 1
    SCHEMA = 2
    BAD_CONFIG = 3
    NOT_CONFIGURED = 4
    BUSY = 5
    CHIP_ID = 6
    CALIBRATION = 7


class EventCode(IntEnum):
    """What the board reports unasked."""

    BOOT = 1
    BROWN_OUT = 2
    CHIP_ID = 3
    FIFO_OVERFLOW = 4
    FIFO_UNDERFLOW = 5
    MISSED_INTERRUPT = 6
    CALIBRATION = 7
    MULTIPLEXER = 8
    OVERRUN = 9


class SelfTestFault(IntFlag):
    """Bits of the value in the ACK to SELF_TEST: what failed; 0 when all is well."""

    CHIP_ID = 1
    CALIBRATION = 2
    MULTIPLEXER = 4
    FIFO = 8


STRUCT_CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "f32": "f", "12 bytes": "12s"}


def _wired(kind: str, doc: str, default: Any = ...) -> Any:
    """A field with its kind on the wire and its one line of documentation."""
    metadata = {"kind": kind, "doc": doc}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


@dataclass(frozen=True, eq=False)
class Message:
    """Base: the fields of a fixed size are sent first; what has no fixed size is packed by `_tail` and read by
    `_read_tail`.
    """

    number: ClassVar[int]
    sender: ClassVar[str]
    plain_crc: ClassVar[bool] = False
    wire_name: ClassVar[str]
    """What the schema and WIRE.md call it: the class's name where the class does not say otherwise."""

    def __init_subclass__(cls) -> None:
        cls.wire_name = vars(cls).get("wire_name", cls.__name__)

    @classmethod
    def layout(cls) -> list[tuple[str, str, str]]:
        """(name, kind, what it is) of each field, in the order sent."""
        of = [(n, f.metadata["kind"], f.metadata["doc"]) for n, f in cls.__dataclass_fields__.items() if f.metadata]
        return sorted(of, key=lambda each: each[1] not in STRUCT_CODES)

    @classmethod
    def _head(cls) -> tuple[list[str], struct.Struct]:
        fixed = [(n, STRUCT_CODES[k]) for n, k, _ in cls.layout() if k in STRUCT_CODES]
        return [n for n, _ in fixed], struct.Struct("<" + "".join(c for _, c in fixed))

    def _tail(self) -> bytes:
        return b""

    @classmethod
    def _read_tail(cls, rest: bytes) -> dict[str, Any]:
        if rest:
            raise LinkError(f"{len(rest)} bytes left over")
        return {}

    def body(self) -> bytes:
        """Number and fields. Raises LinkError where a field does not fit its place."""
        names, head = HEADS[type(self)]
        try:
            return bytes([self.number]) + head.pack(*(getattr(self, n) for n in names)) + self._tail()
        except (struct.error, TypeError, ValueError, OverflowError) as bad:
            raise LinkError(f"{self.wire_name} cannot be sent: {bad}") from None

    @classmethod
    def read(cls, body: bytes) -> Message:
        """The message in `body`. Raises LinkError."""
        names, head = HEADS[cls]
        if len(body) < 1 + head.size:
            raise LinkError(f"{cls.wire_name}: found {len(body)} bytes, expected at least {1 + head.size}")
        try:
            tail = cls._read_tail(body[1 + head.size :])
        except LinkError as bad:
            raise LinkError(f"{cls.wire_name}: {bad}") from None
        return cls(**dict(zip(names, head.unpack_from(body, 1), strict=True)), **tail)


class _WithText(Message):
    """A message that ends in text."""

    text_field: ClassVar[str] = "text"

    def _tail(self) -> bytes:
        return str(getattr(self, self.text_field)).encode()[:MAX_TEXT]

    @classmethod
    def _read_tail(cls, rest: bytes) -> dict[str, Any]:
        if len(rest) > MAX_TEXT:
            raise LinkError(f"found {len(rest)} bytes of text, expected at most {MAX_TEXT}")
        return {cls.text_field: rest.decode(errors="replace")}


@dataclass(frozen=True, eq=False)
class Hello(Message):
    """Who is there? A board answers it in any state, with IDENT."""

    number, sender, plain_crc = 0x01, "host", True
    link_version: int = _wired("u8", "version of this framing", LINK_VERSION)
    schema_hash: int = _wired("u32", "CRC-32 of the sender's schema text", 0)


@dataclass(frozen=True, eq=False)
class Config(Message):
    """A configuration to keep under its id; a board holds at least 4. ACK value: the id."""

    number, sender = 0x02, "host"
    config: int = _wired("u16", "id, chosen by the host")
    dft_points: int = _wired("u16", "points of each DFT: 4, 8 ... 16384; samples of a fit: 8 ... 128")
    rtia_ohm: float = _wired("f32", "gain resistor of the current measurement [ohm]")
    scan: NDArray[np.uint8] = _wired(
        "n u16, n x 4 u8", "electrodes drive+, drive-, sense+, sense- of each measurement, from 0"
    )
    parts: int = _wired("u8", "equal parts of the list, a FRAME each; over 1 only with PARTS", 1)
    frequency_hz: int = _wired("u32", "of the excitation [Hz]: 1000 to 80000", COHERENT.frequency_hz)
    sinc3: int = _wired(
        "u8", "1: raw samples; 2, 4, 5: the sinc3 filter before, one of so many samples", COHERENT.sinc3
    )
    window: int = _wired(
        "u8",
        "0: none; 1: Hanning; 2: no DFT, a fit of sine, cosine, constant and exponential to `dft_points` samples",
        WINDOWS.index(COHERENT.window),
    )
    settle_us: int = _wired(
        "u16",
        "settling before the voltage is measured, and again before the current [us]",
        round(COHERENT.settle_s * 1e6),
    )

    @cached_property
    def setting(self) -> ScanSetting:
        """How each pair is measured. Raises ScanSettingError where no board can do that."""
        window = WINDOWS[self.window] if self.window < len(WINDOWS) else f"of number {self.window}"
        return ScanSetting(
            self.frequency_hz, self.dft_points, cast(Any, self.sinc3), cast(Any, window), self.settle_us / 1e6
        )

    @classmethod
    def of(
        cls, setting: ScanSetting, *, config: int, rtia_ohm: float, scan: NDArray[np.uint8], parts: int = 1
    ) -> Config:
        """The configuration that has each pair of `scan` measured so."""
        return cls(
            config=config,
            dft_points=setting.points,
            rtia_ohm=rtia_ohm,
            scan=scan,
            parts=parts,
            frequency_hz=setting.frequency_hz,
            sinc3=setting.sinc3,
            window=WINDOWS.index(setting.window),
            settle_us=round(setting.settle_s * 1e6),
        )

    def _tail(self) -> bytes:
        scan = np.asarray(self.scan)
        if scan.ndim != 2 or scan.shape[1] != 4 or not 0 < len(scan) <= MAX_SCAN:
            raise LinkError(f"scan has shape {scan.shape}, expected (1..{MAX_SCAN}, 4)")
        if scan.min() < 0 or scan.max() > 255:
            raise LinkError(f"electrodes {scan.min()}..{scan.max()}, expected 0..255")
        return struct.pack("<H", len(scan)) + scan.astype("u1").tobytes()

    @classmethod
    def _read_tail(cls, rest: bytes) -> dict[str, Any]:
        n = _count(rest)
        if len(rest) != 2 + 4 * n:
            raise LinkError(f"found {len(rest)} bytes of scan list, expected {2 + 4 * n} for n = {n}")
        return {"scan": np.frombuffer(rest, "u1", offset=2).reshape(n, 4)}


@dataclass(frozen=True, eq=False)
class Start(Message):
    """Scan a configuration over and over, or change over to it after the scan under way. ACK value: its id."""

    number, sender = 0x03, "host"
    config: int = _wired("u16", "id of the configuration")


@dataclass(frozen=True, eq=False)
class Stop(Message):
    """Stop scanning."""

    number, sender = 0x04, "host"


@dataclass(frozen=True, eq=False)
class SelfTest(Message):
    """Check the chip, calibrate RTIA against RCAL, try the multiplexers. Only while stopped. ACK value: what failed."""

    number, sender = 0x05, "host"


@dataclass(frozen=True, eq=False)
class TimeAsk(Message):
    """What does your clock say? In any state; only of a board with the capability TIME. Answered by TIME."""

    number, sender = 0x06, "host"
    nonce: int = _wired("u32", "any number, another one each time: the answer repeats it")


@dataclass(frozen=True, eq=False)
class Ident(_WithText):
    """The answer to HELLO."""

    number, sender, plain_crc, text_field = 0x81, "board", True, "firmware"
    link_version: int = _wired("u8", "version of this framing", LINK_VERSION)
    schema_hash: int = _wired("u32", "CRC-32 of the firmware's schema text", 0)
    chip_id: int = _wired("u16", "the AD5940's CHIPID register: 0x5502", CHIP_ID)
    unique_id: bytes = _wired("12 bytes", "the microcontroller's unique id", bytes(12))
    capabilities: int = _wired("u32", "bits, see Capability", 0)
    electrodes: int = _wired("u8", "how many it has", 16)
    max_scan: int = _wired("u16", "longest scan list it takes", MAX_SCAN)
    firmware: str = _wired("text", "name and version of the firmware", "")


@dataclass(frozen=True, eq=False)
class Ack(Message):
    """A command was carried out."""

    number, sender = 0x82, "board"
    of: int = _wired("u8", "number of the command's message")
    value: int = _wired("u32", "the command's result, see there", 0)
    device_us: int = _wired("u64", "the microcontroller's clock when it was carried out [us]; 0: it cannot say", 0)


@dataclass(frozen=True, eq=False)
class Nak(_WithText):
    """A command was refused, or not understood (then `of` is the number it seemed to have, or 0)."""

    number, sender, plain_crc = 0x83, "board", True
    of: int = _wired("u8", "number of the command's message")
    reason: int = _wired("u8", "see NakReason")
    text: str = _wired("text", "why, for a person", "")


@dataclass(frozen=True, eq=False)
class ScanFrame(Message):
    """One scan, or one part of a scan in parts."""

    number, sender, wire_name = 0x84, "board", "Frame"
    seq: int = _wired("u32", "counts FRAMEs since START, also those that could not be sent; wraps to 0")
    device_us: int = _wired("u64", "the microcontroller's clock at the start of this scan or part [us]")
    duration_us: int = _wired("u32", "how long this scan or part took [us]")
    config: int = _wired("u16", "id of the configuration that was scanned")
    z: NDArray[np.complex64] = _wired("n u16, n x (re, im f32)", "impedance of each measurement [ohm]")
    status: NDArray[np.uint8] = _wired(
        "ceil(n/2) u8",
        "4 bits a measurement, the first in the low half: 1 clipped, 2 open, 4 RTIA overrange, 8 FIFO or missed",
    )
    part: int = _wired("u8", "which part of the list this is, from 0", 0)
    parts: int = _wired("u8", "of how many; 1: a whole scan", 1)

    def _tail(self) -> bytes:
        z, status = np.ascontiguousarray(self.z, "<c8"), np.asarray(self.status)
        if z.ndim != 1 or z.shape != status.shape or not 0 < len(z) <= MAX_SCAN:
            raise LinkError(f"z has shape {z.shape}, status {status.shape}, expected (n,) twice, n 1..{MAX_SCAN}")
        nibbles = np.zeros(len(z) + len(z) % 2, "u1")
        nibbles[: len(z)] = status & 15
        packed = bytes(nibbles[0::2] | nibbles[1::2] << 4)
        return struct.pack("<H", len(z)) + bytes(z) + packed

    @classmethod
    def _read_tail(cls, rest: bytes) -> dict[str, Any]:
        n = _count(rest)
        size = 2 + 8 * n + (n + 1) // 2
        if len(rest) != size:
            raise LinkError(f"found {len(rest)} bytes of values, expected {size} for n = {n}")
        packed = np.frombuffer(rest, "u1", offset=2 + 8 * n)
        status = np.stack([packed & 15, packed >> 4], axis=1).reshape(-1)[:n]
        return {"z": np.frombuffer(rest, "<c8", n, 2).copy(), "status": status}


@dataclass(frozen=True, eq=False)
class Event(_WithText):
    """Something happened."""

    number, sender = 0x85, "board"
    code: int = _wired("u16", "see EventCode")
    text: str = _wired("text", "what, for a person", "")


@dataclass(frozen=True, eq=False)
class Time(Message):
    """The answer to TIME_ASK."""

    number, sender = 0x86, "board"
    nonce: int = _wired("u32", "that of the question")
    device_us: int = _wired("u64", "the microcontroller's clock between the question's arrival and this answer [us]")


MESSAGES: tuple[type[Message], ...] = (
    Hello, Config, Start, Stop, SelfTest, TimeAsk, Ident, Ack, Nak, ScanFrame, Event, Time,
)  # fmt: skip
BY_NUMBER = {m.number: m for m in MESSAGES}
HEADS = {m: m._head() for m in MESSAGES}
SCHEMA_TEXT = "".join(
    f"{m.number:02x} {m.wire_name}: {'; '.join(f'{name} {kind}' for name, kind, _ in m.layout())}\n" for m in MESSAGES
)
"""One line a message: what both ends must agree on."""
SCHEMA_HASH = zlib.crc32(SCHEMA_TEXT.encode())


def _count(rest: bytes) -> int:
    n = int.from_bytes(rest[:2], "little")
    if len(rest) < 2 or not 0 < n <= MAX_SCAN:
        raise LinkError(f"found n = {n}, expected 1..{MAX_SCAN}")
    return n
