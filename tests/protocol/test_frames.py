"""What is on the wire: frames, the board's link, vectors, WIRE.md; what a line carries; what a controller installs."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
import zlib
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import ad5940, cobs, fields, frames, link, wire_doc
from protocol import frame_types as ft
from protocol.cobs import cobs_encode
from protocol.frames import SCHEMA, Contact, ContactFrame, DeltaFrame, FrameError, ImageFrame, RawFrame, pack, unpack
from protocol.metering import Meter
from protocol.part_size import BAUD, frame_bytes, line_load, line_s, parts_on_line
from protocol.records import Record
from protocol.scan_setting import COHERENT, NAMED, ScanSetting
from protocol.sockets import Publisher
from protocol.topics import TOPIC_OF, TOPICS, wire_topic
from tests.waiting import WAIT_S

from . import make_vectors
from .make_vectors import VECTORS
from .peers import ROOT, subscribed


def map_of(frame):
    return msgpack.unpackb(pack(frame).partition(b"\0")[2])


def contact_map(**changes):
    return map_of(ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0.01, 0.02, 0.0])])) | changes


def message(content, topic=b"contact/palm"):
    return topic + b"\0" + msgpack.packb(content)


def refused(data):
    with pytest.raises(FrameError) as caught:
        unpack(data)
    return caught.value


@pytest.mark.parametrize(("field", "value", "found", "expected"), [
    ("schema", 4, "schema 4", "schema 3 at most: who sent it is newer, update this reader"),
    ("schema", 0, "int 0", "int 1..3"),
    ("skin", "other", "'other'", "'palm', as in the message's topic"),
    ("skin", "pa/lm", "'pa/lm'", "text"),
    ("session", "0123", "'0123'", "[0-9a-f]{16}"),
    ("seq", -1, "int -1", "int 0.."),
    ("seq", True, "bool True", "int 0.."),
    ("scan", 2**63, "int 9223372036854775808", "2^63-1"),
    ("stamps", {"sample": -1}, "int -1", "int 0.."),
    ("source", "elsewhere", "'elsewhere'", '"board", "stub", "replay"'),
    ("valid", 1, "int 1", "bool"),
    ("reasons", "gap", "str 'gap'", "list of at most 64"),
    ("valid_for_s", -0.5, "float -0.5", "float 0.."),
    ("held", None, "None", "bool"),
    ("contacts", {}, "dict {}", "list of at most 256"),
])  # fmt: skip
def test_a_wrong_field_is_named_with_what_was_found_and_expected(field, value, found, expected):
    error = refused(message(contact_map(**{field: value})))
    assert error.topic == "contact" and error.field.startswith(field)
    assert found in error.found and expected in error.expected
    assert all(part in str(error) for part in ("contact", field, error.found, error.expected))


NEEDED = {
    ContactFrame: ("schema", "skin", "session", "seq", "host", "stamps", "sample_sigma_ns", "source", "contacts"),
    RawFrame: ("z", "status"), DeltaFrame: ("touched",), ImageFrame: ("touched",), ft.ForceFrame: ("wrench",),
    ft.TruthFrame: ("touches",),
}  # fmt: skip


@pytest.mark.parametrize("kind", NEEDED)
def test_a_missing_field_whose_default_would_claim_something_is_named(kind):
    """No frame says that nothing touches by saying nothing."""
    content = map_of(kind(skin="palm", **({"z": np.ones(3), "status": np.zeros(3)} if kind is RawFrame else {})))
    for field in NEEDED[kind]:
        less = {key: value for key, value in content.items() if key != field}
        error = refused(message(less, wire_topic(TOPIC_OF[kind].name, "palm")))
        assert (error.field, error.found) == (field, "nothing")


def test_other_missing_fields_take_their_defaults():
    """Written before there was such a field."""
    content = contact_map(valid=True, novelty=1, valid_for_s=1)  # what is not known is ignored, 1 passes for 1.0
    for field in ("held", "frame_id", "quality", "scan", "reasons"):
        del content[field]
    del content["contacts"][0]["orientation"], content["contacts"][0]["state"]
    frame = unpack(message(content))
    assert (frame.held, frame.frame_id, frame.quality, frame.scan, frame.reasons) == (False, "", None, 0, [])
    assert frame.valid and frame.valid_for_s == 1.0
    assert (frame.contacts[0].orientation, frame.contacts[0].state) == (0.0, "hold")
    del content["valid"], content["valid_for_s"]
    frame = unpack(message(content))
    assert frame.valid is False and frame.valid_for_s == 0.0, "nobody says that it may be acted on"


@pytest.mark.parametrize(
    ("key", "value"),
    [("position", [0.0, 0.0]), ("position", [0.0, "x", 0.0]), ("state", "x"), ("area_m2", -1.0), ("confidence", 1.5)],
)
def test_a_wrong_field_inside_a_contact_is_named_with_its_place_although_others_are_missing(key, value):
    content = contact_map()
    del content["held"]
    content["contacts"][0][key] = value
    assert refused(message(content)).field == f"contacts[0].{key}"


@pytest.mark.parametrize(("dtype", "shape", "data", "expected"), [
    ("<f4", [2], bytes(8), "<c8"),
    ("<c8", [2], bytes(15), "16 bytes"),
    ("<c8", [1, 2], bytes(16), "(K)"),
    ("<c8", [-2], bytes(16), "array"),
    ("<c8", [2**62, 2**62], b"", "bytes for shape"),
    ("<c8", [2**40, 2**40, 0], b"", "dimensions that multiply"),
    ("object", [2], bytes(16), "one of"),
    (None, [2], bytes(16), "array"),
    (None, None, None, "array"),
    ("<c8", [3], bytes(24), "length 3, as z has"),
])  # fmt: skip
def test_a_wrong_array_is_refused(dtype, shape, data, expected):
    given = {k: v for k, v in {"dtype": dtype, "shape": shape, "data": data}.items() if v is not None}
    raw = map_of(RawFrame(skin="palm", z=np.ones(2), status=np.zeros(2)))
    error = refused(message({**raw, "z": given or [1.0, 2.0]}, b"raw/palm"))
    assert error.field in ("z", "status") and expected in error.expected


def test_what_is_no_frame_is_refused():
    for data in (b"", b"\0", b"contact/palm", b"contact\0\x80", b"nothing/palm\0\x80", b"contact/../x\0\x80"):
        refused(data)
    for data in (b"", b"\xc1", b"\x80\x80", b"\x93\1\2\3", b"\x81\1\2", b"\xdf\xff\xff\xff\xff", b"\x81\xa1\xff\1"):
        refused(b"contact/palm\0" + data)
    for data in (b"\x81\xa1x\xc7\x01\x05x", b"\x81\xa1x" + b"\x91" * 5000, bytes(5 * 2**20)):
        refused(b"contact/palm\0" + data)


def test_free_content_has_a_depth_limit_and_text_keys():
    deep = None
    for _ in range(fields.MAX_DEPTH + 2):
        deep = [deep]
    content = map_of(ft.InfoFrame(skin="palm"))
    assert "levels" in refused(message({**content, "info": {"state": deep}}, b"info/palm")).expected
    with pytest.raises(FrameError, match="text keys"):
        pack(ft.InfoFrame(skin="palm", info={"state": {1: 2}}))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_measurements_are_data_and_make_a_frame_invalid(bad):
    for frame in (
        RawFrame(skin="palm", z=np.array([1, bad, 1], "c8"), status=np.zeros(3), valid=True),
        ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0.0, bad, 0.0])], valid=True),
        ImageFrame(skin="palm", image=np.full((2, 2), bad), valid=True, reasons=["low_snr"]),
    ):
        back = unpack(pack(frame))
        assert back.valid is False and back.reasons[-1] == "non_finite"
    unused = DeltaFrame(skin="palm", difference=np.zeros(2), sigma=np.array([1e-4, np.inf]), valid=True)
    assert unpack(pack(unused)).valid is True, "an infinite sigma means a measurement not used"


def test_a_frame_that_readers_would_refuse_is_not_packed_and_numpy_is_sent_as_plain_numbers():
    for frame in (
        ImageFrame(skin="palm", image=np.ones(3)),
        RawFrame(skin="palm", z=np.ones(3), status=np.zeros(2)),
        ContactFrame(skin="palm", contacts=[Contact(id=1, position=None)]),
        ft.ShapeFrame(skin="palm", ids=[1]),
    ):
        with pytest.raises(FrameError):
            pack(frame)
    touch = Contact(id=np.uint32(3), position=np.zeros(3, "f4"), force_n=np.float32(2))
    sent = map_of(ContactFrame(skin="palm", seq=np.int64(5), contacts=[touch]))
    assert json.loads(json.dumps(sent))["contacts"][0]["force_n"] == 2.0
    image = unpack(pack(ImageFrame(skin="palm", image=np.ones((96, 96))))).image
    assert image.base is not None and not image.flags.writeable and image.dtype == np.float32, "without a copy"


def full_frame(n=120, seq=0):
    z = (np.arange(n) + 1j).astype("c8")
    return link.ScanFrame(seq=seq, device_us=1, duration_us=45_000, config=1, z=z, status=np.arange(n) % 16)


def test_messages_survive_the_line_in_any_pieces():
    lines = [path.read_bytes() for path in sorted((VECTORS / "link").glob("*.bin"))]
    for piece in (1, 7, 50, 10_000):
        decoder, got, line = link.Decoder(), [], b"".join(lines)
        for at in range(0, len(line), piece):
            got += decoder.feed(line[at : at + piece])
        assert list(map(link.encode, got)) == lines and decoder.bad == 0


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_any_one_wrong_byte_or_a_cut_costs_that_frame_only_and_is_counted(at, flip):
    line = bytearray(link.encode(full_frame(seq=1)))
    assert 1040 < len(line) < 1060, "as the rates assume"
    at = 1 + at % (len(line) - 2)
    flipped = bytes(line[:at]) + bytes([line[at] ^ flip]) + bytes(line[at + 1 :])
    for damaged in (flipped, bytes(line[:at])):
        decoder = link.Decoder()
        assert [m.seq for m in decoder.feed(damaged + link.encode(full_frame(seq=2)))] == [2]
        assert (decoder.bad >= 1 and decoder.last_error) or damaged is not flipped


def raw_line(body, seed=link.SCHEMA_HASH):
    return b"\0" + cobs_encode(body + zlib.crc32(body, seed).to_bytes(4, "little")) + b"\0"


@pytest.mark.parametrize(("line", "what"), [
    (b"\0\5ab\0", "bad_cobs"),
    (b"\0\2a\0", "bad_crc"),
    (raw_line(b"\x84" + bytes(20), seed=1), "bad_crc"),
    (raw_line(b"\x7e123"), "unknown"),
    (raw_line(b"\x03"), "bad_payload"),
    (raw_line(b"\x03\1\0\0"), "bad_payload"),
    (raw_line(b"\x84" + bytes(18) + b"\0\0"), "bad_payload"),
    (raw_line(b"\x84" + bytes(18) + b"\2\0" + bytes(9)), "bad_payload"),
    (raw_line(b"\x02" + bytes(8) + b"\2\0" + bytes(4)), "bad_payload"),
    (b"\0" + b"\xff" * 20_000 + b"\0", "oversize"),
    (b"\xff" * 1_000_000, "oversize"),
])  # fmt: skip
def test_each_kind_of_damage_is_counted_under_its_name_and_takes_no_memory(line, what):
    for step in (1, 1000, len(line)) if len(line) < 10**6 else (10_000,):
        decoder = link.Decoder()
        for at in range(0, len(line), step):
            assert decoder.feed(line[at : at + step]) == [] and len(decoder._rest) < 2 * link.MAX_BODY
        assert dict(decoder.counts) == {what: 1} and decoder.last_error.startswith(what)


def test_another_schema_is_known_by_name_once_its_ident_has_come():
    other, decoder = link.SCHEMA_HASH ^ 1, link.Decoder()
    assert decoder.feed(link.encode(full_frame(), other)) == []
    (ident,) = decoder.feed(link.encode(link.Ident(schema_hash=other), other))
    assert ident.schema_hash == other and decoder.feed(link.encode(full_frame(), other)) == []
    assert dict(decoder.counts) == {"bad_crc": 1, "good": 1, "other_schema": 1}
    assert f"{other:08x}" in decoder.last_error and f"{link.SCHEMA_HASH:08x}" in decoder.last_error


def test_what_does_not_fit_its_message_is_not_sent_and_a_long_text_is_cut():
    scans = np.zeros((3, 3)), np.full((1, 4), 256), np.zeros((0, 4))
    messages = [link.Config(config=1, dft_points=256, rtia_ohm=1e3, scan=scan) for scan in scans]
    for n, of in ((3, 2), (600, 600)):
        messages.append(link.ScanFrame(0, 0, 0, 0, z=np.zeros(n), status=np.zeros(of, "u1")))
    for message in (*messages, link.Start(config=65536), link.Start(config=None)):
        with pytest.raises(link.LinkError, match=message.wire_name):
            link.encode(message)
    (event,) = link.Decoder().feed(link.encode(link.Event(code=1, text="x" + "ä" * 300)))
    assert event.text.startswith("xää") and len(event.text.encode()) <= link.MAX_TEXT + 2


def test_fifo_words_by_hand():
    """ECC 0, sequence 2, channel 31, data -1 and the extremes of 18-bit two's complement."""
    assert ad5940.encode_fifo(np.array([-1]), seq=2)[0] == 0b0000000_10_11111_111111111111111111
    words = ad5940.encode_fifo(np.array([131071, -131072, 131072, -200000]), channel=0)
    assert list(words) == [0x1FFFF, 0x20000, 0x1FFFF, 0x20000]
    for word in ((-131072, 0, 0, 127), (131071, 3, 31, 0), (77, 1, 12, 5)):
        words = ad5940.encode_fifo(np.array(word[:1]), *word[1:])
        assert tuple(int(x[0]) for x in ad5940.decode_fifo(words)) == word[:3]
    data, seq, channel = ad5940.decode_fifo(np.array([0xFFFFFFFF, 0x00020000, 0x0001FFFF], "u4"))
    assert list(data) == [-1, -131072, 131071] and (seq[0], channel[0]) == (3, 31)


def test_impedance_of_a_resistor_and_a_capacitor():
    """A current of 2 with RTIA 1000 and voltages of 3, 3j: 1500 ohm, and the imaginary sign as the chip inverts it."""
    current = ad5940.dft_pair(np.array([2000.0 + 0j, 2000.0, 0.0]))
    voltage = ad5940.dft_pair(np.array([3000.0 + 0j, -3000.0j, 1.0]))
    assert list(voltage[1]) == [0, 3000]
    z = ad5940.impedance(voltage, current, 1000.0)
    np.testing.assert_allclose(z[:2], [1500.0, -1500.0j])
    assert not np.isfinite(z[2])


def test_rates_are_of_the_time_since_the_last_measurement_and_quantiles_milliseconds() -> None:
    meter, began = Meter(), time.monotonic()
    meter.sent["contact"] += 200
    for at_s, rate in ((100.0, 2.0), (100.1, 2.0), (200.0, 0.0)):  # the second is too soon
        meter.measure(began + at_s)
        assert meter.rates["contact"] == pytest.approx(rate, rel=0.01)
    assert meter.quantiles() == {}
    for k in range(100):
        meter.handled(None, k * 1_000_000)
    assert meter.quantiles() == {"work_p50": 50.0, "work_p99": 99.0}, "no age is known"
    meter.handled(7_000_000, 0)
    assert meter.quantiles()["p50"] == meter.quantiles()["p99"] == 7.0


def test_a_message_is_as_long_as_it_is_encoded_and_a_line_gets_as_many_parts_as_it_carries():
    """The quickest setting measures a part of twelve in 1.48 ms, which is the line's time for it."""
    for count in (1, 7, 12, 60, 120, 512):
        values = np.random.default_rng(count).standard_normal((count, 2)).astype("f4").view("c8")[:, 0]
        message = link.ScanFrame(2**31 + 1, 2**60 + 1, 4358, 7, values, np.zeros(count, np.uint8), 3, 10)
        found = len(link.encode(message))
        assert frame_bytes(count) - found in range(1 + found // 254)  # runs that a 0 ends need no byte
    assert line_s(12, 921_600) == pytest.approx(1.43e-3, rel=0.02)
    quickest = ScanSetting(50_000, 32)
    for setting in (*NAMED.values(), quickest):
        assert parts_on_line(120, 10, setting, 2_000_000) == 10
        assert (parts_on_line(120, 10, setting, BAUD) == 10) == (setting is not quickest)
    assert line_load(120, 10, quickest, BAUD) > 0.9 and parts_on_line(120, 1, COHERENT, BAUD) == 1
    bauds = (921_600, 400_000, 350_000, 320_000, 9_600)
    found = [parts_on_line(120, 10, COHERENT, baud) for baud in bauds]
    assert found == sorted(found, reverse=True) and found[0] == 10 and found[-1] == 1 and len(set(found)) > 2
    assert all(line_load(120, parts, COHERENT, baud) <= 0.8 for baud, parts in zip(bauds[:3], found))  # noqa: B905


FRAMES = sorted(p.stem for p in (VECTORS / "frames").glob("*.json"))
OLD = sorted(p.relative_to(VECTORS).with_suffix("") for p in VECTORS.glob("frames-schema-*/*.json"))
LINK = sorted(p.stem for p in (VECTORS / "link").glob("*.json"))


def load(folder, name):
    path = VECTORS / folder / f"{name}.json"
    return json.loads(path.read_text()), path.with_suffix(".bin").read_bytes()


def assert_same(value, wanted):
    if isinstance(wanted, dict) and wanted.keys() == {"dtype", "shape", "values"}:
        assert (value.dtype, value.shape) == (np.dtype(wanted["dtype"]), tuple(wanted["shape"]))
        values = [complex(*map(float, v)) if isinstance(v, list) else float(v) for v in wanted["values"]]
        np.testing.assert_array_equal(value.reshape(-1), np.array(values, dtype=value.dtype))
    elif isinstance(wanted, dict):
        for key, inner in wanted.items():
            assert_same(value[key] if isinstance(value, dict) else getattr(value, key), inner)
    elif isinstance(wanted, list):
        for one, inner in zip(value, wanted, strict=True):
            assert_same(one, inner)
    else:
        assert value == wanted and type(value) is type(wanted)


# with schema 3
GONE = {"delta": {"stack", "context", "scale", "followed"}, "part": {"followed", "began"}}
GONE |= {"image": {"followed", "refined"}, "force": {"refined"}, "shape": {"refined"}}
GONE |= {"contact": {"refined", "kind", "kind_probability", "area_sigma_m2"}}


def without(gone, value):
    if isinstance(value, dict):
        return {key: without(gone, inner) for key, inner in value.items() if key not in gone}
    return [without(gone, inner) for inner in value] if isinstance(value, list) else value


@pytest.mark.parametrize("path", [*(Path("frames", name) for name in FRAMES), *OLD], ids=str)
def test_a_frame_is_read_as_its_file_says(path):
    """Of this and of older schemas: what one does not have is as it would have been said."""
    vector, message = load(path.parent, path.name)
    frame = unpack(message)
    if path.name == "raw_non_finite":
        assert (frame.valid, frame.reasons) == (False, ["non_finite"])
        frame.valid, frame.reasons = True, []
    if path not in OLD:
        assert message == make_vectors.frame_bytes(vector), "run tests/protocol/make_vectors.py"
        assert_same(frame, vector["fields"])
        assert pack(frame) == message
        return
    gone = GONE.get(vector["topic"], set())
    assert_same(frame, without(gone, vector["fields"]))
    assert not any(hasattr(frame, key) for key in gone)
    assert frame.schema < SCHEMA and f"schema-{frame.schema}" in str(path)
    assert (vector["topic"], frame.schema) != ("image", 1) or frame.reconstructed == 0
    assert isinstance(unpack(pack(frame)), type(frame))


def test_every_topic_field_and_message_has_a_vector():
    vectors = [load("frames", name)[0] for name in FRAMES]
    assert {v["topic"] for v in vectors} == set(TOPICS)
    for vector in vectors:
        assert list(vector["fields"]) == [name for name, _ in Record(TOPICS[vector["topic"]].frame).checks]
    assert len({path.parent for path in OLD}) == SCHEMA - 1
    assert {load("link", name)[0]["message"] for name in LINK} == {m.wire_name for m in link.MESSAGES}


@pytest.mark.parametrize("name", LINK)
def test_link_message(name):
    vector, line = load("link", name)
    assert line == make_vectors.link_bytes(vector), "run tests/protocol/make_vectors.py"
    (message,) = link.Decoder().feed(line)
    assert message.wire_name == vector["message"] and link.encode(message) == line
    for key, wanted in vector["fields"].items():
        if key == "z":
            wanted = np.array([complex(*map(float, z)) for z in wanted], "c8")
        elif key == "unique_id":
            wanted = bytes.fromhex(wanted)
        np.testing.assert_array_equal(getattr(message, key), wanted)


def test_cobs():
    for pair in json.loads((VECTORS / "cobs.json").read_text()):
        plain, stuffed = bytes.fromhex(pair["plain"]), bytes.fromhex(pair["stuffed"])
        assert cobs.cobs_encode(plain) == stuffed == make_vectors.stuff(plain) and cobs.cobs_decode(stuffed) == plain


def test_wire_md_is_current():
    text = wire_doc.WIRE_MD.read_text()
    assert wire_doc.generate(text) == text, "run python -m protocol.wire_doc"
    assert all(f"`{reason}`" in text for reason in frames.REASONS)


@pytest.mark.live
@pytest.mark.parametrize(("document", "variable"), [("protocol/WIRE.md", "EITSKIN_RUNTIME"), ("README.md", "XDG_")])
def test_the_ten_lines_print_contacts_and_when_not_to_act(document, variable, runtime, context, monkeypatch):
    """In the folder where the service puts its sockets, also on a desktop, which sets XDG_RUNTIME_DIR."""
    monkeypatch.delenv("EITSKIN_RUNTIME")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    if variable == "EITSKIN_RUNTIME":
        monkeypatch.setenv(variable, f"{runtime}/here")
    code = re.search(r"```python\n(import msgpack.*?)```", (ROOT / document).read_text(), re.DOTALL)[1]
    publisher = Publisher("publisher", context)
    process = subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        subscribed(publisher)
        now = time.monotonic_ns()
        contact = Contact(id=1, position=[0.02, -0.01, 0.0], force_n=1.0)
        for n, (valid, sample) in enumerate(((True, now), (False, now), (True, now - 60 * 10**9), (True, 2 * now))):
            frame = ContactFrame(skin="palm", scan=n, valid=valid, valid_for_s=30.0, contacts=[contact])
            frame.stamps = {"sample": sample, "publish": now}
            publisher.send(frame)
            assert process.stdout.readline() == f"{n} {n == 0} [([0.02, -0.01, 0.0], 1.0)]\n"
        assert process.wait(WAIT_S) == 0, "silence"
    finally:
        process.kill()
        process.communicate()


ALONE = """
import runpy, sys

class Only:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top not in sys.stdlib_module_names and top not in ("eitskin", "numpy", "zmq", "msgpack"):
            raise ImportError(f"{name} is not there")

sys.path.insert(0, sys.argv[1])
sys.meta_path.insert(0, Only())
runpy.run_path(sys.argv[2])
"""


@pytest.mark.live
def test_the_wheel_is_the_client_alone(runtime, tmp_path):
    """What `pip install .` builds, in a copy of what it reads: typed, every module of protocol/, three packages."""
    source = tmp_path / "source"
    shutil.copytree(ROOT / "protocol", source / "protocol", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    built = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run([*built, "-w", tmp_path, source], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("eitskin-*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
        (metadata,) = (file.read(name).decode() for name in file.namelist() if name.endswith(".dist-info/METADATA"))
    modules = {f"eitskin/{path.name}" for path in (ROOT / "protocol").glob("*.py")}
    assert names == modules | {"eitskin/py.typed", "eitskin/WIRE.md"}
    needs = re.findall(r"^Requires-Dist: ([a-z]+)[^;\n]*$", metadata, re.MULTILINE)
    assert set(needs) == {"numpy", "pyzmq", "msgpack"}
    alone = [sys.executable, "-P", "-c", ALONE, wheel, ROOT / "tests/protocol/use_the_wheel.py"]
    done = subprocess.run(alone, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0 and "no contact frame of palm yet" in done.stdout, done.stderr
