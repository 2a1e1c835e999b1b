"""The board's link: what goes over the serial line, in both directions.

On the line: 0x00, COBS(body, CRC-32 of the body), 0x00; bodies are in link_messages.py. HELLO, IDENT and NAK carry
the plain CRC-32; all others one that starts from the hash of SCHEMA_TEXT, so that a firmware with other messages is
known by the hash in its IDENT, refused by name, and never misread.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter

from .cobs import cobs_decode, cobs_encode
from .link_messages import (
    BY_NUMBER,
    CHIP_ID,
    LINK_VERSION,
    MAX_BODY,
    MAX_SCAN,
    MAX_TEXT,
    MESSAGES,
    PARTS,
    SCHEMA_HASH,
    SCHEMA_TEXT,
    Ack,
    Capability,
    Config,
    Event,
    EventCode,
    Hello,
    Ident,
    LinkError,
    Message,
    Nak,
    NakReason,
    ScanFrame,
    SelfTest,
    SelfTestFault,
    Start,
    Stop,
    Time,
    TimeAsk,
)  # fmt: skip

__all__ = [
    "CHIP_ID", "LINK_VERSION", "MAX_BODY", "MAX_SCAN", "MAX_TEXT", "MESSAGES", "PARTS", "SCHEMA_HASH", "SCHEMA_TEXT",
    "Ack", "Capability", "Config", "Decoder", "Event", "EventCode", "Hello", "Ident", "LinkError", "Message",
    "Nak", "NakReason", "ScanFrame", "SelfTest", "SelfTestFault", "Start", "Stop", "Time", "TimeAsk", "encode",
]  # fmt: skip

MAX_PIECE = MAX_BODY + MAX_BODY // 254 + 1
"""Longest stuffed body."""


def encode(message: Message, schema_hash: int = SCHEMA_HASH) -> bytes:
    """The bytes for the line, delimiters included. Raises LinkError where a field does not fit its place."""
    body = message.body()
    crc = zlib.crc32(body, 0 if message.plain_crc else schema_hash)
    return b"\0" + cobs_encode(body + struct.pack("<I", crc)) + b"\0"


class _Dropped(Exception):
    """A piece of the line is not a message; says how it is counted, and why."""


class Decoder:
    """Turns the line's bytes into messages, whatever else is on the line.

    `counts`: `good`, and what was dropped: `bad_cobs`, `bad_crc`, `oversize`, `unknown` (no such message),
    `bad_payload` (the fields do not fit), `other_schema` (intact, but from the firmware whose IDENT stated another
    schema hash). `last_error` says more of the last one.
    """

    def __init__(self, schema_hash: int = SCHEMA_HASH) -> None:
        self.schema_hash = schema_hash
        self.peer_schema = schema_hash
        """The hash that the other end's last HELLO or IDENT stated."""
        self.counts: Counter[str] = Counter()
        self.last_error = ""
        self._rest = b""
        self._skipping = False

    @property
    def bad(self) -> int:
        """How many pieces were dropped."""
        return sum(n for what, n in self.counts.items() if what != "good")

    @property
    def waiting(self) -> bool:
        """Whether a message has begun and not ended."""
        return bool(self._rest) or self._skipping

    def feed(self, data: bytes) -> list[Message]:
        """The messages that `data` completes. Never raises, whatever the bytes."""
        *pieces, self._rest = (self._rest + data).split(b"\0")
        messages = []
        for piece in pieces:
            if self._skipping or not piece:
                self._skipping = False
                continue
            try:
                messages.append(self._read(piece))
                self.counts["good"] += 1
            except _Dropped as bad:
                self._count(*bad.args)
        if len(self._rest) > MAX_PIECE:
            if not self._skipping:
                self._count("oversize", f"more than {MAX_BODY} bytes without a delimiter")
            self._skipping = True
        if self._skipping:
            self._rest = b""
        return messages

    def _read(self, piece: bytes) -> Message:
        if len(piece) > MAX_PIECE:
            raise _Dropped("oversize", f"found {len(piece)} bytes, expected at most {MAX_PIECE}")
        try:
            checked = cobs_decode(piece)
        except ValueError as bad:
            raise _Dropped("bad_cobs", str(bad)) from None
        if len(checked) < 5:
            raise _Dropped("bad_crc", f"found {len(checked)} bytes, expected at least 5")
        body, crc = checked[:-4], int.from_bytes(checked[-4:], "little")
        kind = BY_NUMBER.get(body[0])
        if zlib.crc32(body, 0 if kind and kind.plain_crc else self.schema_hash) != crc:
            if self.peer_schema != self.schema_hash and zlib.crc32(body, self.peer_schema) == crc:
                ours = f"{self.schema_hash:08x}"
                raise _Dropped(
                    "other_schema", f"found {self.peer_schema:08x}, expected {ours}: flash a matching firmware"
                )
            raise _Dropped("bad_crc", f"the CRC of a message {body[0]:#04x} of {len(body)} bytes does not match")
        if kind is None:
            raise _Dropped("unknown", f"no message has number {body[0]:#04x}")
        try:
            message = kind.read(body)
        except Exception as bad:  # LinkError says what is wrong; nothing else that a body can cause ends the reader
            raise _Dropped("bad_payload", str(bad)) from None
        if isinstance(message, (Hello, Ident)):
            self.peer_schema = message.schema_hash
        return message

    def _count(self, what: str, why: str) -> None:
        self.counts[what] += 1
        self.last_error = f"{what}: {why}"
