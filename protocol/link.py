"""The board's link: what goes over the serial line, in both directions.

On the line: 0x00, COBS(body, CRC-32 of the body), 0x00. The body is the message's number and its fields, packed, little-endian.
HELLO, IDENT and NAK carry the plain CRC-32; all others one that starts from the hash of SCHEMA_TEXT, so that a firmware with
other messages is known by the hash in its IDENT, refused by name, and never misread.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .cobs import cobs_decode, cobs_encode

LINK_VERSION = 1
MAX_SCAN = 512
"""Most measurements in a scan list."""
MAX_BODY = 8192
"""Longest body with its CRC, in bytes; a receiver drops what is longer."""
MAX_TEXT = 200
"""Longest text in a message, in UTF-8 bytes; a longer one is cut."""
CHIP_ID = 0x5502
"""What a healthy AD5940 says it is."""


class LinkError(ValueError):
    """A message's fields cannot be sent, or do not fit their message: says which, what was found and what is allowed."""


class Capability(IntFlag):
    """Bits of Ident.capabilities."""

    SENTINEL = 1
    SELF_TEST = 2
    VARIABLE_DFT = 4


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
    metadata = {"kind": kind, "doc": doc}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


@dataclass(frozen=True, eq=False)
class Message:
    """Base: the fields of a fixed size come first; what has no fixed size is packed by `_tail` and read by `_read_tail`."""

    number: ClassVar[int]
    sender: ClassVar[str]
    plain_crc: ClassVar[bool] = False

    @classmethod
    def layout(cls) -> list[tuple[str, str, str]]:
        """(name, kind, what it is) of each field, in the order sent."""
        return [(n, f.metadata["kind"], f.metadata["doc"]) for n, f in cls.__dataclass_fields__.items() if f.metadata]

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
            raise LinkError(f"{type(self).__name__} cannot be sent: {bad}") from None

    @classmethod
    def read(cls, body: bytes) -> Message:
        """The message in `body`. Raises LinkError."""
        names, head = HEADS[cls]
        if len(body) < 1 + head.size:
            raise LinkError(f"{cls.__name__}: found {len(body)} bytes, expected at least {1 + head.size}")
        try:
            tail = cls._read_tail(body[1 + head.size :])
        except LinkError as bad:
            raise LinkError(f"{cls.__name__}: {bad}") from None
        return cls(**dict(zip(names, head.unpack_from(body, 1), strict=True)), **tail)


class _WithText(Message):
    """A message that ends in text."""

    text_field: ClassVar[str] = "text"

    def _tail(self) -> bytes:
        text: str = getattr(self, self.text_field)
        return text.encode()[:MAX_TEXT]

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
    dft_points: int = _wired("u16", "points of each DFT: 4, 8 ... 16384")
    rtia_ohm: float = _wired("f32", "gain resistor of the current measurement [ohm]")
    scan: NDArray[np.uint8] = _wired(
        "n u16, n x 4 u8", "electrodes drive+, drive-, sense+, sense- of each measurement, from 0"
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
    """Scan a configuration over and over; while running: change over to it after the scan under way."""

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


@dataclass(frozen=True, eq=False)
class Nak(_WithText):
    """A command was refused, or not understood (then `of` is the number it seemed to have, or 0)."""

    number, sender, plain_crc = 0x83, "board", True
    of: int = _wired("u8", "number of the command's message")
    reason: int = _wired("u8", "see NakReason")
    text: str = _wired("text", "why, for a person", "")


@dataclass(frozen=True, eq=False)
class Frame(Message):
    """One scan."""

    number, sender = 0x84, "board"
    seq: int = _wired("u32", "counts scans since START, also those that could not be sent; wraps to 0")
    device_us: int = _wired("u64", "the microcontroller's clock at the start of the scan [us]")
    duration_us: int = _wired("u32", "how long the scan took [us]")
    config: int = _wired("u16", "id of the configuration that was scanned")
    z: NDArray[np.complex64] = _wired("n u16, n x (re, im f32)", "impedance of each measurement [ohm]")
    status: NDArray[np.uint8] = _wired(
        "ceil(n/2) u8",
        "4 bits a measurement, the first in the low half: 1 clipped, 2 open, 4 RTIA overrange, 8 FIFO or missed",
    )

    def _tail(self) -> bytes:
        z, status = np.ascontiguousarray(self.z, "<c8"), np.asarray(self.status)
        if z.ndim != 1 or z.shape != status.shape or not 0 < len(z) <= MAX_SCAN:
            raise LinkError(f"z has shape {z.shape}, status {status.shape}, expected (n,) twice, n 1..{MAX_SCAN}")
        nibbles = np.zeros(len(z) + len(z) % 2, "u1")
        nibbles[: len(z)] = status & 15
        return struct.pack("<H", len(z)) + z.tobytes() + (nibbles[0::2] | nibbles[1::2] << 4).tobytes()

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


MESSAGES: tuple[type[Message], ...] = (Hello, Config, Start, Stop, SelfTest, Ident, Ack, Nak, Frame, Event)
BY_NUMBER = {m.number: m for m in MESSAGES}
HEADS = {m: m._head() for m in MESSAGES}
SCHEMA_TEXT = "".join(
    f"{m.number:02x} {m.__name__}: {'; '.join(f'{name} {kind}' for name, kind, _ in m.layout())}\n" for m in MESSAGES
)
"""One line a message: what both ends must agree on."""
SCHEMA_HASH = zlib.crc32(SCHEMA_TEXT.encode())


def encode(message: Message, schema_hash: int = SCHEMA_HASH) -> bytes:
    """The bytes for the line, delimiters included. Raises LinkError where a field does not fit its place."""
    body = message.body()
    crc = zlib.crc32(body, 0 if message.plain_crc else schema_hash)
    return b"\0" + cobs_encode(body + struct.pack("<I", crc)) + b"\0"


class Decoder:
    """Turns the line's bytes into messages, whatever else is on the line.

    `counts`: `good`, and what was dropped: `bad_cobs`, `bad_crc`, `oversize`, `unknown` (no such message), `bad_payload` (fields
    do not fit), `other_schema` (intact, but from the firmware whose IDENT stated another schema hash). `last_error` says more.
    """

    def __init__(self, schema_hash: int = SCHEMA_HASH) -> None:
        self.schema_hash = schema_hash
        self.peer_schema = schema_hash
        """The hash that the other end's HELLO or IDENT stated."""
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self._rest = b""
        self._skipping = False

    @property
    def bad(self) -> int:
        """How many pieces were dropped."""
        return sum(n for what, n in self.counts.items() if what != "good")

    def feed(self, data: bytes) -> list[Message]:
        """The messages that `data` completes."""
        *pieces, self._rest = (self._rest + data).split(b"\0")
        messages = []
        for piece in pieces:
            if self._skipping:
                self._skipping = False
            elif piece and (message := self._read(piece)):
                messages.append(message)
        if len(self._rest) > MAX_BODY + MAX_BODY // 254 + 1:
            if not self._skipping:
                self._drop("oversize", f"more than {MAX_BODY} bytes without a delimiter")
            self._skipping, self._rest = True, b""
        return messages

    def _read(self, piece: bytes) -> Message | None:
        if len(piece) > MAX_BODY + MAX_BODY // 254 + 1:
            return self._drop("oversize", f"found {len(piece)} bytes, expected at most {MAX_BODY}")
        try:
            checked = cobs_decode(piece)
        except ValueError as bad:
            return self._drop("bad_cobs", str(bad))
        if len(checked) < 5:
            return self._drop("bad_crc", f"found {len(checked)} bytes, expected at least 5")
        body, crc = checked[:-4], int.from_bytes(checked[-4:], "little")
        kind = BY_NUMBER.get(body[0])
        if zlib.crc32(body, 0 if kind and kind.plain_crc else self.schema_hash) != crc:
            if self.peer_schema != self.schema_hash and zlib.crc32(body, self.peer_schema) == crc:
                return self._drop(
                    "other_schema",
                    f"the other end has schema {self.peer_schema:08x}, expected {self.schema_hash:08x}: flash a matching firmware",
                )
            return self._drop("bad_crc", f"CRC of a message {body[0]:#04x} of {len(body)} bytes does not match")
        if kind is None:
            return self._drop("unknown", f"no message has number {body[0]:#04x}")
        try:
            message = kind.read(body)
        except LinkError as bad:
            return self._drop("bad_payload", str(bad))
        if isinstance(message, (Hello, Ident)):
            self.peer_schema = message.schema_hash
        self.counts["good"] += 1
        return message

    def _drop(self, what: str, why: str) -> None:
        self.counts[what] += 1
        self.last_error = f"{what}: {why}"


def _count(rest: bytes) -> int:
    n = int.from_bytes(rest[:2], "little")
    if len(rest) < 2 or not 0 < n <= MAX_SCAN:
        raise LinkError(f"found n = {n}, expected 1..{MAX_SCAN}")
    return n
