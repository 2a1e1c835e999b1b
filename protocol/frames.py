"""Frames as messages: `pack`, `unpack`, and the one error that a wrong message raises.

A message is one ZeroMQ part: the topic ("contact/palm"), a 0 byte, a msgpack map with the frame's fields.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import msgpack

from . import fields as _fields
from .errors import EitskinError
from .fields import FieldError, brief
from .frame_types import (
    ELECTRODE_STATES,
    INFO_KEYS,
    NAME,
    REASONS,
    SCHEMA,
    SHAPES,
    SOURCES,
    STAMPS,
    STATUS_CLIPPED,
    STATUS_FIFO,
    STATUS_OPEN,
    STATUS_RTIA,
    VERDICTS,
    Contact,
    ContactFrame,
    DeltaFrame,
    EstimatedTouch,
    ForceFrame,
    Frame,
    ImageFrame,
    InfoFrame,
    JudgementsFrame,
    LocatedTouch,
    PartFrame,
    RawFrame,
    ReferenceFrame,
    ShapeFrame,
    StackFrame,
    StatusFrame,
    TrueTouch,
    TruthFrame,
)
from .records import Record
from .topics import TOPIC_OF, TOPICS

__all__ = [
    "ELECTRODE_STATES", "INFO_KEYS", "MAX_MESSAGE", "REASONS", "SCHEMA", "SHAPES", "SOURCES", "STAMPS",
    "STATUS_CLIPPED", "STATUS_FIFO", "STATUS_OPEN", "STATUS_RTIA", "VERDICTS",
    "Contact", "ContactFrame", "DeltaFrame", "EstimatedTouch", "ForceFrame",
    "Frame", "FrameError",
    "ImageFrame", "InfoFrame", "JudgementsFrame", "LocatedTouch", "PartFrame", "RawFrame", "ReferenceFrame",
    "ShapeFrame", "StackFrame", "StatusFrame", "TrueTouch", "TruthFrame", "as_sent", "pack", "read_map",
    "unpack",
]  # fmt: skip

MAX_MESSAGE = 4 * 1024 * 1024
"""Longest message in bytes that is sent or read."""

_RECORDS = {name: Record(topic.frame) for name, topic in TOPICS.items()}
_TOPIC = re.compile(rf"([a-z]{{1,16}})/({NAME})".encode())


class FrameError(EitskinError, ValueError):
    """A message is not a frame. `topic` and `field` name the place, `found` and `expected` what is wrong there.

    `topic` is "" where the message does not even begin with one; `field` is "" for the message as a whole.
    """

    def __init__(self, topic: str, field: str, found: str, expected: str) -> None:
        super().__init__(topic, field, found, expected)
        self.topic, self.field, self.found, self.expected = topic, field, found, expected

    def __str__(self) -> str:
        place = f"{self.topic or 'message'}{': ' + self.field if self.field else ''}"
        return f"{place}: found {self.found}, expected {self.expected}"


def pack(frame: Frame) -> bytes:
    """The message for a frame, arrays brought to their wire type. Raises FrameError where a field cannot be sent."""
    topic = TOPIC_OF[type(frame)].name
    try:
        body = _RECORDS[topic].encode(frame)
        packed: bytes = msgpack.packb(body)
    except FieldError as bad:
        raise FrameError(topic, bad.path.lstrip("."), bad.found, bad.expected) from None
    except (TypeError, ValueError, OverflowError) as bad:
        raise FrameError(topic, "", f"what msgpack refuses ({bad})", "the fields' own types") from None
    return f"{topic}/{frame.skin}\0".encode() + packed


def unpack(message: bytes) -> Frame:
    """The frame in a message. Arrays share the message's memory and are read-only.

    Raises FrameError where the message has another form, type, shape or range than documented. Non-finite
    measurements are data: the frame comes back with `valid` false and the reason `non_finite`; see `as_sent`.
    """
    head, zero, _ = bytes(message[:128]).partition(b"\0")
    name, skin = _place(head) if zero else ("", "")
    if name not in _RECORDS:
        raise FrameError("", "", f"a message beginning {brief(bytes(message[:24]))}", "topic/skin, a 0 byte, msgpack")
    record = _RECORDS[name]
    fields_read = read_map(memoryview(message)[len(head) + 1 :], name)
    try:
        frame: Frame = record.decode(fields_read)
        finite = record.finite(frame)
    except FieldError as bad:
        raise FrameError(name, bad.path.lstrip("."), bad.found, bad.expected) from None
    except Exception as bad:  # a reader drops one message rather than die of it, whatever a checker has overlooked
        raise FrameError(
            name, "", f"what no field allows ({type(bad).__name__}: {str(bad)[:80]})", "the fields of its topic"
        ) from None
    if frame.skin != skin:
        raise FrameError(name, "skin", brief(frame.skin), f"{skin!r}, as in the message's topic")
    if not finite:
        frame.note_valid(frame.valid)
        frame.valid = False
        if "non_finite" not in frame.reasons:
            frame.reasons.append("non_finite")
    return frame


@lru_cache(maxsize=1024)
def _place(head: bytes) -> tuple[str, str]:
    """(topic, skin) of "topic/skin"; two empty texts for any other text."""
    known = _TOPIC.fullmatch(head)
    return (known[1].decode(), known[2].decode()) if known else ("", "")


def as_sent(frame: Frame) -> tuple[bool, list[str]]:
    """`valid` and `reasons` without the remark `non_finite` of `unpack`: for a reader that leaves failed measurements
    out, or sends the frame on.
    """
    if not hasattr(frame, "valid_as_sent"):
        return frame.valid, list(frame.reasons)
    return frame.valid_as_sent, [reason for reason in frame.reasons if reason != "non_finite"]


def read_map(packed: bytes | memoryview, topic: str) -> dict[str, Any]:
    """Read a msgpack map within the limits that bound time and memory. Raises FrameError, and nothing else, whatever
    the bytes.
    """
    if len(packed) > MAX_MESSAGE:
        raise FrameError(topic, "", f"{len(packed)} bytes", f"at most {MAX_MESSAGE}")
    try:
        value = msgpack.unpackb(
            packed,
            raw=False,
            strict_map_key=True,
            max_str_len=_fields.MAX_TEXT,
            max_bin_len=MAX_MESSAGE,
            max_array_len=_fields.MAX_LIST,
            max_map_len=_fields.MAX_MAP,
            max_ext_len=0,
        )
    except Exception as bad:  # msgpack raises a dozen kinds, some of them bare ValueError or TypeError
        raise FrameError(
            topic, "", f"not one msgpack value ({type(bad).__name__}: {str(bad)[:80]})", "a msgpack map"
        ) from None
    if type(value) is not dict:
        raise FrameError(topic, "", brief(value), "a msgpack map")
    return value
