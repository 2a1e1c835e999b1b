"""Recordings: cut, killed or damaged, they give what was before; what they carry; a replay gives the same contacts."""

import json
import os
import random
import re
import struct
import tomllib
import tracemalloc
from dataclasses import asdict
from pathlib import Path

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import lz4, zstandard

from models import bundle as bundles
from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame, pack
from protocol.runtime import lock
from services.contacts.force import calibration_file as calibration
from services.contacts.force.curve import Curve
from services.pipeline import Pipeline
from services.recordings import settings
from services.recordings.damage import Damage
from services.recordings.importing import import_arrays
from services.recordings.mcap_scan import MAX_RECORD, McapScan, inner_records
from services.recordings.recorder import metadata
from services.recordings.recording import RecordedMessage, RecordingError, RecordingReader, RecordingWriter
from services.recordings.replay import ReplayError, mark, steps
from services.recordings.replay_session import configuration_of, replay_file
from services.runtime.config import ROOT, ConfigFile, Skin, load, parse
from tests.services.conftest import Board

from .feed import contacts_in

MAGIC = b"\x89MCAP0\r\n"


def written(path: Path, n: int) -> list[RecordedMessage]:
    rng, sent = random.Random(7), []
    with RecordingWriter(path, {"version": "1"}) as writer:
        for k in range(n):
            topic, data = ("raw/palm", "contact/palm")[k % 2], rng.randbytes(rng.randint(1, 900))
            sent.append(RecordedMessage(topic, 10**18 + k * 20_000_000, data))
            writer.write(topic, data, sent[-1].log_time_ns)
            if k % 5 == 4:
                writer.flush()
    return sent


def test_what_was_written_is_read_by_us_and_by_the_librarys_own_reader(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent, reader = written(path, 40), RecordingReader(path)
    assert list(reader.messages()) == sent and reader.metadata == {"version": "1"}
    assert not reader.damage.truncated and str(reader.damage) == "whole"
    with open(path, "rb") as file:
        rows = [(c.topic, c.message_encoding, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    assert rows == [(s.topic, "msgpack", s.log_time_ns, s.data) for s in sent]
    wanted = [s for s in sent if s.topic == "raw/palm" and s.log_time_ns >= sent[0].log_time_ns + 300_000_000]
    assert list(RecordingReader(path).messages({"raw"}, start_s=0.3)) == wanted
    with pytest.raises(RecordingError, match="overwrite"):
        RecordingWriter(path)
    RecordingWriter(tmp_path / "empty.mcap", {"version": "1"}).close()  # leaves no file
    for count in (0, 1):  # what is there stays until a message is in the new one
        with RecordingWriter(path, overwrite=True) as writer:
            assert len(list(RecordingReader(path).messages())) == 40
            if count:
                writer.write("raw/palm", b"", 1)
        assert len(list(RecordingReader(path).messages())) == (40, 1)[count] and [*tmp_path.iterdir()] == [path]


def test_cut_anywhere_it_gives_a_prefix_of_the_messages_at_most_one_chunk_short(tmp_path: Path) -> None:
    whole, cut, rng, seen = tmp_path / "whole.mcap", tmp_path / "cut.mcap", random.Random(11), set()
    sent, content = written(whole, 120), whole.read_bytes()
    for offset in (rng.randrange(8, len(content)) for _ in range(200)):
        cut.write_bytes(content[:offset])
        reader = RecordingReader(cut)
        got = list(reader.messages())
        assert got == sent[: len(got)] and (reader.damage.truncated or len(got) == len(sent)), offset
        missing = sum(len(s.data) for s in sent[len(got) : len(got) + 5])
        assert reader.damage.lost_bytes < missing + 1000 and not reader.damage.whole  # a chunk with its index
        seen.add(len(got))
    assert len(seen) > 15


def test_each_byte_of_a_small_file_may_be_wrong(tmp_path: Path) -> None:
    """At most the chunk that has it is lost, nothing is invented, and what is missing is counted."""
    path, sent = tmp_path / "a.mcap", [RecordedMessage(f"raw/{s}", k, bytes([k])) for k in range(3) for s in "ab"]
    with RecordingWriter(path, {"version": "1"}) as writer:
        first = path.stat().st_size  # where the first chunk begins, with its kind and length
        for k, message in enumerate(sent):
            writer.write(message.topic, message.data, message.log_time_ns)
            if k % 2:
                writer.flush()
    content = path.read_bytes()
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ (1 << at % 8)]) + content[at + 1 :])
        reader = RecordingReader(path)
        got = list(reader.messages())
        lost = len(sent) - len(got)
        assert lost in (0, 2) and [m for m in sent if m in got] == got and reader.metadata == {"version": "1"}, at
        assert reader.damage.missing.total() == lost and not (reader.damage.whole and (lost or 0 <= at - first < 9)), at


def raws(path: Path, first: int, chunks: int) -> tuple[bytes, list[int]]:
    """A recording with one scan a chunk, and where each chunk begins."""
    at = []
    with RecordingWriter(path, {"version": "1"}) as writer:
        for scan in range(first, first + chunks):
            at.append(path.stat().st_size)
            frame = RawFrame(skin="palm", scan=scan, z=np.full(20, scan, "c8"), status=np.zeros(20, "u1"))
            writer.write("raw/palm", pack(frame).partition(b"\0")[2], scan)
            writer.flush()
    return path.read_bytes(), at


@pytest.mark.parametrize(("what", "left", "says"), [
    ("magic", "0123456789", "8 bytes damaged in 1 place(s), the first at byte 0; no message is missing"),
    ("first chunk", "123456789", "1 message(s) cannot be read: raw/palm 1 (up to scan 100)"),
    ("chunks 3, 4 and 7", "01256 89", "3 message(s) cannot be read: raw/palm 3 (scans 103 to 104, scan 107)"),
    ("last chunk", "012345678", "1 message(s) cannot be read: raw/palm 1 (after scan 108)"),
    ("first chunk, cut", "12345", "cut short: it has no end; .*at least 1 message(s) cannot be read"),
    ("end", "0123456789", "its index is damaged; how many messages are missing is not known"),
    ("zeros behind", "0123456789", "5000 bytes zeros in 1 place(s), the first at byte .*; no message is missing"),
    ("zeros from 6 on", "012345", "cut short: it has no end; .* bytes damaged in 1 place"),
    ("joined", "01234567890123456789", "2 recordings joined$"),
    ("cut, joined", "0123450123456789", "2 recordings joined; cut short"),
    ("begun anew", "0123456789", "2 recordings joined; cut short: .*6 chunk(s) that stand there twice are read once$"),
    ("copied twice", "0123456789", "3 chunk(s) that stand there twice are read once; no message is missing"),
    ("chunks alone", "012345678", "cut short: it has no end; 0 bytes damaged in 1 place(s), the first at byte 0$"),
])  # fmt: skip
def test_what_is_left_is_read_and_the_rest_counted(tmp_path: Path, what: str, left: str, says: str) -> None:
    path = tmp_path / "a.mcap"
    (later, _), (content, at) = raws(tmp_path / "b.mcap", 200, 10), raws(path, 100, 10)
    spoilt = bytearray(content)
    places = {"magic": [0], "first chunk": [at[0]], "last chunk": [at[9]], "first chunk, cut": [at[0]]}
    places |= {"chunks 3, 4 and 7": [at[3], at[4], at[7]], "end": [content.rindex(b"\x0b") + 20]}
    for place in places.get(what, []):
        inside = place + (150 if place in at else 0)
        spoilt[inside : inside + 8] = bytes(byte ^ 0x5A for byte in spoilt[inside : inside + 8])
    whole, cut = bytes(spoilt), bytes(spoilt[: at[6] + 30])
    longer = {"first chunk, cut": cut, "zeros behind": whole + bytes(5000), "zeros from 6 on": cut[:-30] + bytes(4096)}
    longer |= {"joined": later + whole, "cut, joined": cut + later, "begun anew": cut + whole}
    longer |= {"copied twice": whole[: at[6]] + whole[at[3] :], "chunks alone": whole[at[0] : at[9]]}
    path.write_bytes(longer.get(what, whole))
    reader = RecordingReader(path)
    assert "".join(str(m.log_time_ns % 10) for m in reader.messages()) == left.replace(" ", "")
    assert re.search(says.replace("(", r"\(").replace(")", r"\)"), str(reader.damage)), str(reader.damage)
    assert reader.metadata == {"version": "1"} or what == "chunks alone"
    assert reader.damage.whole == (what == "joined")


def test_without_channels_topics_are_known_by_fields_and_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    content, _ = raws(path, 0, 1)
    body = inner_records(next(r.body for r in McapScan(path.open("rb"), Damage()).records() if r.kind == 6))
    path.write_bytes(MAGIC + b"".join(struct.pack("<BQ", kind, len(b)) + b for kind, b in body if kind == 5))
    assert [message.topic for message in RecordingReader(path).messages()] == ["raw/palm"]
    for content in (b"", b"PK\3\4 a zip file", MAGIC[:-1]):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="not a recording"):
            RecordingReader(path)


def chunk(compression: str, declared: int, data: bytes) -> bytes:
    body = struct.pack("<QQQII", 0, 1, declared, 0, len(compression)) + compression.encode()
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


def made(path: Path, *records: bytes) -> Path:
    path.write_bytes(MAGIC + b"".join(records))
    return path


def test_a_chunk_that_declares_too_much_is_left_out_and_said(tmp_path: Path) -> None:
    sparse = made(tmp_path / "b.mcap", struct.pack("<BQ", 6, 2**39))
    os.truncate(sparse, 2**39 + 1000)  # and takes no memory
    huge = zstandard.compress(bytes(MAX_RECORD + 1))
    for path, says in ((made(tmp_path / "a.mcap", chunk("zstd", MAX_RECORD + 1, huge)), "more"), (sparse, "zeros")):
        reader = RecordingReader(path)
        assert list(reader.messages()) == [] and says in str(reader.damage)


@pytest.mark.parametrize("declared", [0, 100, 10**6])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "", "brotli"])
def test_a_chunk_that_unpacks_to_something_else_is_damaged(tmp_path: Path, compression: str, declared: int) -> None:
    """Nothing is unpacked beyond what is declared, whatever the compressed stream says of itself."""
    data = bytes(2**22)
    packed = {"zstd": zstandard.compress(data), "lz4": lz4.compress(data)}.get(compression, data)
    reader = RecordingReader(made(tmp_path / "a.mcap", chunk(compression, declared, packed)))
    tracemalloc.start()
    assert list(reader.messages()) == [] and reader.damage.bad_chunks == 1
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 3 * len(packed) + 2 * declared + 2**20


@pytest.fixture
def touches() -> dict[str, np.ndarray]:
    """30 rows of the bundle's own physics: nothing, then a touch that moves, then nothing; 80 dB."""
    board = Board(Bundle.load("square16"), seed=5)
    discs = [board.disc(0.03 * k, -0.2, 0.2, 0.3 * (8 <= k < 24)) for k in range(30)]
    untouched, touched = ([board.frame(disc).z.real for disc in each] for each in ([0.0] * 64, discs))
    return {"untouched": np.array(untouched), "measurements": np.array(touched)}


@pytest.fixture
def recording(touches: dict[str, np.ndarray], tmp_path: Path) -> Path:
    path = tmp_path / "touches.mcap"
    import_arrays(touches, Path("touches.npz"), path, "palm", 22.0)
    return path


def raws_of(path: Path) -> list[RawFrame]:
    return [step.raw for step in steps(RecordingReader(path)) if step.raw is not None]


def same(live: list[ContactFrame], path: Path) -> None:
    for one, other in zip(live, contacts_in(path), strict=True):
        assert (one.scan, one.part, one.valid, one.held) == (other.scan, other.part, other.valid, other.held)
        assert [asdict(c) for c in one.contacts] == [asdict(c) for c in other.contacts], one.scan


@pytest.mark.live
def test_a_replay_of_a_file_that_was_cut_gives_the_contacts_of_one_process(recording: Path, tmp_path: Path) -> None:
    pipeline, out, cut = Pipeline("square16", name="palm"), tmp_path / "out.mcap", tmp_path / "cut.mcap"
    live = [pipeline.run(mark(raw) or raw).contact for raw in raws_of(recording)]
    states = [[c.state for c in frame.contacts] for frame in live]
    assert states[64:72] == [[]] * 8 and states[72] == ["begin"] and states[73:88] == [["hold"]] * 15
    assert [s for s in states[88:] if s] == [["end"]], "it ends once, and is not there any more"
    x = [frame.contacts[0].position[0] for frame in live[72:88]]
    assert np.corrcoef(x, np.arange(8, 24))[0, 1] > 0.99 and abs(x[0] - 0.012) < 0.004
    cut.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * 0.9)])
    report = replay_file(cut, None, out=out, private=True)
    frames = report["frames"]
    assert "cut short" in report["damage"] and report["warnings"] == [] and 72 < frames == report["contacts"] < 94
    same(live[:frames], out)
    again = contacts_in(out)
    assert [f.seq for f in again] == list(range(frames))
    assert all(f.source == "replay" and "replay" in f.reasons for f in again)
    recorded = [m.log_time_ns for m in RecordingReader(recording).messages({"raw"})]
    assert [m.log_time_ns for m in RecordingReader(out).messages({"contact"})] == recorded[:frames]


def test_a_replayed_frame_says_so_and_counts_from_when_it_is_read() -> None:
    raw = RawFrame(skin="palm", z=np.array([1, np.nan], "c8"), status=np.zeros(2, "u1"), source="board", host="x")
    raw.stamps = {"sample": 5, "read": 6}
    mark(raw)
    assert (raw.source, raw.host, raw.stamps["sample"], raw.reasons) == ("replay", "", 5, ["replay"])
    assert raw.stamps["read"] > 6


def test_steps_begin_with_the_recorded_state(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for k in range(10):
            frame = RawFrame(skin="palm", scan=k, z=np.ones(120, "c8"), status=np.zeros(120, "u1"))
            writer.write("raw/palm", pack(frame).partition(b"\0")[2], k * 10**8)
            if k in (1, 6):
                writer.write("state/palm", msgpack.packb({"preprocessing": {"k": k}}), k * 10**8 + 1)
        writer.write("raw/palm", b"no frame", 10**9)

    def told(start_s: float = 0.0) -> list[int]:
        found = steps(RecordingReader(path), start_s)
        return [-s.raw.scan if s.raw is not None else s.states.get("preprocessing", {}).get("k") for s in found]

    assert told() == [1, 0, -1, -2, -3, -4, -5, -6, 6, -7, -8, -9]
    assert told(start_s=0.75) == [6, -8, -9]


def test_imported_frames_are_the_rows(recording: Path, touches: dict) -> None:
    frames, rows = raws_of(recording), np.concatenate([touches["untouched"], touches["measurements"]]).astype("c8")
    assert np.array_equal([frame.z for frame in frames], rows)
    assert [frame.kind for frame in frames] == ["reference"] * 64 + ["full"] * 30


HERE = Path("recording.mcap")


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ConfigFile:
    bundle = Bundle.load("square16")
    (tmp_path / "skin.toml").write_text(f"""
skip.batch = false
sockets.addresses.publisher = "tcp://127.0.0.1:47999"
security = {{ insecure = true, secret_key = "SECRET.key_secret", clients = "SECRET-clients" }}
skins.palm = {{ port = "/dev/ttySECRET", bundle = "{bundle.path}", frame_id = 'palm "left"', network = "fast", \
pose = {{ parent = "wrist", position_m = [0.1, 0.0, -0.2] }}, indenter = {{ radius_m = 0.01 }}, \
calibration = "SECRET.json", tare = {{ frames = 32 }}, touch = {{ hold = false }} }}
""")
    law = calibration.Calibration(Curve(7.0), "peak", 4.0, 0.1)
    found = parse(tomllib.loads((tmp_path / "skin.toml").read_text()), tmp_path / "skin.toml")
    calibration.save(tmp_path / "SECRET.json", law, "palm", found.skins["palm"], bundle)
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    return load()


def carried(tmp_path: Path, text: str) -> RecordingReader:
    path = tmp_path / "carried.mcap"
    with RecordingWriter(path, {settings.KEY: text}, overwrite=True) as writer:
        frame = RawFrame(skin="palm", z=np.ones(120, "c8"), status=np.zeros(120, "u1"))
        writer.write("raw/palm", pack(frame).partition(b"\0")[2], 10**18)
    return RecordingReader(path)


def test_the_stages_get_what_they_had_and_no_more(config: ConfigFile, tmp_path: Path, runtime: Path) -> None:
    text = metadata(["raw"], None)[settings.KEY]
    assert not [word for word in ("SECRET", "tcp://", "47999", "insecure", str(ROOT), "/dev") if word in text]
    reader = carried(tmp_path, text)
    (tmp_path / "SECRET.json").unlink()
    os.environ["EITSKIN_CONFIG"] = str(tmp_path / "gone.toml")  # another machine (monkeypatch puts it back)
    file, warnings = configuration_of(["palm"], reader, None, runtime)
    again, before = load(file), config.skins["palm"]
    skin = again.skins["palm"]
    assert warnings == [] and again.skip == config.skip
    assert again.sockets.addresses == {} and not again.security.insecure and again.security.secret_key is None
    assert Bundle.load(skin.bundle).hash == Bundle.load(before.bundle).hash and skin.port == "stub"
    same = ("frame_id", "pose", "network", "indenter", "tare", "touch", "scan", "dft_points", "rtia_ohm")
    assert [getattr(skin, key) for key in same] == [getattr(before, key) for key in same]
    assert skin.calibration is not None and skin.calibration.parent == runtime
    law = calibration.load(skin.calibration, skin, Bundle.load(skin.bundle), "palm")
    assert (law.curve.scale, law.most_n) == (7.0, 4.0)
    other = tmp_path / "theirs.toml"  # how the service was configured, not who records
    other.write_text('[skins.theirs]\nport = "stub"\nbundle = "square16"\n')
    assert list(settings.read(metadata(["raw"], None, other)[settings.KEY], HERE).skins) == ["theirs"]
    for then, now in (
        ({"kind": "any", "radius_m": None, "refine": True}, None),
        ({"shape": "circle", "radius_m": 0.01}, 0.01),
    ):
        indenter = settings.read(json.dumps(palm(indenter=then)), HERE).skins["palm"].indenter
        assert (indenter and indenter.radius_m) == now
    peak = settings.read(settings.text_of({"palm": Skin(port="stub", bundle="square16", reads="peak")}), HERE)
    assert settings.configuration(peak, settings.Known.here(None), tmp_path)["skins"]["palm"]["reads"] == "peak"


def palm(**changes: object) -> dict[str, object]:
    return {"skins": {"palm": {"bundle": "square16", "bundle_hash": Bundle.load("square16").hash, **changes}}}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"skins": {}, "sockets": {"addresses": {"publisher": "tcp://0.0.0.0:1"}}}, "sockets"),
        ({"skins": {}, "security": {"insecure": True}}, "security"),
        (palm(port="socket://evil:1"), "port"),
        (palm(bundle="/tmp/evil"), "bundle"),
        (palm(bundle_hash="../../evil"), "bundle_hash"),
        (palm(calibration="/etc/passwd"), "calibration"),
        ({"skins": {"x]\n[security]\ninsecure = true\n[y": palm()["skins"]["palm"]}}, "skin names"),  # type: ignore[index]
        (palm(frame_id='a"\n[security]'), "frame_id"),
        (palm(tare={"frames": 10**9}), "frames"),
        ('"' + "x" * 2**21 + '"', "expected at most"),
        ({"skins": {f"s{k}": palm()["skins"]["palm"] for k in range(65)}}, "64"),  # type: ignore[index]
    ],
    ids=range(11),
)
def test_settings_that_reach_further_or_cannot_be_are_refused(content: object, says: str) -> None:
    with pytest.raises(RecordingError, match="its settings cannot be used") as refused:
        settings.read(content if isinstance(content, str) else json.dumps(content), HERE)
    assert says in str(refused.value) and str(HERE) in str(refused.value)


def test_a_recorded_calibration_is_checked_like_a_file(tmp_path: Path) -> None:
    for law, says in (({"newtons_per_siemens": -1}, "above 0"), ({"schema": "eitskin.force/2"}, "no calibration")):
        found = settings.read(json.dumps(palm(calibration=law)), HERE)
        with pytest.raises(RecordingError, match=says):
            settings.configuration(found, settings.Known.here(None), tmp_path)


def test_a_bundle_is_found_by_its_hash_and_never_by_a_path(tmp_path: Path, runtime: Path, monkeypatch) -> None:
    shipped = Bundle.load("square16")
    manifest = {k: v for k, v in shipped.manifest.items() if k not in ("files", "schema")} | {"name": "other"}
    other = bundles.write(tmp_path / "square16", manifest | {"network": None}, shipped.matrices)
    reader = carried(tmp_path, json.dumps(palm(bundle_hash=other.hash)))
    monkeypatch.chdir(tmp_path)  # where a folder of the recorded name lies
    with pytest.raises(RecordingError, match="is not installed.*--bundle PATH"):
        configuration_of(["palm"], reader, None, runtime)
    file, warnings = configuration_of(["palm"], reader, other.path, runtime)
    assert load(file).skins["palm"].bundle == str(other.path) and warnings == []
    file, warnings = configuration_of(["palm"], reader, shipped.path, runtime)
    assert "contacts will differ" in warnings[0] and load(file).skins["palm"].bundle == str(shipped.path)


def test_without_settings_ours_count_and_what_cannot_be_replayed_is_refused(runtime: Path, tmp_path: Path) -> None:
    reader = carried(tmp_path, "")
    assert load(configuration_of(["palm"], reader, None, runtime)[0]).skins["palm"].pose.parent == "wrist"
    with pytest.raises(ReplayError, match="--bundle PATH"):
        configuration_of(["elbow"], reader, None, runtime)
    with pytest.raises(ReplayError, match="holds no skin 'sole', only palm"):
        replay_file(reader.path, None, skin="sole")
    with lock(process="acquisition"), pytest.raises(ReplayError, match=f"a board feeds the service .*{os.getpid()}"):
        replay_file(reader.path, None)
