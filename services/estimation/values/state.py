"""A state, saved and loaded one way: a dataclass of arrays, numbers, texts, lists and further dataclasses.

Its fields' types say what may be loaded. An array of a state names its dimensions, `Annotated[Array, "K", "E"]`: K
measurements, E electrodes, any other letter one size within its dataclass. "gaps" after them: it may hold NaN.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, partial
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")
Sizes = dict[str, int]

GAPS = "gaps"


def saved(state: Any) -> Any:
    """As free content of a message: maps, lists, arrays, numbers and texts."""
    if is_dataclass(state):
        return {each.name: saved(getattr(state, each.name)) for each in fields(state)}
    if isinstance(state, Enum):
        return state.value
    if isinstance(state, Mapping):
        return [[saved(key), saved(value)] for key, value in state.items()]
    if isinstance(state, (list, tuple)):
        return [saved(each) for each in state]
    if isinstance(state, np.generic):
        return state.item()
    return next((kind(state) for kind in (bool, int, float) if isinstance(state, kind)), state)


def loaded(kind: type[T], found: Any, sizes: Sizes) -> T:
    """What `saved` made, as `kind`; sizes: K and E. Raises ValueError, which says where it does not fit."""
    return _read(kind, found, sizes, kind.__name__)  # type: ignore[no-any-return]


_hints = cache(partial(get_type_hints, include_extras=True))


def _read(kind: Any, found: Any, sizes: Sizes, where: str, dimensions: tuple[str, ...] = ()) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _read(arguments[0], found, sizes, where, arguments[1:])
    if origin in (Union, types.UnionType):
        rest = [each for each in arguments if each is not type(None)]
        return None if found is None else _read(rest[0], found, sizes, where, dimensions)
    if dimensions:
        return _array(kind, found, sizes, dimensions, where)
    if origin in (list, tuple, dict):
        return _several(origin, arguments, found, sizes, where)
    if issubclass(kind, Enum):
        return kind(found)
    if is_dataclass(kind) or hasattr(kind, "_fields"):
        return _record(kind, found, dict(sizes), where)
    if not isinstance(found, (float, int) if kind is float else kind) or isinstance(found, bool) != (kind is bool):
        raise _misfit(where, found, kind.__name__)
    return kind(found)


def _record(kind: Any, found: Any, sizes: Sizes, where: str) -> Any:
    hints = _hints(kind)
    if is_dataclass(kind):
        if not isinstance(found, dict) or found.keys() != hints.keys():
            raise _misfit(where, found, f"a map of {', '.join(hints)}")
    else:
        found = dict(zip(hints, _list(found, where, len(hints)), strict=True))
    return kind(*(_read(hint, found[name], sizes, f"{where}.{name}") for name, hint in hints.items()))


def _several(origin: Any, arguments: tuple[Any, ...], found: Any, sizes: Sizes, where: str) -> Any:
    if origin is dict:
        pairs = [_list(each, where, 2) for each in _list(found, where)]
        return {_read(arguments[0], k, sizes, where): _read(arguments[1], v, sizes, f"{where}[{k}]") for k, v in pairs}
    if origin is list or arguments[-1] is Ellipsis:
        each = enumerate(_list(found, where))
        return origin(_read(arguments[0], value, sizes, f"{where}[{k}]") for k, value in each)
    values = _list(found, where, len(arguments))
    return tuple(_read(kind, value, sizes, where) for kind, value in zip(arguments, values, strict=True))


def _list(found: Any, where: str, count: int | None = None) -> list[Any]:
    """Of so many values; None: of any number."""
    if not isinstance(found, list) or count not in (None, len(found)):
        raise _misfit(where, found, "a list" if count is None else f"a list of {count}")
    return found


def _array(kind: Any, found: Any, sizes: Sizes, dimensions: tuple[str, ...], where: str) -> Any:
    dtype = get_args(get_args(kind)[1])[0]
    named = [each for each in dimensions if each != GAPS]
    if not isinstance(found, np.ndarray) or found.dtype != dtype or found.ndim != len(named):
        raise _misfit(where, found, f"an array of {np.dtype(dtype)} with {len(named)} dimensions")
    for name, size in zip(named, found.shape, strict=True):
        if sizes.setdefault(name, size) != size:
            raise _misfit(where, found, f"{name} = {sizes[name]}")
    if GAPS not in dimensions and found.dtype.kind == "f" and not np.isfinite(found).all():
        raise _misfit(where, "NaN or infinity", "finite numbers")
    return found.copy()


def _misfit(where: str, found: Any, expected: str) -> ValueError:
    what = f"an array of {found.dtype}, {found.shape}" if isinstance(found, np.ndarray) else repr(found)[:60]
    return ValueError(f"{where}: found {what}, expected {expected}")
