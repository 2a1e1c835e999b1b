"""The package against the test vectors, which a program without its code has made from their JSON."""

import importlib.util
import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from protocol import cobs, link
from protocol.frames import SCHEMA, pack, unpack
from protocol.records import Record
from protocol.topics import TOPICS

spec = importlib.util.spec_from_file_location("make_vectors", Path(__file__).with_name("make_vectors.py"))
make_vectors = importlib.util.module_from_spec(spec)
spec.loader.exec_module(make_vectors)

VECTORS = make_vectors.VECTORS
FRAMES = sorted(p.stem for p in (VECTORS / "frames").glob("*.json"))
OLD = sorted(p.relative_to(VECTORS).with_suffix("") for p in VECTORS.glob("frames-schema-*/*.json"))
LINK = sorted(p.stem for p in (VECTORS / "link").glob("*.json"))


def load(folder, name):
    path = VECTORS / folder / f"{name}.json"
    return json.loads(path.read_text()), path.with_suffix(".bin").read_bytes()


def assert_same(value, wanted):
    """A decoded value is what the JSON says."""
    if isinstance(wanted, dict) and wanted.keys() == {"dtype", "shape", "values"}:
        assert (value.dtype, value.shape) == (np.dtype(wanted["dtype"]), tuple(wanted["shape"]))
        values = [complex(*map(float, v)) if isinstance(v, list) else float(v) for v in wanted["values"]]
        np.testing.assert_array_equal(value.reshape(-1), np.array(values, dtype=value.dtype))
    elif isinstance(wanted, dict):
        for key, inner in wanted.items():
            assert_same(value[key] if isinstance(value, dict) else getattr(value, key), inner)
    elif isinstance(wanted, list):
        assert len(value) == len(wanted)
        for one, inner in zip(value, wanted, strict=True):
            assert_same(one, inner)
    else:
        assert value == wanted and type(value) is type(wanted)


@pytest.mark.parametrize("name", FRAMES)
def test_frame(name):
    vector, message = load("frames", name)
    assert message == make_vectors.frame_bytes(vector), "run tests/protocol/make_vectors.py"
    frame = unpack(message)
    if name == "raw_non_finite":
        assert (frame.valid, frame.reasons) == (False, ["non_finite"])
        frame.valid, frame.reasons = True, []
    assert_same(frame, vector["fields"])
    assert pack(frame) == message


@pytest.mark.parametrize("path", OLD, ids=str)
def test_a_frame_of_an_older_schema_is_read(path):
    """As its file says; what it does not have is as it would have been said."""
    vector, message = load(path.parent, path.name)
    frame = unpack(message)
    if path.name == "raw_non_finite":
        assert (frame.valid, frame.reasons) == (False, ["non_finite"])
        frame.valid, frame.reasons = True, []
    gone = GONE.get(vector["topic"], set())
    assert_same(frame, {key: value for key, value in vector["fields"].items() if key not in gone})
    assert not any(hasattr(frame, key) for key in gone)
    assert frame.schema < SCHEMA and f"schema-{frame.schema}" in str(path)
    if vector["topic"] == "image" and frame.schema == 1:
        assert frame.reconstructed == 0
    assert isinstance(unpack(pack(frame)), type(frame))


GONE = {  # with schema 3
    "delta": {"stack", "context", "scale", "followed"},
    "part": {"followed", "began"},
    "image": {"followed"},
}
NEWER = {1: {"part", "reference", "judgements", "stack"}, 2: {"stack"}}  # topics that an older schema did not have


def test_every_topic_has_a_vector_of_every_older_schema():
    assert len({path.parent for path in OLD}) == SCHEMA - 1
    for folder in {path.parent for path in OLD}:
        topics = {load(folder, path.name)[0]["topic"] for path in OLD if path.parent == folder}
        assert topics == set(TOPICS) - NEWER[int(folder.name.rpartition("-")[2])]


def test_every_topic_and_every_field_has_a_vector():
    vectors = [load("frames", name)[0] for name in FRAMES]
    assert {v["topic"] for v in vectors} == set(TOPICS)
    for vector in vectors:
        assert list(vector["fields"]) == [name for name, _ in Record(TOPICS[vector["topic"]].frame).checks]


@pytest.mark.parametrize("name", LINK)
def test_link_message(name):
    vector, line = load("link", name)
    assert line == make_vectors.link_bytes(vector), "run tests/protocol/make_vectors.py"
    decoder = link.Decoder()
    (message,) = decoder.feed(line)
    assert message.wire_name == vector["message"] and decoder.bad == 0
    for key, wanted in vector["fields"].items():
        value = getattr(message, key)
        if key == "z":
            np.testing.assert_array_equal(value, np.array([complex(*map(float, z)) for z in wanted], "c8"))
        elif key == "unique_id":
            assert value == bytes.fromhex(wanted)
        else:
            np.testing.assert_array_equal(value, wanted)
    assert link.encode(message) == line


def test_every_link_message_has_a_vector():
    assert {load("link", name)[0]["message"] for name in LINK} == {m.wire_name for m in link.MESSAGES}


@pytest.mark.parametrize("pair", json.loads((VECTORS / "cobs.json").read_text()), ids=lambda p: p["plain"][:16])
def test_cobs(pair):
    plain, stuffed = bytes.fromhex(pair["plain"]), bytes.fromhex(pair["stuffed"])
    assert cobs.cobs_encode(plain) == stuffed == make_vectors.stuff(plain)
    assert cobs.cobs_decode(stuffed) == plain


def test_crc_check_value():
    assert zlib.crc32(b"123456789") == make_vectors.crc32(b"123456789") == 0xCBF43926
    assert zlib.crc32(b"123456789", 77) == make_vectors.crc32(b"123456789", 77)
