"""Fields that hold others: lists, maps, optional values, free content, and records read into dataclasses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import MISSING, Field, dataclass
from dataclasses import fields as dataclass_fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fields import MAX_DEPTH, MAX_LIST, Bool, Check, FieldError, Float, Int, brief, decode_array, encode_array

MAX_FLOAT = sys.float_info.max


@dataclass(frozen=True)
class ListOf(Check):
    """A list of at most `most` values of one kind."""

    item: Check
    most: int = MAX_LIST

    def decode(self, value: Any) -> list[Any]:
        if type(value) is not list or len(value) > self.most:
            raise self.refuse(value)
        out, decode = [], self.item.decode
        for i, x in enumerate(value):
            try:
                out.append(decode(x))
            except FieldError as bad:
                raise bad.below(f"[{i}]") from None
        return out

    def encode(self, value: Any) -> list[Any]:
        return [self.item.encode(x) for x in value]

    def finite(self, value: Any) -> bool:
        return all(self.item.finite(x) for x in value)

    def describe(self) -> str:
        return f"list of at most {self.most}: {self.item.describe()}"


@dataclass(frozen=True)
class MapOf(Check):
    """A map from text to values of one kind; `keys` documents the usual ones, others are allowed."""

    item: Check
    keys: tuple[str, ...] = ()
    most: int = 256

    def decode(self, value: Any) -> dict[str, Any]:
        if type(value) is not dict or len(value) > self.most:
            raise self.refuse(value)
        out, decode = {}, self.item.decode
        for key, x in value.items():
            if type(key) is not str or len(key) > 128:
                raise FieldError(f"key {brief(key)}", self.describe())
            try:
                out[key] = decode(x)
            except FieldError as bad:
                raise bad.below(f".{key}") from None
        return out

    def encode(self, value: Any) -> dict[str, Any]:
        return {str(key): self.item.encode(x) for key, x in value.items()}

    def finite(self, value: Any) -> bool:
        return all(self.item.finite(x) for x in value.values())

    def describe(self) -> str:
        keys = f" (keys: {', '.join(self.keys)})" if self.keys else ""
        return f"map of text to {self.item.describe()}{keys}"


@dataclass(frozen=True)
class Maybe(Check):
    """nil (None), or a value of one kind."""

    item: Check

    @property
    def unit(self) -> str:  # type: ignore[override]
        return self.item.unit

    def decode(self, value: Any) -> Any:
        return None if value is None else self.item.decode(value)

    def encode(self, value: Any) -> Any:
        return None if value is None else self.item.encode(value)

    def finite(self, value: Any) -> bool:
        return value is None or self.item.finite(value)

    def describe(self) -> str:
        return self.item.describe() + ", or nil"


@dataclass(frozen=True)
class Tree(Check):
    """Free content: nil, bool, number, text, bytes, arrays, and lists and maps of these, at most MAX_DEPTH deep."""

    def decode(self, value: Any) -> Any:
        return self._walk(value, 0, decode_array)

    def encode(self, value: Any) -> Any:
        return self._walk(value, 0, None)

    def _walk(self, value: Any, depth: int, array: Callable[[Any], NDArray[Any]] | None) -> Any:
        if depth > MAX_DEPTH:
            raise FieldError("deeper nesting", f"at most {MAX_DEPTH} levels")
        if isinstance(value, dict):
            return self._walk_map(value, depth, array)
        if isinstance(value, (list, tuple)):
            return [self._walk(x, depth + 1, array) for x in value]
        if array is None and isinstance(value, np.ndarray):
            return encode_array(np.ascontiguousarray(value))
        if array is None and isinstance(value, np.generic):
            return value.item()
        if value is None or isinstance(value, (bool, int, float, str, bytes)):
            return value
        raise self.refuse(value)

    def _walk_map(self, value: dict[Any, Any], depth: int, array: Callable[[Any], NDArray[Any]] | None) -> Any:
        if array and value.keys() == {"dtype", "shape", "data"}:
            return array(value)
        out = {}
        for key, x in value.items():
            if type(key) is not str:
                raise FieldError(f"key {brief(key)}", "text keys")
            try:
                out[key] = self._walk(x, depth + 1, array)
            except FieldError as bad:
                raise bad.below(f".{key}") from None
        return out

    def describe(self) -> str:
        return "free content"


def may_be_missing(field: Field[Any]) -> bool:
    """Whether a message without this field is read with its default."""
    has_default = field.default is not MISSING or field.default_factory is not MISSING
    return has_default and not field.metadata["always"]


class Record(Check):
    """A map with named fields, read into the dataclass `kind`.

    Unknown keys are ignored; a missing one takes its default, or is a mismatch where it has none or must always be
    there (see `fields.wire`). The fields in its `same_length` are equally long.
    """

    def __init__(self, kind: type[Any]) -> None:
        self.kind = kind
        self.checks: tuple[tuple[str, Check], ...] = tuple(
            (f.name, f.metadata["check"]) for f in dataclass_fields(kind)
        )
        self._may_be_missing = frozenset(f.name for f in dataclass_fields(kind) if may_be_missing(f))
        self._same_length: tuple[str, ...] = getattr(kind, "same_length", ())
        self._can_be_infinite = tuple((n, c.finite) for n, c in self.checks if _can_be_infinite(c))
        self._decoders = tuple((n, c.decode, *_range(c)) for n, c in self.checks)
        self._encoders = tuple((n, c.encode, _range(c)[0]) for n, c in self.checks)

    def decode(self, value: Any) -> Any:
        if type(value) is not dict:
            raise self.refuse(value)
        read = {}
        name = ""
        try:
            for name, decode, kind, low, high in self._decoders:
                found = value[name]
                # Plain numbers are checked here: a call for each of them costs as much as all the rest.
                read[name] = found if type(found) is kind and low <= found <= high else decode(found)
        except KeyError:  # tried first as if all were there: looking for each key costs every frame
            read = self._decode_partial(value)
        except FieldError as bad:
            raise bad.below(f".{name}") from None
        made = self.kind(**read)
        if self._same_length:
            self._check_lengths(made)
        return made

    def _decode_partial(self, value: dict[str, Any]) -> dict[str, Any]:
        """The fields that are there, where the others may be missing."""
        read = {}
        for name, check in self.checks:
            if name in value:
                try:
                    read[name] = check.decode(value[name])
                except FieldError as bad:
                    raise bad.below(f".{name}") from None
            elif name not in self._may_be_missing:
                raise FieldError("nothing", check.describe(), f".{name}")
        return read

    def encode(self, value: Any) -> dict[str, Any]:
        out = {}
        name = ""
        try:
            for name, encode, kind in self._encoders:
                found = getattr(value, name)
                out[name] = found if type(found) is kind else encode(found)
        except FieldError as bad:
            raise bad.below(f".{name}") from None
        except (TypeError, ValueError, AttributeError) as bad:
            expected = dict(self.checks)[name].describe()
            raise FieldError(f"{brief(getattr(value, name))} ({bad})", expected, f".{name}") from None
        if self._same_length:
            self._check_lengths(value)
        return out

    def _check_lengths(self, made: Any) -> None:
        first, *others = self._same_length
        expected = len(getattr(made, first))
        for name in others:
            if (found := len(getattr(made, name))) != expected:
                raise FieldError(f"length {found}", f"length {expected}, as {first} has", f".{name}")

    def finite(self, value: Any) -> bool:
        for name, finite in self._can_be_infinite:
            if not finite(getattr(value, name)):
                return False
        return True

    def describe(self) -> str:
        return f"map {self.kind.__name__}"


def _range(check: Check) -> tuple[type | None, Any, Any]:
    """(type, lowest, highest) of a plain finite number; type None for everything else."""
    if type(check) is Int:
        return int, check.low, check.high
    if type(check) is Float:
        return float, max(check.low, -MAX_FLOAT), min(check.high, MAX_FLOAT)
    return (bool, False, True) if type(check) is Bool else (None, 0, 0)


def _can_be_infinite(check: Check) -> bool:
    if isinstance(check, (ListOf, MapOf, Maybe)):
        return _can_be_infinite(check.item)
    return type(check).finite is not Check.finite
