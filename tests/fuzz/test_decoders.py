"""Every decoder, fed with the kept corpus and with what hypothesis makes of right inputs: nothing raises but its own
error. run.py does the same for longer, led by coverage.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

spec = importlib.util.spec_from_file_location("fuzz_decoders", Path(__file__).with_name("decoders.py"))
assert spec is not None and spec.loader is not None
decoders = importlib.util.module_from_spec(spec)
sys.modules["fuzz_decoders"] = decoders
spec.loader.exec_module(decoders)

PACKED = ("fields", "request", "reply", "state")  # what they read is a msgpack map
EXAMPLES = {"carried": 20, "manifest": 20, "state": 40, "recording": 60}

quick = {"deadline": None, "suppress_health_check": list(HealthCheck), "database": None}


@pytest.fixture(autouse=True)
def kept_apart(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Where a decoder looks for its folder, and what it logs, is put back."""
    import logging

    monkeypatch.setenv("EITSKIN_RUNTIME", "")
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", decoders.TARGETS)
def test_the_kept_corpus(name: str) -> None:
    """What once was too much, and what reaches far into the decoder."""
    inputs = [*decoders.seeds(name), *(path.read_bytes() for path in sorted((decoders.CORPUS / name).iterdir()))]
    assert len(inputs) > 5
    for data in inputs:
        decoders.TARGETS[name](data)


@st.composite
def damaged(draw: st.DrawFn, name: str) -> bytes:
    """A right input with pieces of it changed, cut out, doubled or put elsewhere."""
    data = bytearray(draw(st.sampled_from(decoders.seeds(name))))
    for _ in range(draw(st.integers(0, 6))):
        at = draw(st.integers(0, len(data)))
        end = min(len(data), at + draw(st.integers(0, 16)))
        data[at:end] = draw(st.one_of(st.binary(max_size=16), st.just(bytes(data[at:end]) * 2)))
    return bytes(data)


@pytest.mark.parametrize("name", decoders.TARGETS)
def test_damaged_inputs(name: str) -> None:
    @settings(max_examples=EXAMPLES.get(name, 150), **quick)
    @given(damaged(name))
    def feed(data: bytes) -> None:
        decoders.TARGETS[name](data)

    feed()


NUMBERS = st.one_of(
    st.integers(-(2**63), 2**64 - 1), st.floats(), st.sampled_from([0, 1, -1, 2**40, 2**63, float("nan"), float("inf")])
)
ARRAYS = st.fixed_dictionaries(
    {
        "dtype": st.sampled_from(["<f4", "<f8", "<c8", "|b1", "|u1", "object", ""]),
        "shape": st.lists(st.sampled_from([0, 1, 2, 3, 120, 2**31, 2**40, 2**63, -1]), max_size=9),
        "data": st.sampled_from([b"", bytes(8), bytes(480), bytes(960)]),
    }
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=8), st.binary(max_size=8), ARRAYS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=4)),
    max_leaves=8,
)


def _places(value: object, path: tuple[object, ...] = ()) -> list[tuple[object, ...]]:
    """Every place within nested maps and lists, eight levels down."""
    if len(path) == 8:
        return [path]
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, inner in items for place in _places(inner, (*path, key)))]


@st.composite
def misfit(draw: st.DrawFn, name: str) -> bytes:
    """A right map in which some values are of another kind, range or shape, or are missing."""
    head, values = draw(st.sampled_from(_maps(name)))
    value = msgpack.unpackb(msgpack.packb(values))
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.sampled_from(_places(value)[1:] or [()]))
        inner = value
        for key in place[:-1]:
            inner = inner[key]
        if place and draw(st.integers(0, 9)):
            inner[place[-1]] = draw(VALUES)
        elif place:
            del inner[place[-1]]
    return head + msgpack.packb(value)


def _maps(name: str) -> list[tuple[bytes, object]]:
    head = 1 if name == "fields" else 0
    found = []
    for seed in decoders.seeds(name):
        try:
            found.append((seed[:head], msgpack.unpackb(seed[head:])))
            msgpack.packb(found[-1][1])
        except ValueError:  # nested too deep to be taken apart and put together again
            found.pop()
    return [(start, values) for start, values in found if isinstance(values, dict)]


@pytest.mark.parametrize("name", PACKED)
def test_maps_with_values_that_do_not_fit(name: str) -> None:
    @settings(max_examples=150, **quick)
    @given(misfit(name))
    def feed(data: bytes) -> None:
        decoders.TARGETS[name](data)

    feed()
