"""What a field of a frame may hold: one small checker per kind of value (lists, maps and records are in records.py).

A checker turns what msgpack read into what Python code uses (`decode`), the other way round (`encode`), says whether
a decoded value is finite (`finite`), and describes itself for WIRE.md (`describe`). `decode` raises `FieldError`;
`frames.unpack` adds the topic and the field's name to it. Nothing here knows a topic, a frame or a socket.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import EitskinError

INT64_MAX = 2**63 - 1
UINT64_MAX = 2**64 - 1
MAX_LIST = 4096
MAX_MAP = 1024
MAX_TEXT = 65536
MAX_DEPTH = 8
MAX_EXTENT = 2**31
"""Bytes that an array without elements would have if each of its empty dimensions had one: numpy computes with them."""
REMEMBERED = 64  # texts that a checker has accepted and need not look at again


class FieldError(EitskinError):
    """A value is not what its field allows: `path` inside the field ("" for the field itself), `found`, `expected`."""

    def __init__(self, found: str, expected: str, path: str = "") -> None:
        super().__init__(found, expected, path)
        self.found, self.expected, self.path = found, expected, path

    def below(self, step: str) -> FieldError:
        """The same mismatch seen from one level further out."""
        return FieldError(self.found, self.expected, step + self.path)


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3  # repr() itself fails on a list a thousand levels deep, which one small message can hold


def brief(value: object) -> str:
    """A value as an error message shows it: its type, and the value itself where that is short. Never raises."""
    if isinstance(value, (bytes, list, dict)) and len(value) > 3:
        return f"{type(value).__name__} of length {len(value)}"
    text = _SHORT.repr(value) if isinstance(value, (list, tuple, dict)) else repr(value)
    return f"{type(value).__name__} {text if len(text) <= 40 else text[:37] + '...'}"


class Check:
    """Base of the checkers; a plain value by itself."""

    unit: str = ""

    def decode(self, value: Any) -> Any:
        raise NotImplementedError

    def encode(self, value: Any) -> Any:
        return value

    def finite(self, value: Any) -> bool:
        return True

    def describe(self) -> str:
        raise NotImplementedError

    def refuse(self, value: object) -> FieldError:
        return FieldError(brief(value), self.describe())


@dataclass(frozen=True)
class Bool(Check):
    """true or false."""

    def decode(self, value: Any) -> bool:
        if value is True or value is False:
            return bool(value)
        raise self.refuse(value)

    def encode(self, value: Any) -> bool:
        return bool(value)

    def describe(self) -> str:
        return "bool"


@dataclass(frozen=True)
class Int(Check):
    """A whole number in [low, high]; a bool is not one."""

    low: int = 0
    high: int = INT64_MAX
    unit: str = ""

    def decode(self, value: Any) -> int:
        if type(value) is int and self.low <= value <= self.high:
            return value
        raise self.refuse(value)

    def encode(self, value: Any) -> int:
        return int(value)

    def describe(self) -> str:
        if self.low == self.high:
            return f"int {self.low}"
        high = {INT64_MAX: "2^63-1", UINT64_MAX: "2^64-1", 2**32 - 1: "2^32-1"}.get(self.high, str(self.high))
        return f"int {self.low}..{high}"


@dataclass(frozen=True)
class Version(Int):
    """The layout that a message was written in: all up to ours can be read, a newer one cannot."""

    def refuse(self, value: object) -> FieldError:
        if type(value) is not int or value <= self.high:
            return super().refuse(value)
        return FieldError(f"schema {value}", f"schema {self.high} at most: who sent it is newer, update this reader")


@dataclass(frozen=True)
class Float(Check):
    """A number, in [low, high] if it is finite; a whole number is accepted for it.

    A non-finite value decodes (it is data); `valid` of its frame then becomes false, unless `gaps` says that it means
    something.
    """

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    gaps: bool = False

    def decode(self, value: Any) -> float:
        if type(value) is float or type(value) is int:
            number = float(value)
            if self.low <= number <= self.high or not math.isfinite(number):
                return number
        raise self.refuse(value)

    def encode(self, value: Any) -> float:
        return float(value)

    def finite(self, value: Any) -> bool:
        return self.gaps or math.isfinite(value)

    def describe(self) -> str:
        if self.low == -math.inf and self.high == math.inf:
            return "float"
        return f"float {self.low:g}.." + ("" if self.high == math.inf else f"{self.high:g}")


@dataclass(frozen=True)
class Text(Check):
    """UTF-8 text of at most `most` characters, one of `choices` or of the whole form `form` where given."""

    most: int = 256
    choices: tuple[str, ...] = ()
    form: str = ""
    _accepted: set[str] = dataclass_field(default_factory=set, repr=False, compare=False)

    def decode(self, value: Any) -> str:
        if type(value) is str:
            if value in self._accepted:  # names and hosts come with every frame: a regular expression is slow when cold
                return value
            if len(value) <= self.most and self._is_allowed(value):
                if len(self._accepted) < REMEMBERED:
                    self._accepted.add(value)
                return value
        raise self.refuse(value)

    def _is_allowed(self, value: str) -> bool:
        if self.choices:
            return value in self.choices
        return not self.form or re.fullmatch(self.form, value) is not None

    def describe(self) -> str:
        if self.choices:
            return "text, one of " + ", ".join(f'"{c}"' for c in self.choices)
        return f"text `{self.form}`" if self.form else f"text, at most {self.most} characters"


@dataclass(frozen=True)
class Vector(Check):
    """A list of exactly `size` numbers."""

    size: int
    unit: str = ""

    def decode(self, value: Any) -> list[float]:
        if type(value) is not list or len(value) != self.size:
            raise self.refuse(value)
        kinds = set(map(type, value))
        if kinds == {float}:
            return value
        if kinds <= {float, int}:
            return [float(x) for x in value]
        raise self.refuse(value)

    def encode(self, value: Any) -> list[float]:
        return [float(x) for x in value]

    def finite(self, value: Any) -> bool:
        return math.isfinite(sum(value))

    def describe(self) -> str:
        return f"list of {self.size} floats"


@dataclass(frozen=True)
class Array(Check):
    """A numpy array: a map {dtype, shape, data}, row-major, little-endian; decoded without a copy, read-only.

    `shape` has one entry per dimension: a number is fixed, a name is free. With `or_empty` an array without elements,
    of any shape, stands for "not computed". `gaps` says that non-finite entries mean something and do not make the
    frame invalid.
    """

    dtype: str
    shape: tuple[int | str, ...]
    unit: str = ""
    or_empty: bool = False
    gaps: bool = False

    def decode(self, value: Any) -> NDArray[Any]:
        array = decode_array(value)
        if value["dtype"] != self.dtype:
            raise FieldError(f"dtype {array.dtype.str}", self.describe())
        if array.size or not self.or_empty:
            self._check_shape(array)
        return array

    def encode(self, value: Any) -> dict[str, Any]:
        array = np.ascontiguousarray(value, dtype=self.dtype)
        self._check_shape(array)
        return {"dtype": self.dtype, "shape": list(array.shape), "data": array.data if array.size else b""}

    def _check_shape(self, array: NDArray[Any]) -> None:
        shape = array.shape
        if len(shape) == len(self.shape):
            for have, want in zip(shape, self.shape, strict=True):
                if have != want and type(want) is int:
                    break
            else:
                return
        if self.or_empty and array.size == 0:
            return
        raise FieldError(f"shape {list(shape)}", self.describe())

    def finite(self, value: Any) -> bool:
        return self.gaps or not value.size or value.dtype.kind not in "fc" or bool(np.isfinite(value).all())

    def describe(self) -> str:
        shape = ", ".join(str(s) for s in self.shape)
        return f"array {self.dtype} ({shape})" + (", or of size 0" if self.or_empty else "")


def decode_array(value: Any) -> NDArray[Any]:
    """Read {dtype, shape, data} without copying `data`. Raises FieldError."""
    expected = "array: map {dtype, shape, data}"
    try:
        name, shape, data = value["dtype"], value["shape"], value["data"]
        dtype = _DTYPES[name]
    except (TypeError, KeyError):
        raise FieldError(brief(value), f"{expected}, dtype one of {' '.join(_DTYPES)}") from None
    if type(shape) is not list or type(data) is not bytes or len(shape) > 8:
        raise FieldError(f"shape {brief(shape)}, data {brief(data)}", expected)
    size = extent = dtype.itemsize
    for n in shape:
        if type(n) is not int or n < 0:
            raise FieldError(f"shape {brief(shape)}", expected)
        size *= n
        extent *= n or 1
    if size != len(data):
        raise FieldError(f"{len(data)} bytes of data", f"{size} bytes for shape {shape} of {name}")
    if extent > MAX_EXTENT:
        raise FieldError(f"shape {shape}", f"dimensions that multiply to at most {MAX_EXTENT} bytes")
    array = np.frombuffer(data, dtype)
    return array if len(shape) == 1 else array.reshape(shape)


def encode_array(array: NDArray[Any]) -> dict[str, Any]:
    """The map that stands for a contiguous array of one of the allowed dtypes. Raises FieldError for another dtype."""
    name = array.dtype.newbyteorder("<").str
    if name not in _DTYPES:
        raise FieldError(f"dtype {array.dtype}", f"one of {' '.join(_DTYPES)}")
    return {"dtype": name, "shape": list(array.shape), "data": array.astype(name, copy=False).tobytes()}


_DTYPES: Mapping[str, np.dtype[Any]] = {
    n: np.dtype(n) for n in ("<f4", "<f8", "<c8", "<c16", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "|b1")
}


def wire(check: Check, doc: str, default: Any = ..., *, always: bool = False) -> Any:
    """A dataclass field with its checker and its one line of documentation; `default` may be a class to call for a
    fresh value.

    A field with a default may be missing from a message, which was then written before there was such a field, and
    is read as the default. `always`: it may not, because its default would claim what nobody has said.
    """
    metadata = {"check": check, "doc": doc, "always": always}
    if default is ...:
        return dataclass_field(metadata=metadata)
    if isinstance(default, type) or callable(default):
        return dataclass_field(default_factory=default, metadata=metadata)
    return dataclass_field(default=default, metadata=metadata)
