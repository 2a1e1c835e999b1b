"""A message as bytes: CDR, little-endian, each number at a multiple of its size. What ROS 2 sends and rosbag2 keeps."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from .definitions import SCALARS, TABLE, Member, members

HEADER = b"\0\1\0\0"
"""Little-endian CDR, no options."""

Value = Mapping[str, Any]
_Write = Callable[[bytearray, Any], None]


def encode(message: str, value: Value) -> bytes:
    """The bytes of a message given as a map from field to value; fields left out are 0, "" or empty, as ROS has them.
    Raises KeyError for a field that the message does not have.
    """
    out = bytearray(HEADER)
    _writer(message)(out, value)
    return bytes(out)


@cache
def _writer(kind: str) -> _Write:
    """What writes one value of a type."""
    if kind == "string":
        return _text
    if kind not in TABLE:
        return _scalar(kind)
    fields = [(member.name, _field(member), _default(member)) for member in members(kind)]
    names = frozenset(name for name, _, _ in fields)

    def write(out: bytearray, value: Value) -> None:
        if not value.keys() <= names:
            raise KeyError(f"{kind} has no field {', '.join(sorted(value.keys() - names))}")
        for name, put, default in fields:
            put(out, value.get(name, default))

    return write


def _field(member: Member) -> _Write:
    one = _writer(member.type)
    if not member.sequence:
        return one
    count = _scalar("uint32")

    def write_bytes(out: bytearray, value: Any) -> None:
        data = memoryview(value).cast("B") if not isinstance(value, bytes) else value
        count(out, len(data))
        out += data

    def write_each(out: bytearray, values: Any) -> None:
        count(out, len(values))
        for value in values:
            one(out, value)

    return write_bytes if member.type == "uint8" else write_each


def _default(member: Member) -> Any:
    if member.sequence:
        return b"" if member.type == "uint8" else ()
    if member.type in TABLE:
        return {}
    return "" if member.type == "string" else float(member.default or 0) if "float" in member.type else 0


def _scalar(kind: str) -> _Write:
    packer = struct.Struct("<" + SCALARS[kind][0])
    size = packer.size

    def write(out: bytearray, value: Any) -> None:
        if gap := (len(out) - len(HEADER)) % size:
            out += bytes(size - gap)
        out += packer.pack(value)

    return write


def _text(out: bytearray, value: str) -> None:
    data = value.encode() + b"\0"
    _scalar_u32(out, len(data))
    out += data


_scalar_u32 = _scalar("uint32")
