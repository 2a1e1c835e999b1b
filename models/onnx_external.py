"""Whether an ONNX file keeps weights in other files, which no hash of a bundle covers.

Read without the package onnx, which a service does not have: ONNX files are protocol buffers, and of these only what
can hold a tensor is entered (https://github.com/onnx/onnx/blob/main/onnx/onnx.proto).
"""

from __future__ import annotations

from collections.abc import Iterator

_HOLDS: dict[str, dict[int, str]] = {
    "ModelProto": {7: "GraphProto", 20: "TrainingInfoProto", 25: "FunctionProto"},
    "TrainingInfoProto": {1: "GraphProto", 2: "GraphProto"},
    "GraphProto": {1: "NodeProto", 5: "TensorProto", 15: "SparseTensorProto"},
    "FunctionProto": {7: "NodeProto", 11: "AttributeProto"},
    "NodeProto": {5: "AttributeProto"},
    "AttributeProto": {
        5: "TensorProto",
        6: "GraphProto",
        10: "TensorProto",
        11: "GraphProto",
        22: "SparseTensorProto",
        23: "SparseTensorProto",
    },
    "SparseTensorProto": {1: "TensorProto", 2: "TensorProto"},
}
"""Fields, by number, of the messages that a tensor may be in."""

_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # of a TensorProto
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # kinds of fields

Field = tuple[int, "int | memoryview"]


def external_data(content: bytes) -> str:
    """Where the first tensor that is kept elsewhere is said to be; "" where all are in the file. Raises ValueError for
    what is no such file.
    """
    waiting = [("ModelProto", memoryview(content))]
    while waiting:
        kind, message = waiting.pop()
        if kind != "TensorProto":
            waiting += _held(kind, message)
        elif any(n == _EXTERNAL_DATA or (n == _DATA_LOCATION and value) for n, value in _fields(message)):
            return _location(message) or "not named"
    return ""


def _held(kind: str, message: memoryview) -> Iterator[tuple[str, memoryview]]:
    """The messages in one that a tensor may be in, each with its kind. Raises ValueError."""
    for number, value in _fields(message):
        inner = _HOLDS[kind].get(number)
        if inner is not None and isinstance(value, int):
            raise ValueError(f"found a number for a {inner}")
        if inner is not None and not isinstance(value, int):
            yield inner, value


def _location(tensor: memoryview) -> str:
    """What the entries (key, value) of its external data give as `location`."""
    for number, value in _fields(tensor):
        if number == _EXTERNAL_DATA and isinstance(value, memoryview):
            entry = {n: bytes(v) for n, v in _fields(value) if isinstance(v, memoryview)}
            if entry.get(1) == b"location":
                return repr(entry.get(2, b"").decode("utf-8", "replace"))[:100]
    return ""


def _fields(message: memoryview) -> Iterator[Field]:
    """Number and value of each field. Raises ValueError."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        if tag >> 32:  # some readers drop what is above, and read another field
            raise ValueError("found a field's tag of over 32 bits")
        number, kind = tag >> 3, tag & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == _BYTES:
            size, at = _varint(message, at)
        elif kind in (_EIGHT, _FOUR):
            size = 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"found a field of kind {kind}")
        if at + size > len(message):
            raise ValueError("a field goes beyond the end")
        yield number, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            raise ValueError("a number goes beyond the end")
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number of more than ten bytes")
