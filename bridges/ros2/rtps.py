"""The little of RTPS that a ROS service needs: messages and submessages as bytes (DDSI-RTPS 2.3), little-endian.

Cyclone DDS does not let its user say which request an answer belongs to, which Fast DDS, ROS 2's usual middleware,
reads from the message's own header. So the service speaks for itself; tare_service.py has the dialogue.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from protocol.errors import EitskinError

MAGIC = b"RTPS\x02\x03"
VENDOR = b"\x00\x00"  # nobody's
UNKNOWN = b"\x00\x00\x00\x00"
PARTICIPANT = b"\x00\x00\x01\xc1"
SPDP_WRITER, SPDP_READER = b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
PUBLICATIONS, PUBLICATIONS_READER = b"\x00\x00\x03\xc2", b"\x00\x00\x03\xc7"
SUBSCRIPTIONS, SUBSCRIPTIONS_READER = b"\x00\x00\x04\xc2", b"\x00\x00\x04\xc7"

ACKNACK, HEARTBEAT, GAP, INFO_DST, DATA = 0x06, 0x07, 0x08, 0x0E, 0x15
PL_CDR, CDR = b"\x00\x03\x00\x00", b"\x00\x01\x00\x00"
MOST_PARAMETERS = 200
MOST_BITS = 256

# numbers of parameters
SENTINEL, LEASE, TOPIC, TYPE = 0x01, 0x02, 0x05, 0x07
PROTOCOL, VENDOR_ID, RELIABILITY, DURABILITY, USER_DATA = 0x15, 0x16, 0x1A, 0x1D, 0x2C
ENDPOINT_LOCATOR, DEFAULT_LOCATOR, METATRAFFIC_LOCATOR = 0x2F, 0x31, 0x32
PARTICIPANT_GUID, BUILTIN_ENDPOINTS, ENDPOINT_GUID = 0x50, 0x58, 0x5A
RELATED, RELATED_OF_FAST_DDS = 0x83, 0x800F
UDP4 = 1

Address = tuple[str, int]


class Malformed(EitskinError, ValueError):
    """Bytes that are no RTPS message, or not one that we read."""


class Sub(NamedTuple):
    """A submessage: its kind, flags and body; the prefix of whom it is for (zeros: everybody)."""

    kind: int
    flags: int
    body: bytes
    to: bytes


class Arrived(NamedTuple):
    """What a DATA submessage holds."""

    reader: bytes
    writer: bytes
    number: int
    inline: dict[int, list[bytes]]
    payload: bytes  # with its four bytes of encapsulation; empty where there is none


def message(prefix: bytes, subs: Iterable[bytes], to: bytes = b"") -> bytes:
    """A whole message of the participant `prefix`, for the one of prefix `to`."""
    aim = sub(INFO_DST, to) if to else b""
    return MAGIC + VENDOR + prefix + aim + b"".join(subs)


def sub(kind: int, body: bytes, flags: int = 0) -> bytes:
    return struct.pack("<BBH", kind, flags | 1, len(body)) + body


def parse(data: bytes) -> tuple[bytes, Iterator[Sub]]:
    """(prefix of the sender, submessages). Raises Malformed."""
    if len(data) < 20 or data[:4] != MAGIC[:4] or data[4] != 2:
        raise Malformed("not RTPS 2")
    return data[8:20], _subs(data)


def _subs(data: bytes) -> Iterator[Sub]:
    at, to = 20, bytes(12)
    while at + 4 <= len(data):
        kind, flags = data[at], data[at + 1]
        if not flags & 1:
            raise Malformed("big-endian")
        (length,) = struct.unpack_from("<H", data, at + 2)
        end = at + 4 + length if length or kind in (0x01, 0x09) else len(data)  # 0: the last one, of any length
        if end > len(data):
            raise Malformed("a submessage that is cut short")
        body = data[at + 4 : end]
        if kind == INFO_DST and len(body) >= 12:
            to = body[:12]
        yield Sub(kind, flags, body, to)
        at = end


def number_bytes(number: int) -> bytes:
    return struct.pack("<iI", number >> 32, number & 0xFFFFFFFF)


def number_at(body: bytes, at: int) -> int:
    high, low = struct.unpack_from("<iI", body, at)
    return int((high << 32) + low)


def data(reader: bytes, writer: bytes, number: int, payload: bytes, inline: bytes = b"") -> bytes:
    """A DATA submessage."""
    body = struct.pack("<HH", 0, 16) + reader + writer + number_bytes(number) + inline + payload
    return sub(DATA, body, 4 | (2 if inline else 0))


def read_data(found: Sub) -> Arrived:
    """Raises Malformed."""
    try:
        _, to_inline = struct.unpack_from("<HH", found.body)
        reader, writer, number = found.body[4:8], found.body[8:12], number_at(found.body, 12)
        at, inline = 4 + to_inline, dict[int, list[bytes]]()
        if found.flags & 2:
            inline, at = parameters(found.body, at)
    except struct.error:
        raise Malformed("DATA that is cut short") from None
    return Arrived(reader, writer, number, inline, found.body[at:] if found.flags & 4 else b"")


def heartbeat(reader: bytes, writer: bytes, first: int, last: int, count: int) -> bytes:
    """What there is to be had of a writer: an answer is asked for."""
    return sub(HEARTBEAT, reader + writer + number_bytes(first) + number_bytes(last) + struct.pack("<I", count))


def acknack(reader: bytes, writer: bytes, base: int, missing: Iterable[int], count: int) -> bytes:
    """All below `base` has come; of the others these are missing."""
    wanted = [number - base for number in missing if 0 <= number - base < MOST_BITS]
    bits = max(wanted) + 1 if wanted else 0
    words = [0] * ((bits + 31) // 32)
    for bit in wanted:
        words[bit // 32] |= 1 << (31 - bit % 32)
    numbers = number_bytes(base) + struct.pack(f"<I{len(words)}I", bits, *words)
    return sub(ACKNACK, reader + writer + numbers + struct.pack("<I", count), 0 if wanted or base == 1 else 2)


def number_set(body: bytes, at: int) -> tuple[int, list[int]]:
    """(base, the numbers in the set). Raises Malformed."""
    try:
        base, (bits,) = number_at(body, at), struct.unpack_from("<I", body, at + 8)
        if bits > MOST_BITS:
            raise Malformed("too many bits")
        words = struct.unpack_from(f"<{(bits + 31) // 32}I", body, at + 12)
    except struct.error:
        raise Malformed("numbers that are cut short") from None
    return base, [base + k for k in range(bits) if words[k // 32] >> (31 - k % 32) & 1]


def parameters(body: bytes, at: int = 0) -> tuple[dict[int, list[bytes]], int]:
    """(parameters by number, where they end). Raises Malformed."""
    found: dict[int, list[bytes]] = {}
    for _ in range(MOST_PARAMETERS):
        if at + 4 > len(body):
            raise Malformed("parameters without an end")
        number, length = struct.unpack_from("<HH", body, at)
        at += 4
        if number == SENTINEL:
            return found, at
        if at + length > len(body):
            raise Malformed("a parameter that is cut short")
        found.setdefault(number, []).append(body[at : at + length])
        at += length
    raise Malformed("too many parameters")


def parameter_list(pairs: Iterable[tuple[int, bytes]]) -> bytes:
    """Parameters as bytes, with their end."""
    made = b""
    for number, value in pairs:
        value = value.ljust((len(value) + 3) & ~3, b"\0")
        made += struct.pack("<HH", number, len(value)) + value
    return made + struct.pack("<HH", SENTINEL, 0)


def text(value: str) -> bytes:
    """A string as CDR has it."""
    raw = value.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw


def read_text(raw: bytes) -> str:
    length = struct.unpack_from("<I", raw)[0] if len(raw) >= 4 else 0
    return raw[4 : 4 + length].rstrip(b"\0").decode("utf-8", "replace")


def locator(address: Address) -> bytes:
    return struct.pack("<iI", UDP4, address[1]) + bytes(12) + socket.inet_aton(address[0])


def addresses(raw: Iterable[bytes]) -> list[Address]:
    """Those locators that are UDP over IPv4."""
    found = []
    for each in raw:
        if len(each) == 24 and struct.unpack_from("<i", each)[0] == UDP4:
            port = struct.unpack_from("<I", each, 4)[0]
            if 0 < port < 65536:
                found.append((socket.inet_ntoa(each[20:24]), int(port)))
    return found
