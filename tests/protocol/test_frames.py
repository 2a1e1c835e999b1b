"""Frames: what decode refuses and how it says so; garbage never gets further than FrameError."""

import json
import math

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import fields
from protocol.frames import (
    Contact,
    ContactFrame,
    DeltaFrame,
    ForceFrame,
    FrameError,
    ImageFrame,
    InfoFrame,
    RawFrame,
    ShapeFrame,
    TruthFrame,
    pack,
    unpack,
)
from protocol.topics import TOPIC_OF, TOPICS, wire_topic


def contact_map(**changes):
    frame = ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0.01, 0.02, 0.0])])
    return {**msgpack.unpackb(pack(frame).partition(b"\0")[2]), **changes}


def message(content, topic=b"contact/palm"):
    return topic + b"\0" + msgpack.packb(content)


def refused(data):
    with pytest.raises(FrameError) as caught:
        unpack(data)
    return caught.value


@pytest.mark.parametrize(
    ("field", "value", "found", "expected"),
    [
        ("schema", 4, "schema 4", "schema 3 at most: who sent it is newer, update this reader"),
        ("schema", 0, "int 0", "int 1..3"),
        ("schema", "2", "str '2'", "int 1..3"),
        ("skin", "other", "'other'", "'palm', as in the message's topic"),
        ("skin", "pa/lm", "'pa/lm'", "text"),
        ("session", "0123", "'0123'", "[0-9a-f]{16}"),
        ("seq", -1, "int -1", "int 0.."),
        ("seq", 1.0, "float 1.0", "int 0.."),
        ("seq", True, "bool True", "int 0.."),
        ("scan", 2**63, "int 9223372036854775808", "2^63-1"),
        ("stamps", {"sample": -1}, "int -1", "int 0.."),
        ("stamps", [1], "list [1]", "map of text to int"),
        ("source", "elsewhere", "'elsewhere'", '"board", "stub", "replay"'),
        ("valid", 1, "int 1", "bool"),
        ("reasons", "gap", "str 'gap'", "list of at most 64"),
        ("reasons", [None], "None", "text"),
        ("valid_for_s", -0.5, "float -0.5", "float 0.."),
        ("held", None, "None", "bool"),
        ("frame_id", b"palm", "bytes of length 4", "text"),
        ("contacts", {}, "dict {}", "list of at most 256"),
    ],
)
def test_a_wrong_field_is_named_with_what_was_found_and_expected(field, value, found, expected):
    error = refused(message(contact_map(**{field: value})))
    assert error.topic == "contact"
    assert error.field.startswith(field)
    assert found in error.found
    assert expected in error.expected
    assert all(part in str(error) for part in ("contact", field, error.found, error.expected))


@pytest.mark.parametrize(
    "field",
    ["schema", "skin", "session", "seq", "host", "stamps", "sample_sigma_ns", "source", "contacts"],
)
def test_a_missing_field_whose_default_would_claim_something_is_named(field):
    content = contact_map()
    del content[field]
    error = refused(message(content))
    assert (error.field, error.found) == (field, "nothing")


@pytest.mark.parametrize("kind", [RawFrame, DeltaFrame, ImageFrame, ForceFrame, TruthFrame])
def test_no_frame_says_that_nothing_touches_by_saying_nothing(kind):
    needed = {"raw": ("z", "status"), "delta": ("touched",), "image": ("touched",), "force": ("wrench",)}
    topic = TOPIC_OF[kind].name
    given = {"z": np.ones(3), "status": np.zeros(3)} if kind is RawFrame else {}
    content = msgpack.unpackb(pack(kind(skin="palm", **given)).partition(b"\0")[2])
    for field in needed.get(topic, ("touches",)):
        less = {key: value for key, value in content.items() if key != field}
        assert refused(message(less, wire_topic(topic, "palm"))).field == field


def test_other_missing_fields_take_their_defaults():
    """Written before there was such a field."""
    content = contact_map(valid=True)
    for field in ("held", "frame_id", "quality", "scan", "reasons"):
        del content[field]
    del content["contacts"][0]["orientation"], content["contacts"][0]["state"]
    frame = unpack(message(content))
    assert (frame.held, frame.frame_id, frame.quality, frame.scan, frame.reasons) == (False, "", None, 0, [])
    assert frame.valid and (frame.contacts[0].orientation, frame.contacts[0].state) == (0.0, "hold")
    del content["valid"], content["valid_for_s"]
    frame = unpack(message(content))
    assert frame.valid is False and frame.valid_for_s == 0.0, "nobody says that it may be acted on"


def test_a_wrong_field_is_refused_although_others_are_missing():
    content = contact_map(frame_id=3)
    del content["held"]
    assert refused(message(content)).field == "frame_id"
    content = contact_map()
    del content["held"], content["contacts"][0]["position"]
    assert refused(message(content)).field == "contacts[0].position"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("state", "gone"),
        ("position", [0.0, 0.0]),
        ("position", [0.0, "x", 0.0]),
        ("area_m2", -1.0),
        ("confidence", 1.5),
    ],
)
def test_a_wrong_field_inside_a_contact_is_named_with_its_place(key, value):
    content = contact_map()
    content["contacts"][0][key] = value
    assert refused(message(content)).field == f"contacts[0].{key}"


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        ({"dtype": "<f4", "shape": [2], "data": bytes(8)}, "<c8"),
        ({"dtype": "<c8", "shape": [2], "data": bytes(15)}, "16 bytes"),
        ({"dtype": "<c8", "shape": [1, 2], "data": bytes(16)}, "(K)"),
        ({"dtype": "<c8", "shape": [-2], "data": bytes(16)}, "array"),
        ({"dtype": "<c8", "shape": [2**62, 2**62], "data": b""}, "bytes for shape"),
        ({"dtype": "<c8", "shape": [2**40, 2**40, 0], "data": b""}, "dimensions that multiply"),
        ({"dtype": "<c8", "shape": [0, 2**63], "data": b""}, "dimensions that multiply"),
        ({"dtype": "object", "shape": [2], "data": bytes(16)}, "one of"),
        ({"dtype": ["<c8"], "shape": [2], "data": bytes(16)}, "one of"),
        ({"dtype": "<c8", "shape": 2, "data": bytes(16)}, "array"),
        ({"shape": [2], "data": bytes(16)}, "array"),
        ([1.0, 2.0], "array"),
        ({"dtype": "<c8", "shape": [3], "data": bytes(24)}, "length 3, as z has"),
    ],
)
def test_a_wrong_array_is_refused(array, expected):
    raw = msgpack.unpackb(pack(RawFrame(skin="palm", z=np.ones(2), status=np.zeros(2))).partition(b"\0")[2])
    error = refused(message({**raw, "z": array}, b"raw/palm"))
    assert error.field in ("z", "status")
    assert expected in error.expected


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0",
        b"contact/palm",
        b"contact/palm\0",
        b"contact\0\x80",
        b"nothing/palm\0\x80",
        b"contact/../x\0\x80",
        b"contact/palm\0\xc1",
        b"contact/palm\0\x80\x80",
        b"contact/palm\0\x93\1\2\3",
        b"contact/palm\0\x81\1\2",
        b"contact/palm\0\xdf\xff\xff\xff\xff",
        b"contact/palm\0\xdd\xff\xff\xff\xff",
        b"contact/palm\0\x81\xa1x\xc7\x01\x05x",
        b"contact/palm\0\x81\xa1x" + b"\x91" * 5000,
        b"contact/palm\0\x81\xa1\xff\1",
        b"contact/palm\0" + bytes(5 * 2**20),
        b"cos\nsystem\n(S'true'\ntR.",
    ],
    ids=lambda d: repr(d[:24]),
)
def test_what_is_no_frame_is_refused(data):
    refused(data)


def test_extension_types_are_refused_wherever_they_are():
    assert "not one msgpack value" in refused(message(contact_map(novelty=msgpack.Timestamp(1)))).found


def test_free_content_has_a_depth_limit_and_text_keys():
    deep = None
    for _ in range(fields.MAX_DEPTH + 2):
        deep = [deep]
    content = msgpack.unpackb(pack(InfoFrame(skin="palm")).partition(b"\0")[2])
    assert "levels" in refused(message({**content, "info": {"state": deep}}, b"info/palm")).expected
    with pytest.raises(FrameError, match="text keys"):
        pack(InfoFrame(skin="palm", info={"state": {1: 2}}))


def test_unknown_keys_are_ignored_and_whole_numbers_pass_for_floats():
    content = contact_map(novelty=1, valid_for_s=1)
    content["contacts"][0]["position"] = [1, 2, 3]
    frame = unpack(message(content))
    assert frame.valid_for_s == 1.0 and isinstance(frame.contacts[0].position[0], float)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_measurements_are_data_and_make_a_frame_invalid(bad):
    z = np.ones(3, "c8")
    z[1] = bad
    contact = Contact(id=1, position=[0.0, bad, 0.0])
    image = np.full((2, 2), bad)
    for frame in (
        RawFrame(skin="palm", z=z, status=np.zeros(3), valid=True),
        ContactFrame(skin="palm", contacts=[contact], valid=True),
        ImageFrame(skin="palm", image=image, valid=True, reasons=["low_snr"]),
    ):
        back = unpack(pack(frame))
        assert back.valid is False
        assert back.reasons[-1] == "non_finite"


def test_an_infinite_sigma_means_a_measurement_not_used():
    frame = DeltaFrame(skin="palm", difference=np.zeros(2), sigma=np.array([1e-4, np.inf]), valid=True)
    assert unpack(pack(frame)).valid is True


def test_arrays_are_read_without_a_copy_and_only():
    frame = unpack(pack(ImageFrame(skin="palm", image=np.ones((96, 96)))))
    assert frame.image.base is not None and not frame.image.flags.writeable
    assert frame.image.dtype == np.float32


def test_a_frame_that_readers_would_refuse_is_not_packed():
    for frame in (
        ImageFrame(skin="palm", image=np.ones(3)),
        RawFrame(skin="palm", z=np.ones(3), status=np.zeros(2)),
        ContactFrame(skin="palm", contacts=[Contact(id=1, position=None)]),
        ShapeFrame(skin="palm", ids=[1]),
    ):
        with pytest.raises(FrameError):
            pack(frame)


def test_numpy_scalars_are_sent_as_plain_numbers():
    frame = ContactFrame(
        skin="palm",
        seq=np.int64(5),
        contacts=[Contact(id=np.uint32(3), position=np.zeros(3, "f4"), force_n=np.float32(2))],
    )
    assert json.loads(json.dumps(msgpack.unpackb(pack(frame).partition(b"\0")[2])))["contacts"][0]["force_n"] == 2.0


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200))
def test_random_bytes_are_refused(data):
    for start in (b"", b"contact/palm\0", b"raw/palm\0", b"info/palm\0"):
        with pytest.raises(FrameError):
            unpack(start + data)


ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(TOPICS)), st.data())
def test_any_value_in_any_field_is_a_frame_or_a_frame_error(topic, data):
    """From the vectors' frames, with one field replaced by anything."""
    from tests.protocol.test_vectors import VECTORS  # the files, not our own output

    name = wire_topic(topic, "palm")
    content = msgpack.unpackb((VECTORS / "frames" / f"{topic}.bin").read_bytes().partition(b"\0")[2])
    content[data.draw(st.sampled_from(sorted(content)))] = data.draw(ANYTHING)
    try:
        frame = unpack(message(content, name))
    except FrameError as error:
        assert error.topic == topic and error.field and error.found and error.expected
    else:
        pack(frame)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_changed_byte_is_a_frame_or_a_frame_error(data):
    good = bytearray(message(contact_map()))
    good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    try:
        unpack(bytes(good))
    except FrameError:
        pass
