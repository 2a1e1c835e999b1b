"""Replaying: the same contacts each time, from whole and cut files, through real processes."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import msgpack
import numpy as np
import pytest

from firmware_stub.world import pressed
from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame, pack, unpack
from protocol.runtime import runtime_dir
from services.pipeline import Pipeline
from services.recordings.importing import ImportRefused, import_arrays
from services.recordings.recording import RecordingReader, RecordingWriter
from services.recordings.replay import ReplayError, steps
from services.recordings.replay_session import replay_file
from services.runtime import persistence
from services.runtime.config import ROOT, Skin
from tests.services.test_estimator import FREE_S, PARTS, Board, press

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def touches() -> dict[str, np.ndarray]:
    """30 rows of the bundle's own physics: nothing, then a touch that moves, then nothing; 80 dB."""
    bundle = Bundle.load("square16")
    m, rng = bundle.matrices, np.random.default_rng(5)
    side = -1 + 2 * (np.arange(24) + 0.5) / 24
    rows = []
    for k in range(30):
        disc = np.hypot(side[None] - 0.03 * k, side[:, None] + 0.2) < 0.2
        drop = 0.3 * disc.ravel() if 8 <= k < 24 else np.zeros(m.jacobian.shape[1])
        rows.append(1 + m.jacobian @ drop)
    noise = 1 + 1e-4 * rng.standard_normal((94, 120))
    return {"untouched": m.z0 * noise[:64], "measurements": m.z0 * np.array(rows) * noise[64:]}


@pytest.fixture
def recording(touches: dict[str, np.ndarray], tmp_path: Path) -> Path:
    path = tmp_path / "touches.mcap"
    import_arrays(touches, Path("touches.npz"), path, "palm", 22.0)
    return path


def contacts(path: Path) -> list[dict[str, object]]:
    """The contact frames of a recording, without what may differ between two replays."""
    found = []
    for message in RecordingReader(path).messages({"contact"}):
        frame = msgpack.unpackb(message.data)
        del frame["session"]
        frame["stamps"] = {"sample": frame["stamps"]["sample"]}
        found.append(frame)
    return found


def test_two_replays_give_identical_contacts(runtime: Path, recording: Path, tmp_path: Path) -> None:
    """Through the real processes: one replay of the whole file, one of the same file without its end."""
    report = replay_file(recording, None, out=tmp_path / "one.mcap")
    assert report["frames"] == report["contacts"] == 94 and report["warnings"] == []
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: int(recording.stat().st_size * 0.9)])
    again = replay_file(cut, None, out=tmp_path / "two.mcap", private=True)
    assert "cut short" in again["damage"] and 64 < again["frames"] < 94
    first, second = contacts(tmp_path / "one.mcap"), contacts(tmp_path / "two.mcap")
    assert [msgpack.packb(f) for f in second] == [msgpack.packb(f) for f in first[: len(second)]]
    assert [f["seq"] for f in first] == list(range(94))
    assert all(f["source"] == "replay" and "replay" in f["reasons"] for f in first)  # type: ignore[operator]
    recorded = [m.log_time_ns for m in RecordingReader(recording).messages({"raw"})]
    assert [m.log_time_ns for m in RecordingReader(tmp_path / "one.mcap").messages({"contact"})] == recorded
    states = [[c["state"] for c in f["contacts"]] for f in first]  # type: ignore[attr-defined]
    assert states[64:72] == [[]] * 8 and states[72] == ["begin"] and states[73:88] == [["hold"]] * 15
    assert [s for s in states[88:] if s] == [["end"]], "it ends once, and is not there any more"
    x = [f["contacts"][0]["position"][0] for f in first[72:88]]  # type: ignore[index]
    assert np.corrcoef(x, 0.05 * 0.03 * np.arange(8, 24))[0, 1] > 0.99 and abs(x[0] - 0.012) < 0.004


ONE_PROCESS = """
import sys
from pathlib import Path
from services.pipeline import Pipeline  # first: it has numpy round as the processes do, with one thread
from protocol.frames import pack
from services.recordings.recording import RecordingReader, RecordingWriter
from services.recordings.replay import mark, steps
from services.runtime.config import Skin
pipeline = Pipeline(Skin(port="stub", bundle="square16", frame_id="palm", network="full", scan="rolling"), "palm")
with RecordingWriter(Path(sys.argv[2])) as writer:
    for step in steps(RecordingReader(Path(sys.argv[1]))):
        mark(step.raw)
        if (contact := pipeline.step(step.raw)) is not None:
            writer.write("contact/palm", pack(contact).partition(b"\\0")[2], step.at_ns)
"""


@pytest.mark.release
def test_scans_in_parts_of_which_some_were_lost_give_the_contacts_of_one_process(runtime: Path, tmp_path: Path) -> None:
    """Which image meets which part is decided by their numbers: images and parts come to publisher from two processes,
    and whichever is first, the contacts are bit by bit those of the stages called one after the other.
    """
    recording = Path(__file__).with_name("golden") / "rolling.mcap"
    raws = [step.raw for step in steps(RecordingReader(recording)) if step.raw is not None]
    lost = np.diff([raw.scan for raw in raws])
    assert {raw.parts for raw in raws} == {10} and max(lost) > 10 and sum(lost > 1) > 20
    subprocess.run(
        [sys.executable, "-c", ONE_PROCESS, recording, tmp_path / "one.mcap"], check=True, cwd=ROOT, timeout=120
    )
    replay_file(recording, None, out=tmp_path / "two.mcap")
    one, two = contacts(tmp_path / "one.mcap"), contacts(tmp_path / "two.mcap")
    for frame in (*one, *two):
        del frame["seq"], frame["host"]
    assert len(one) == len(two) and {frame["part"] for frame in one} >= set(range(1, 11))
    assert len({c["id"] for frame in one for c in frame["contacts"]}) >= 3  # type: ignore[attr-defined]
    for a, b in zip(one, two, strict=True):
        assert msgpack.packb(a) == msgpack.packb(b), a["scan"]


@pytest.mark.release
def test_a_socket_file_deleted_during_a_replay_is_there_again_and_no_frame_is_lost(
    recording: Path, tmp_path: Path
) -> None:
    there_again = []

    def deleting(frames: Iterator[ContactFrame], total: int) -> Iterator[ContactFrame]:
        socket = runtime_dir() / "acquisition.ipc"
        for n, frame in enumerate(frames):
            if n == 80:  # something touches
                socket.unlink()
                time.sleep(1.2)
            if n == 82:
                there_again.append(socket.exists())
            yield frame

    replay_file(recording, None, out=tmp_path / "one.mcap", private=True)
    report = replay_file(recording, None, out=tmp_path / "two.mcap", private=True, progress=deleting)
    assert there_again == [True]
    assert report["frames"] == report["contacts"] == 94 and report["warnings"] == []
    one, two = contacts(tmp_path / "one.mcap"), contacts(tmp_path / "two.mcap")
    for frame in (*one, *two):
        del frame["seq"]
    assert one == two


def test_a_recording_that_begins_while_a_touch_is_held_is_replayed_as_it_was(runtime: Path, tmp_path: Path) -> None:
    """The image came before the recording did: the states bring it, and contacts come out as they did live."""
    bundle, rng = Bundle.load("square16"), np.random.default_rng(7)
    pipeline = Pipeline("square16", name="palm", bundle=bundle)
    side = -1 + 2 * (np.arange(24) + 0.5) / 24
    disc = np.hypot(side[None] - 0.3, side[:, None] + 0.2) < 0.2
    touched = bundle.matrices.z0 * (1 + bundle.matrices.jacobian @ (0.3 * disc.ravel()))

    def raw(scan: int, z0: np.ndarray) -> RawFrame:
        z = z0 * (1 + 1e-4 * rng.standard_normal(len(z0)))
        stamps = {"sample": scan * 45_000_000, "read": scan * 45_000_000 + 1}
        status = np.zeros(len(z), np.uint8)
        frame = RawFrame(skin="palm", scan=scan, stamps=stamps, valid=True, z=z.astype("c8"), status=status, board="b")
        frame.valid_for_s = 0.25
        return frame

    scans = iter(range(1, 1000))
    for _ in range(80):
        pipeline.run(raw(next(scans), bundle.matrices.z0))
    for _ in range(5):  # of which the first, second and fourth are reconstructed, as will be the eighth
        pipeline.run(raw(next(scans), touched))
    stages = {"preprocessing": pipeline.pre, "inference": pipeline.inference, "publisher": pipeline.publishing}
    states = {name: persistence.plain(stage.state()) for name, stage in stages.items()}
    live: list[ContactFrame] = []
    with RecordingWriter(tmp_path / "held.mcap", {"bundle": "square16"}) as writer:
        writer.write("state/palm", msgpack.packb(states), 1)
        for n in range(2, 22):
            frame = raw(next(scans), touched)
            writer.write("raw/palm", pack(frame).partition(b"\0")[2], n * 45_000_000)
            live.append(pipeline.run(frame).contact)
    assert live[0].held and live[0].contacts
    report = replay_file(tmp_path / "held.mcap", None, out=tmp_path / "again.mcap", private=True)
    assert report["frames"] == 20 and report["warnings"] == []
    again = [unpack(message.wire) for message in RecordingReader(tmp_path / "again.mcap").messages({"contact"})]
    for one, other in zip(live, again, strict=True):
        assert isinstance(other, ContactFrame)
        assert (one.scan, one.valid, one.held) == (other.scan, other.valid, other.held)
        assert [asdict(c) for c in one.contacts] == [asdict(c) for c in other.contacts]


def test_a_recording_in_parts_that_begins_within_a_scan_is_replayed_as_it_was(runtime: Path, tmp_path: Path) -> None:
    """No stage will ever see the whole scan before it, after which its first parts come."""
    pipeline = Pipeline(Skin(port="stub", bundle="square16", frame_id="palm"), "palm")
    stages = {"preprocessing": pipeline.pre, "inference": pipeline.inference, "publisher": pipeline.publishing}
    live: list[ContactFrame] = []
    began_s = FREE_S + 0.6
    with RecordingWriter(tmp_path / "held.mcap", {"bundle": "square16"}) as writer:
        for raw in Board(press(pressed("circle", 0.02, -0.01, 8e-3, 3.0)), PARTS, 3).frames(began_s + 0.1):
            raw.valid_for_s, raw.stamps["read"] = 0.25, raw.stamps["sample"] + 1
            recorded = raw.stamps["sample"] > began_s * 1e9 and (live or raw.part == 4)
            if recorded and not live:
                states = {name: persistence.plain(stage.state()) for name, stage in stages.items()}
                writer.write("state/palm", msgpack.packb(states), raw.stamps["sample"] - 1)
            if recorded:
                writer.write("raw/palm", pack(raw).partition(b"\0")[2], raw.stamps["sample"])
            contact = pipeline.step(raw)
            live += [contact] if recorded and contact is not None else []
    report = replay_file(tmp_path / "held.mcap", None, out=tmp_path / "again.mcap", private=True)
    assert report["warnings"] == [] and report["touched"] == report["frames"] == len(live) > 15
    again = [unpack(message.wire) for message in RecordingReader(tmp_path / "again.mcap").messages({"contact"})]
    for one, other in zip(live, again, strict=True):
        assert isinstance(other, ContactFrame) and (one.scan, one.valid) == (other.scan, other.valid)
        assert [asdict(c) for c in one.contacts] == [asdict(c) for c in other.contacts]


def test_steps_begin_with_the_recorded_state(tmp_path: Path, touches: dict[str, np.ndarray]) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for k in range(10):
            frame = RawFrame(skin="palm", scan=k, z=touches["untouched"][k].astype("c8"), status=np.zeros(120, "u1"))
            writer.write("raw/palm", pack(frame).partition(b"\0")[2], k * 10**8)
            if k in (1, 6):
                writer.write("state/palm", msgpack.packb({"preprocessing": {"k": k}}), k * 10**8 + 1)
        writer.write("raw/palm", b"no frame", 10**9)
    found = [
        step.states.get("preprocessing", {}).get("k") if step.raw is None else -step.raw.scan
        for step in steps(RecordingReader(path))
    ]
    assert found == [1, 0, -1, -2, -3, -4, -5, -6, 6, -7, -8, -9]
    found = [
        step.states.get("preprocessing", {}).get("k") if step.raw is None else -step.raw.scan
        for step in steps(RecordingReader(path), start_s=0.75)
    ]
    assert found == [6, -8, -9]


def test_a_recording_of_another_skin_is_refused(runtime: Path, recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match="holds no skin 'sole', only palm"):
        replay_file(recording, None, skin="sole")
    with RecordingWriter(tmp_path / "empty.mcap") as writer:
        writer.write("contact/palm", b"\x80", 1)
    with pytest.raises(ReplayError, match="holds no raw frames: nothing to replay$"):
        replay_file(tmp_path / "empty.mcap", None)


def test_what_is_damaged_is_said_where_nothing_can_be_replayed(runtime: Path, recording: Path, tmp_path: Path) -> None:
    whole, path = recording.read_bytes(), tmp_path / "damaged.mcap"
    path.write_bytes(whole[:8] + b"garbage!" * 50)
    with pytest.raises(ReplayError, match="no raw frames.*cut short: the last 400 bytes"):
        replay_file(path, None)
    chunks = bytearray(whole)
    for at in range(2000, len(chunks), 200):
        chunks[at] ^= 0xFF
    path.write_bytes(bytes(chunks))
    with pytest.raises(ReplayError, match="no raw frames.*wrong checksum"):
        replay_file(path, None)


def test_imported_frames_are_the_rows(recording: Path, touches: dict[str, np.ndarray]) -> None:
    frames = [unpack(message.wire) for message in RecordingReader(recording).messages()]
    assert all(isinstance(frame, RawFrame) for frame in frames)
    rows = np.concatenate([touches["untouched"], touches["measurements"]]).astype("c8")
    assert np.array_equal([frame.z for frame in frames], rows)  # type: ignore[union-attr]
    assert [frame.kind for frame in frames] == ["reference"] * 64 + ["full"] * 30  # type: ignore[union-attr]


def test_presses_are_put_in_the_bundle_s_order(tmp_path: Path) -> None:
    """A file in another order of measurements, and with sense pairs the other way round, gives the same recording."""
    pattern = np.asarray(Bundle.load("disc16").pattern, dtype=int)
    rng = np.random.default_rng(6)
    arrays = {"untouched": rng.uniform(1, 2, (3, 192)), "touched": rng.uniform(1, 2, (3, 192)), "pattern": pattern}
    import_arrays(arrays, Path("a.npz"), tmp_path / "a.mcap", "disc16", 10.0)
    order = rng.permutation(192)
    mixed = {"untouched": arrays["untouched"][:, order], "touched": arrays["touched"][:, order]}
    mixed["pattern"] = pattern[order][:, [0, 1, 3, 2]]
    import_arrays(mixed, Path("a.npz"), tmp_path / "b.mcap", "disc16", 10.0)
    assert [m.data for m in RecordingReader(tmp_path / "a.mcap").messages()] == [
        m.data for m in RecordingReader(tmp_path / "b.mcap").messages()
    ]
    other = pattern.copy()
    other[5] = [0, 1, 2, 3]
    with pytest.raises(ImportRefused, match="lacks"):
        import_arrays({**arrays, "pattern": other}, Path("a.npz"), tmp_path / "c.mcap", "disc16", 10.0)
