"""Snapshots and rotation: files that stand by themselves, bounded, and nothing that goes wrong stops the recorder."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol.frames import Contact, ContactFrame, Frame, InfoFrame, StatusFrame, pack, unpack
from protocol.sockets import AllReader, ControlClient, ControlError, Publisher
from services.recorder import keeping_of, rotation_of
from services.recordings import rotation, snapshots
from services.recordings.recorder import Recorder
from services.recordings.recording import RecordedMessage, RecordingError, RecordingReader
from services.recordings.ring import RingEntry
from services.recordings.rotation import RotatingWriter, Rotation
from services.recordings.snapshots import Keeping, Snapshots
from services.recordings.triggers import TRIGGERS, TriggerWatch
from services.runtime.config import parse
from services.runtime.config_sections import RecorderSection
from tests.docs.snippets import snippets

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
S = 1_000_000_000


def touched(*ids: int, valid: bool = True, reasons: list[str] | None = None) -> ContactFrame:
    contacts = [Contact(id=k, position=[0.0, 0.0, 0.0]) for k in ids]
    return ContactFrame(skin="palm", contacts=contacts, valid=valid, reasons=reasons or [])


def events(*frames: Frame) -> list[str]:
    watch = TriggerWatch(TRIGGERS)
    return [found[0] if (found := watch(frame)) else "" for frame in frames]


def test_a_contact_that_begins_is_an_event_one_that_stays_is_none() -> None:
    assert events(touched(), touched(1), touched(1), touched(1, 2), touched(2), touched(), touched(3)) == [
        *("", "contact", "", "contact", "", "", "contact")
    ]


def test_a_contact_that_was_hidden_by_frames_that_are_not_valid_is_no_new_one() -> None:
    assert events(touched(1), touched(1, valid=False), touched(1)) == ["contact", "fault", ""]


def test_a_fault_that_begins_is_an_event() -> None:
    bad = ["electrode_open"]
    assert events(touched(), touched(valid=False), touched(valid=False), touched()) == ["", "fault", "", ""]
    assert events(touched(), touched(reasons=bad), touched(reasons=bad), touched(reasons=[*bad, "gap"])) == [
        *("", "fault", "", "fault")
    ]
    assert events(touched(), touched(reasons=["changing"]), touched(reasons=["low_snr"])) == ["", "", ""]
    assert events(touched(valid=False, reasons=["stale_baseline"]), touched()) == ["", ""]  # a start is none


def test_a_process_that_fails_is_an_event() -> None:
    levels = ("STALE", "OK", "WARN", "ERROR", "ERROR", "OK", "STALE")
    found = events(*(StatusFrame(skin="palm", process="acquisition", level=level) for level in levels))
    assert found == ["", "", "", "fault", "", "", "fault"]
    own = (StatusFrame(skin="palm", process="recorder", level=level) for level in ("OK", "ERROR"))
    assert events(*own) == ["", ""]  # a full disk is no reason to write more


class Clock:
    """Puts frames into snapshots, 0.1 s apart."""

    def __init__(self, keeping: Keeping) -> None:
        self.ns, self.of = 0, Snapshots(keeping, lambda event: {"event": event})

    def hear(self, *frames: Frame) -> None:
        for frame in frames:
            self.ns += S // 10
            topic, _, data = pack(frame).partition(b"\0")
            self.of.hear(RingEntry(RecordedMessage(topic.decode(), self.ns, data)), frame)
            self.of.mind(self.ns)


def contacts_in(path: Path) -> list[ContactFrame]:
    found = [unpack(message.wire) for message in RecordingReader(path).messages({"contact"})]
    return [frame for frame in found if isinstance(frame, ContactFrame)]


def test_a_snapshot_has_the_time_before_and_after_its_event(tmp_path: Path) -> None:
    made = Clock(Keeping(tmp_path, before_s=2, after_s=1, triggers=("contact",)))
    made.hear(*(touched() for _ in range(100)), touched(1), *(touched(1) for _ in range(100)))
    (path,) = tmp_path.glob("*-contact.mcap")
    times = [message.log_time_ns / S for message in RecordingReader(path).messages()]
    assert times[0] == pytest.approx(10.1 - 2) and times[-1] == pytest.approx(10.1 + 1)
    assert len(times) == 31 and RecordingReader(path).metadata["event"] == "contact: palm: contact 1"
    assert str(RecordingReader(path).damage) == "whole" and not made.of.writing


def test_a_second_event_makes_the_snapshot_longer_up_to_a_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "LONGEST_S", 3.0)
    made = Clock(Keeping(tmp_path, before_s=1, after_s=1, triggers=("contact",)))
    made.hear(touched(), *(touched(k // 5) for k in range(5, 100)))  # another contact every 0.5 s
    files = sorted(tmp_path.glob("*.mcap"), key=lambda path: contacts_in(path)[0].contacts != [])
    assert 2 <= len(files) <= 4
    assert all(len(contacts_in(path)) <= 43 for path in files)


def test_old_automatic_snapshots_go_those_asked_for_stay(tmp_path: Path) -> None:
    made = Clock(Keeping(tmp_path, before_s=1, after_s=0.2, triggers=("contact",), keep=2))
    made.hear(touched())
    asked = made.of.take("snapshot", "by hand", made.ns)
    for k in range(5):
        made.hear(touched(), touched(), touched(), touched(10 + k), touched(), touched(), touched())
    assert asked.exists() and len(list(tmp_path.glob("*-contact*.mcap"))) == 2
    assert (made.of.taken, made.of.deleted) == (6, 3)


def test_a_folder_that_cannot_be_written_to_is_said_and_counted(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    made = Clock(Keeping(tmp_path / "file", triggers=("contact",)))
    made.hear(touched(), touched(1), touched(1))
    assert made.of.missed == 1 and "no snapshot (contact: palm" in made.of.problem
    with pytest.raises(RecordingError, match=r"no snapshot \(by hand\)"):
        made.of.take("snapshot", "by hand", made.ns)


def test_a_disk_that_breaks_ends_the_snapshot_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Clock(Keeping(tmp_path, triggers=("contact",)))
    made.hear(touched(), touched(1))

    def broken(descriptor: int, data: bytes) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("services.recordings.patient_file.os.write", broken)
    made.hear(*(touched(1) for _ in range(100)))
    assert not made.of.writing and "Input/output error" in made.of.problem


# Rotation


def rotating(path: Path, limits: Rotation) -> RotatingWriter:
    head = [RecordedMessage("info/palm", 0, b"\x80")]
    return RotatingWriter(path, limits, lambda k: path.with_stem(f"a-{k}"), lambda: head, lambda: {"origin": "record"})


def test_a_recording_goes_on_in_another_file_when_one_is_large_and_none_is_lost(tmp_path: Path) -> None:
    writer = rotating(tmp_path / "a.mcap", Rotation(file_bytes=20_000))
    writer.begin()
    sent = [os.urandom(1000) for _ in range(200)]
    turned = [writer.write(RecordedMessage("raw/palm", k, data)) for k, data in enumerate(sent)]
    writer.close()
    files = [tmp_path / "a.mcap", *(tmp_path / f"a-{k}.mcap" for k in range(2, writer.files + 1))]
    assert sum(turned) == writer.files - 1 > 1 and all(path.stat().st_size < 100_000 for path in files)
    got = [list(RecordingReader(path).messages()) for path in files]
    assert [m.data for each in got for m in each if m.topic == "raw/palm"] == sent
    assert all(each[0].topic == "info/palm" for each in got)  # each stands by itself
    assert writer.counts == {"raw/palm": 200, "info/palm": writer.files}


def test_the_oldest_files_go_where_that_is_asked(tmp_path: Path) -> None:
    writer = rotating(tmp_path / "a.mcap", Rotation(file_bytes=20_000, keep=2))
    for k in range(400):
        writer.write(RecordedMessage("raw/palm", k, os.urandom(1000)))
    writer.close()
    assert len(list(tmp_path.glob("*.mcap"))) == 2 and writer.deleted == writer.files - 2 > 1
    assert (tmp_path / f"a-{writer.files}.mcap").exists()


def test_by_time_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(rotation.time, "monotonic", lambda: now)
    writer = rotating(tmp_path / "a.mcap", Rotation(file_s=60))
    for k in range(300):
        now = k
        writer.write(RecordedMessage("raw/palm", k, b"\x80"))
    writer.close()
    assert writer.files == 5


def test_where_no_further_file_can_begin_it_goes_on_in_the_one_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = rotating(tmp_path / "a.mcap", Rotation(file_bytes=20_000))
    (tmp_path / "a-2.mcap").touch()  # somebody else's
    for k in range(200):
        writer.write(RecordedMessage("raw/palm", k, os.urandom(1000)))
    assert writer.files == 1 and "recording goes on in" in writer.problem
    (tmp_path / "a-2.mcap").unlink()
    monkeypatch.setattr(rotation, "RETRY_S", 0)
    writer._retry_s = 0
    writer.write(RecordedMessage("raw/palm", 200, b"\x80"))
    writer.close()
    assert writer.files == 2 and not writer.problem
    assert sum(len(list(RecordingReader(path).messages({"raw"}))) for path in tmp_path.glob("*.mcap")) == 201


# The process


@pytest.fixture
def waiting(runtime: Path, tmp_path: Path) -> Iterator[tuple[Publisher, ControlClient]]:
    """A publisher, and a recorder that listens to it and waits for commands."""
    publisher = Publisher("publisher")
    command = [sys.executable, "-m", "services.recorder", "--wait", "--folder", str(tmp_path / "kept")]
    process = subprocess.Popen(command, cwd=ROOT)
    end = time.monotonic() + 60
    while not publisher.wanted("contact", "palm"):
        publisher.poll()
        time.sleep(0.01)
        assert process.poll() is None and time.monotonic() < end
    try:
        yield publisher, ControlClient("recorder", 20.0)
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
        publisher.close()


def send(publisher: Publisher, count: int) -> None:
    for _ in range(count):
        publisher.send(ContactFrame(skin="palm", valid=True))
        time.sleep(0.002)


def test_it_records_and_takes_snapshots_when_told_to(waiting: tuple[Publisher, ControlClient], tmp_path: Path) -> None:
    publisher, control = waiting
    publisher.send(InfoFrame(skin="palm", info={"frame_id": "palm"}))
    send(publisher, 50)
    while control.call("status")["messages"].get("contact/palm", 0) < 50:
        time.sleep(0.02)
    assert not (tmp_path / "kept").exists()  # nothing is written before it is asked for
    made = control.call("snapshot", after_s=0.5, why="a test")
    assert control.call("status")["writing"]
    with pytest.raises(ControlError, match="expected 0 to 300 s"):
        control.call("snapshot", after_s=1e9)
    with pytest.raises(ControlError, match="before_s in .recorder. of skin.toml"):
        control.call("snapshot", before_s=11)
    for wrong in ({}, {"on": None}, {"on": "no"}, {"on": 1}):
        with pytest.raises(ControlError, match="record, argument on: found .*, expected true or false"):
            control.call("record", **wrong)
    assert not control.call("status")["recording"]
    begun = control.call("record", on=True)
    assert begun["recording"] and begun["file"].startswith(str(tmp_path / "kept"))
    with pytest.raises(ControlError, match="being made already"):
        control.call("record", on=True)
    send(publisher, 40)
    while control.call("status")["messages"]["contact/palm"] < 90 or control.call("status")["writing"]:
        time.sleep(0.02)
    ended = control.call("record", on=False)
    assert not control.call("status")["recording"] and ended["file"] == begun["file"]
    snapshot, recording = Path(made["file"]), Path(begun["file"])
    assert len(contacts_in(snapshot)) >= 50 and RecordingReader(snapshot).metadata["event"] == "a test"
    assert len(contacts_in(recording)) == 40
    for path in (snapshot, recording):  # what is latched is in both, though it was said long before
        assert [m.topic for m in RecordingReader(path).messages({"info"})] == ["info/palm"]
    assert str(RecordingReader(recording).damage) == "whole"


def until(control: ControlClient, publisher: Publisher, what: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """The recorder's status once it is so, while contacts come."""
    end = time.monotonic() + 20
    while True:
        send(publisher, 5)
        said = control.call("status")
        if what(said):
            return said
        assert time.monotonic() < end, said


@pytest.mark.parametrize("how", ["file deleted", "file moved", "folder deleted"])
def test_a_recording_that_is_taken_away_is_said_and_goes_on(
    waiting: tuple[Publisher, ControlClient], tmp_path: Path, how: str
) -> None:
    publisher, control = waiting
    first = Path(control.call("record", on=True)["file"])
    until(control, publisher, lambda said: said["messages"].get("contact/palm", 0) > 10)
    if how == "file moved":
        first.rename(tmp_path / "moved.mcap")
    elif how == "file deleted":
        first.unlink()
    else:
        shutil.rmtree(first.parent)
    said = until(control, publisher, lambda said: said["level"] == "WARN" and said["files"] == 2)
    assert str(first) in said["problems"][0] and ("moved" if how == "file moved" else "deleted") in said["problems"][0]
    assert (said["lost"] > 10) == (how != "file moved")
    time.sleep(0.2)
    send(publisher, 20)
    time.sleep(0.2)
    last = Path(control.call("record", on=False)["file"])
    assert last.is_file() and len(contacts_in(last)) >= 20 and RecordingReader(last).metadata
    if how == "file moved":
        assert contacts_in(tmp_path / "moved.mcap")


def test_where_none_can_begin_anew_nothing_is_called_recorded(
    waiting: tuple[Publisher, ControlClient], tmp_path: Path
) -> None:
    publisher, control = waiting
    first = Path(control.call("record", on=True)["file"])
    shutil.rmtree(first.parent)
    first.parent.write_text("a file where the folder was")
    said = until(control, publisher, lambda said: said["level"] == "ERROR")
    assert said["file"] == "" and "nothing is recorded" in said["problems"][0]
    first.parent.unlink()
    said = until(control, publisher, lambda said: said["level"] == "WARN")
    assert Path(said["file"]).is_file() and said["lost"] > 0


def test_recordings_and_snapshots_are_their_owners_alone(waiting: tuple[Publisher, ControlClient]) -> None:
    publisher, control = waiting
    files = Path(control.call("record", on=True)["file"]), Path(control.call("snapshot", after_s=0)["file"])
    for file in files:
        assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)


def test_nobody_fills_a_disk_by_asking_for_snapshots(tmp_path: Path) -> None:
    made = Clock(Keeping(tmp_path, 0.1, 0.0))
    with pytest.raises(RecordingError, match=r"found 10 snapshots by command within a minute.*: wait \d+ s"):
        for _ in range(500):
            made.of.take("snapshot", "again", made.ns)
            made.hear(touched())
    assert len(list(tmp_path.iterdir())) == 10
    made.ns += 61 * 10**9
    assert made.of.take("snapshot", "later", made.ns).is_file()


def test_snapshots_by_command_are_bounded_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshots, "ASKED_IN_ALL", 3)
    made = Clock(Keeping(tmp_path, 0.1, 0.0))
    for _ in range(3):
        first = made.of.take("snapshot", "again", made.ns)
        made.hear(touched())
    with pytest.raises(RecordingError, match="found 3 snapshots by command in .*: move or delete"):
        made.of.take("snapshot", "again", made.ns)
    first.unlink()
    assert made.of.take("snapshot", "again", made.ns).is_file()


def test_its_status_says_what_it_does(waiting: tuple[Publisher, ControlClient]) -> None:
    _, control = waiting
    reader = AllReader(["status"], "palm")

    def said(recording: int) -> StatusFrame:
        end = time.monotonic() + 30
        while time.monotonic() < end:
            frame = reader.recv(0.5)
            if isinstance(frame, StatusFrame) and frame.process == "recorder":
                if frame.counters["recording"] == recording:
                    return frame
        raise AssertionError("the recorder did not say so")

    assert said(0).messages == ["not recording"] and said(0).level == "OK"
    file = control.call("record", on=True)["file"]
    assert said(1).messages == [f"recording to {file}"]
    reader.close()


def test_by_trigger_the_time_round_a_contact_is_written(runtime: Path, tmp_path: Path) -> None:
    """As `skin record FOLDER --trigger contact` does."""
    publisher = Publisher("publisher")
    with Recorder(keeping=Keeping(tmp_path, 5, 0.1, triggers=("contact",))) as recorder:
        end = time.monotonic() + 10
        while not publisher.wanted("contact", "palm"):
            recorder.step(0.01)
            publisher.poll()
            assert time.monotonic() < end
        for frame in (*(touched() for _ in range(5)), *(touched(7) for _ in range(5))):
            publisher.send(frame)
            recorder.step(0.02)
        recorder.step(0.3)
        assert recorder.snapshots is not None and not recorder.snapshots.writing
    publisher.close()
    (path,) = tmp_path.glob("*-contact.mcap")
    assert len(contacts_in(path)) >= 6


def test_what_docs_recording_md_shows_is_so(waiting: tuple[Publisher, ControlClient], tmp_path: Path) -> None:
    blocks = {s.kind: s.text for s in snippets() if s.file == "docs/recording.md" and s.kind in ("toml", "python")}
    palm = '[skins.palm]\nport = "stub"\nbundle = "square16"\n'
    section = parse(tomllib.loads(palm + blocks["toml"])).recorder
    assert section is not None and keeping_of(section, tmp_path).triggers == TRIGGERS
    assert rotation_of(section) == Rotation(500_000_000, 0.0, 20)
    default = RecorderSection()
    assert (section.before_s, section.after_s, section.keep_snapshots) == (
        default.before_s,
        default.after_s,
        default.keep_snapshots,
    )
    said: list[str] = []
    exec(blocks["python"].replace("eitskin", "protocol"), {"print": said.append})
    assert said[0].startswith(str(tmp_path / "kept"))
