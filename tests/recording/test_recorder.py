"""The recorder, its snapshots, rotation and memory: in simulated time what it writes and says; live, as a process."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import msgpack
import numpy as np
import pytest

from protocol.control import ControlClient, ControlServer
from protocol.frames import ContactFrame, InfoFrame, RawFrame, ReferenceFrame, StatusFrame, pack
from protocol.sockets import AllReader, Publisher
from services.recorder import RecorderService, keeping_of, rotation_of
from services.recordings import patient_file, snapshots
from services.recordings.recorder import Recorder
from services.recordings.recording import RecordedMessage, RecordingError, RecordingReader, RecordingWriter
from services.recordings.ring import OVERHEAD_BYTES, Ring, RingEntry
from services.recordings.rotation import RotatingWriter, Rotation
from services.recordings.snapshots import Keeping, Snapshots
from services.recordings.stage_states import stage_states
from services.recordings.triggers import TRIGGERS, TriggerWatch
from services.runtime.config_sections import RecorderSection
from tests.protocol.peers import ROOT, served
from tests.waiting import end, until

from .feed import S, command, contacts_in, fed, set_clock, touched


@pytest.fixture
def clock(monkeypatch):
    return set_clock(monkeypatch)


@pytest.fixture
def service(runtime, clock, tmp_path):
    with Recorder(keeping=Keeping(tmp_path / "kept", 10.0, 5.0)) as recorder:
        fed(recorder, clock)
        made = RecorderService(recorder, tmp_path / "kept", ["palm"])
        yield made
        made.close()


def turn(service, *frames):
    service.recorder.reader.send(*frames)  # type: ignore[attr-defined]
    service.recorder.step()
    return service.status()


def test_messages_are_recorded_byte_for_byte(runtime, clock, tmp_path):
    z, status = np.full(120, 3, "c8"), np.zeros(120, "u1")
    raws = (RawFrame(skin="palm", scan=k, z=z, status=status) for k in range(20))
    with Recorder(tmp_path / "a.mcap") as recorder:
        sent = fed(recorder, clock).send(*raws, ReferenceFrame(skin="palm", force_n=2.5))
        assert recorder.step(0.02) == 21
    got = list(RecordingReader(tmp_path / "a.mcap").messages({"raw", "reference"}))
    assert [message.wire for message in got] == sent
    assert {message.log_time_ns for message in got} == {clock.time_ns() - 20_000_000}
    with pytest.raises(RecordingError, match="no topic 'sound'"):
        Recorder(tmp_path / "b.mcap", ["raw", "sound"])


def test_the_stages_state_is_recorded_and_again_after_a_tare(runtime, clock, tmp_path):
    """Not where the baseline only drifted: all stages would be asked every few seconds."""
    with Recorder(tmp_path / "a.mcap", ["info"]) as recorder:
        feed = fed(recorder, clock)
        for text, at in (("one", 1), ("drifted", 1), ("two", 2)):
            feed.send(InfoFrame(skin="palm", info={"baseline_hash": text, "tare_sample_ns": at}))
            recorder.step()
            clock.go(20.0)
    assert feed.asked == [("palm", "file"), ("palm", "tare")]
    states = [msgpack.unpackb(m.data) for m in RecordingReader(tmp_path / "a.mcap").messages({"state"})]
    assert [state["preprocessing"]["time"] for state in states] == [1, 2]


def test_what_it_is_told_to_do_and_says_that_it_does(service, clock, tmp_path):
    """What is latched is in each file, though it was said long before; its files are their owner's alone."""
    said = turn(service, InfoFrame(skin="palm", info={"frame_id": "palm"}), *(touched(seq=k) for k in range(50)))
    assert said["messages"] == {"info/palm": 1, "contact/palm": 50}
    assert (said["level"], said["recording"]) == ("OK", False)
    assert not (tmp_path / "kept").exists()  # nothing is written before it is asked for
    made = command(service, "snapshot", after_s=0.5, why="a test")
    assert service.status()["writing"]
    for args, says in (({"after_s": 1e9}, "expected 0 to 300 s"), ({"before_s": 11}, "before_s in .recorder. of skin")):
        with pytest.raises(RecordingError, match=says):
            command(service, "snapshot", **args)
    begun = command(service, "record", on=True)
    assert begun["recording"] and begun["file"].startswith(str(tmp_path / "kept"))
    with pytest.raises(RecordingError, match="being made already"):
        command(service, "record", on=True)
    service.recorder.step(1.0)
    assert not turn(service, *(touched(seq=k) for k in range(40)))["writing"]
    ended = command(service, "record", on=False)
    assert not service.status()["recording"] and ended["file"] == begun["file"]
    snapshot, recording = Path(made["file"]), Path(begun["file"])
    assert len(contacts_in(snapshot)) == 50 and RecordingReader(snapshot).metadata["event"] == "a test"
    assert len(contacts_in(recording)) == 40
    for path in (snapshot, recording):
        assert [m.topic for m in RecordingReader(path).messages({"info"})] == ["info/palm"]
        assert (path.stat().st_mode & 0o777, path.parent.stat().st_mode & 0o777) == (0o600, 0o700)


def test_a_recording_that_is_taken_away_is_said_and_goes_on(service, tmp_path):
    first = Path(command(service, "record", on=True)["file"])
    turn(service, *(touched(seq=k) for k in range(20)))
    service.recorder.step(0.6)
    shutil.rmtree(first.parent)
    first.parent.write_text("")  # where the folder was
    service.recorder.step(0.6)
    said = turn(service, touched())
    assert (said["level"], said["file"]) == ("ERROR", "") and "nothing is recorded" in said["problems"][0]
    assert said["problems"][0].endswith(f"{first.parent}: {os.strerror(errno.EEXIST)}")
    first.parent.unlink()
    service.recorder.step(0.6)
    said = turn(service)
    assert said["level"] == "WARN" and f"{first} was deleted" in said["problems"][0]
    assert (said["files"], said["lost"]) == (2, 22)  # a state among them
    turn(service, *(touched(seq=k) for k in range(20)))
    ended = command(service, "record", on=False)
    last = Path(ended["file"])
    assert last != first and len(contacts_in(last)) == 20 and RecordingReader(last).metadata
    assert f"22 of {22 + len(list(RecordingReader(last).messages()))} messages are not in" in ended["problems"][0]


FULL, BROKEN = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), (errno.EIO, errno.EROFS, errno.ENODEV)


@pytest.fixture
def disk(monkeypatch):
    """Bytes that may still be written, and the error of those beyond."""
    room, real, real_cut = [10**9, errno.ENOSPC], os.write, os.ftruncate

    def write(descriptor, data):
        if room[0] <= 0:
            raise OSError(room[1], os.strerror(room[1]))
        count = real(descriptor, data[: room[0]])
        room[0] -= count
        return count

    def ftruncate(descriptor, size):
        if room[1] in BROKEN:
            raise OSError(room[1], os.strerror(room[1]))
        room[0] += os.fstat(descriptor).st_size - size
        real_cut(descriptor, size)

    monkeypatch.setattr(patient_file.os, "write", write)
    monkeypatch.setattr(patient_file.os, "ftruncate", ftruncate)
    return room


def test_a_full_disk_is_named_and_recording_goes_on_when_there_is_room(service, disk):
    file = Path(command(service, "record", on=True)["file"])
    disk[0] = 300
    for k in range(100):
        said = turn(service, touched(reasons=["gap"], seq=k))
    assert said["level"] == "ERROR" and said["lost"] == 0
    assert f"make room in {file.parent}" in said["problems"][0] and disk[0] == 0
    disk[0] = 10**9
    service.recorder.step(0.6)
    assert turn(service, touched(seq=100))["level"] == "OK"
    command(service, "record", on=False)
    assert [frame.seq for frame in contacts_in(file)] == list(range(101))


@pytest.mark.parametrize("number", FULL + BROKEN)
def test_what_cannot_be_written_to_the_end_is_counted_in_the_status_and_in_the_file(service, disk, number):
    file = Path(command(service, "record", on=True)["file"])
    disk[:] = [3000, number]
    for k in range(100):
        assert turn(service, touched(seq=k))["recording"]
    said, reader = command(service, "record", on=False), RecordingReader(file)
    left = len(list(reader.messages()))
    assert 0 < left < 101 and said["lost"] == 101 - left  # a state among them
    assert f"{os.strerror(number)}: {101 - left} of 101 messages are not in {file.parent}" in said["problems"][0]
    assert reader.damage.unwritten.total() == (101 - left) * (number in FULL)
    assert reader.damage.truncated == (number in BROKEN)
    assert service.status()["lost"] == 101 - left and not reader.damage.whole


def test_what_does_not_fit_is_kept_up_to_a_bound_then_dropped_and_counted(tmp_path, monkeypatch, disk, clock):
    monkeypatch.setattr(patient_file, "KEPT_BYTES", 100_000)
    disk[0], writer = 10_000, RecordingWriter(tmp_path / "a.mcap")
    data = [msgpack.packb({"n": n, "noise": os.urandom(1000)}) for n in range(1000)]
    for n in range(1000):
        if n == 500:
            assert "No space left" in writer.full and 350 < writer.lost < 450
            lost, disk[0] = writer.lost, 10**9
            writer.flush_if_due()
            assert not writer.full
        writer.write("contact/palm", data[n], n)
        if n < 500:
            writer.flush()
            clock.go(1.0)
    writer.close()
    reader = RecordingReader(tmp_path / "a.mcap")
    assert [message.data for message in reader.messages()] == data[: 500 - lost] + data[500:] and writer.lost == lost
    assert str(reader.damage) == f"{lost} message(s) could not be written when it was recorded (contact/palm {lost})"


def test_a_killed_recorder_loses_at_most_half_a_second(tmp_path, clock):
    writer = RecordingWriter(tmp_path / "a.mcap")
    for k in range(200):
        writer.write("contact/palm", b"\x80", k)
        clock.go(0.013)
        writer.flush_if_due()
        shutil.copy(tmp_path / "a.mcap", tmp_path / "killed.mcap")
        got = list(RecordingReader(tmp_path / "killed.mcap").messages())
        assert [m.log_time_ns for m in got] == list(range(len(got))) and (k + 1 - len(got)) * 0.013 <= 0.5


@pytest.mark.live
def test_as_a_process_it_is_commanded_and_its_file_is_whole_when_it_ends(runtime, tmp_path):
    publisher, reader = Publisher("publisher"), AllReader(["status"], "palm")
    options = "--wait", "--folder", str(tmp_path / "kept")
    process = subprocess.Popen([sys.executable, "-m", "services.recorder", *options], cwd=ROOT)

    def said(recording):
        frame = reader.recv(0.5)
        ours = isinstance(frame, StatusFrame) and frame.process == "recorder"
        return frame.messages if ours and frame.counters["recording"] == recording else None  # type: ignore[union-attr]

    try:
        assert until(lambda: said(0), process) == ["not recording"]
        control = ControlClient("recorder", 60.0)
        file = Path(control.call("record", on=True)["file"])
        assert until(lambda: said(1), process) == [f"recording to {file}"]
        until(lambda: publisher.poll() or publisher.wanted("contact", "palm"), process)
        for _ in range(30):
            publisher.send(touched())
        until(lambda: len(contacts_in(file)) == 30, process)  # written without being told to
        assert Path(control.call("snapshot", after_s=0)["file"]).is_file()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0 and str(RecordingReader(file).damage) == "whole"
    finally:
        end(process)
        reader.close()
        publisher.close()


@pytest.mark.live
def test_only_the_wanted_topics_and_skin_and_the_states_of_all_stages(runtime, tmp_path):
    publisher = Publisher("publisher")
    with Recorder(tmp_path / "a.mcap", topics=["contact"], skin="palm") as recorder:
        until(lambda: publisher.poll() or publisher.wanted("contact", "palm"))
        for skin in ("sole", "palm"):
            publisher.send(ContactFrame(skin=skin))
        until(lambda: recorder.step(0.02))
    publisher.close()
    assert {m.topic for m in RecordingReader(tmp_path / "a.mcap").messages()} == {"contact/palm", "state/palm"}
    stages = ("preprocessing", "inference", "publisher")
    with served(*(ControlServer(of, {"state": lambda args, of=of: {"state": {of: args["skin"]}}}) for of in stages)):
        assert until(lambda: len(found := stage_states("palm")) == 3 and found) == {of: {of: "palm"} for of in stages}


BAD = ["electrode_open"]


def status(level, process="acquisition"):
    return StatusFrame(skin="palm", process=process, level=level)


@pytest.mark.parametrize(("frames", "found"), [
    ([touched(*ids) for ids in ((), (1,), (1,), (1, 2), (2,), (), (3,))], "-c-c--c"),
    ((touched(1), touched(1, valid=False), touched(1)), "cf-"),  # hidden by one that is not valid: no new one
    ((touched(), touched(valid=False), touched(valid=False), touched()), "-f--"),
    ((touched(), touched(reasons=BAD), touched(reasons=BAD), touched(reasons=[*BAD, "gap"])), "-f-f"),
    ((touched(), touched(reasons=["changing"]), touched(reasons=["low_snr"])), "---"),
    ((touched(valid=False, reasons=["stale_baseline"]), touched()), "--"),  # a start is none
    (map(status, ("STALE", "OK", "WARN", "ERROR", "ERROR", "OK", "STALE")), "---f--f"),
    ((status("OK", "recorder"), status("ERROR", "recorder")), "--"),  # a full disk is no reason to write more
])  # fmt: skip
def test_what_begins_is_an_event(frames, found):
    watch = TriggerWatch(TRIGGERS)
    assert "".join(event[0][0] if (event := watch(frame)) else "-" for frame in frames) == found


class Heard:
    def __init__(self, keeping):
        self.ns, self.of = 0, Snapshots(keeping, lambda event: {"event": event})

    def hear(self, *frames):
        for frame in frames:
            self.ns += S // 10
            topic, _, data = pack(frame).partition(b"\0")
            self.of.hear(RingEntry(RecordedMessage(topic.decode(), self.ns, data)), frame)
            self.of.mind(self.ns)


def test_a_snapshot_has_the_time_before_and_after_its_event(tmp_path):
    made = Heard(Keeping(tmp_path, before_s=2, after_s=1, triggers=("contact",)))
    made.hear(*(touched() for _ in range(100)), touched(1), *(touched(1) for _ in range(100)))
    (path,) = tmp_path.glob("*-contact.mcap")
    times = [message.log_time_ns / S for message in RecordingReader(path).messages()]
    assert times[0] == pytest.approx(10.1 - 2) and times[-1] == pytest.approx(10.1 + 1)
    assert len(times) == 31 and RecordingReader(path).metadata["event"] == "contact: palm: contact 1"
    assert str(RecordingReader(path).damage) == "whole" and not made.of.writing


def test_a_second_event_makes_it_longer_up_to_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshots, "LONGEST_S", 3.0)
    made = Heard(Keeping(tmp_path, before_s=1, after_s=1, triggers=("contact",)))
    made.hear(touched(), *(touched(k // 5) for k in range(5, 100)))  # another contact every 0.5 s
    lengths = [len(contacts_in(path)) for path in tmp_path.glob("*.mcap")]
    assert 2 <= len(lengths) <= 4 and max(lengths) <= 43


def test_old_automatic_snapshots_go_those_asked_for_stay(tmp_path):
    made = Heard(Keeping(tmp_path, before_s=1, after_s=0.2, triggers=("contact",), keep=2))
    made.hear(touched())
    asked = made.of.take("snapshot", "by hand", made.ns)
    for k in range(5):
        made.hear(touched(), touched(), touched(), touched(10 + k), touched(), touched(), touched())
    assert asked.exists() and len(list(tmp_path.glob("*-contact*.mcap"))) == 2
    assert (made.of.taken, made.of.deleted) == (6, 3)


def test_a_folder_that_cannot_be_written_to_is_said_and_counted(tmp_path):
    (tmp_path / "file").touch()
    made = Heard(Keeping(tmp_path / "file", triggers=("contact",)))
    made.hear(touched(), touched(1), touched(1))
    assert made.of.missed == 1 and "no snapshot (contact: palm" in made.of.problem


def test_nobody_fills_a_disk_by_asking_for_snapshots(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshots, "ASKED_IN_ALL", 11)
    made, files = Heard(Keeping(tmp_path, 0.1, 0.0)), list[Path]()

    def ask(times, refused=""):
        for _ in range(times):
            files.append(made.of.take("snapshot", "again", made.ns))
            made.hear(touched())
        with pytest.raises(RecordingError, match=refused):
            made.of.take("snapshot", "again", made.ns)

    ask(10, r"found 10 snapshots by command within a minute.*: wait \d+ s")
    made.ns += 61 * S
    ask(1, "found 11 snapshots by command in .*: move or delete")
    files[-1].unlink()
    ask(1, "found 11")


def test_by_trigger_the_time_round_a_contact_is_written(runtime, tmp_path, clock):
    with Recorder(keeping=Keeping(tmp_path, 5, 0.1, triggers=("contact",))) as recorder:
        feed = fed(recorder, clock)
        for k in range(34):
            feed.send(touched(*([7] if k >= 5 else [])))
            recorder.step(0.02 if k < 10 else 0.5)
        assert feed.asked == 3 * [("palm", "ring")]
    (path,) = tmp_path.glob("*-contact.mcap")
    assert len(contacts_in(path)) >= 9


def test_the_configuration_is_in_megabytes_and_minutes(tmp_path):
    section = RecorderSection(file_mb=500, file_minutes=2, keep_files=20, triggers=TRIGGERS)
    assert rotation_of(section) == Rotation(500_000_000, 120.0, 20)
    assert keeping_of(section, tmp_path) == Keeping(tmp_path, 10.0, 5.0, 64_000_000, TRIGGERS, 100)


def rotating(path, **limits):
    head = [RecordedMessage("info/palm", 0, b"\x80")]
    rotation, named = Rotation(**limits), lambda k: path.with_stem(f"a-{k}")  # type: ignore[arg-type]
    return RotatingWriter(path, rotation, named, lambda: head, lambda: {"origin": "record"})


def test_a_recording_goes_on_in_another_file_when_one_is_large_and_none_is_lost(tmp_path):
    writer = rotating(tmp_path / "a.mcap", file_bytes=20_000)
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


def test_by_time_too_and_the_oldest_files_go_where_that_is_asked(tmp_path, clock):
    writer = rotating(tmp_path / "a.mcap", file_s=60, keep=2)
    for k in range(300):
        writer.write(RecordedMessage("raw/palm", k, b"\x80"))
        clock.go(1.0)
    writer.close()
    assert writer.files == 5 and writer.deleted == 3
    assert {path.name for path in tmp_path.iterdir()} == {"a-4.mcap", "a-5.mcap"}


def test_where_no_further_file_can_begin_it_goes_on_in_the_one_there_is(tmp_path, clock):
    writer = rotating(tmp_path / "a.mcap", file_s=60)
    (tmp_path / "a-2.mcap").touch()  # somebody else's
    for k in range(90):
        writer.write(RecordedMessage("raw/palm", k, b"\x80"))
        assert (writer.files, "recording goes on in" in writer.problem) == (1 + (k >= 70), 60 <= k < 70), k
        if k == 60:
            (tmp_path / "a-2.mcap").unlink()  # it tries again 10 s later
        clock.go(1.0)
    writer.close()
    assert writer.counts["raw/palm"] == 90


def heard(topic, at_s, data="", key="", again=False):
    return RingEntry(RecordedMessage(topic, int(at_s * S), data.encode()), key, again)


def told(found):
    return [(m.topic, m.log_time_ns / S, m.data.decode()) for m in found]


def test_it_holds_the_last_seconds_and_what_was_latched_at_their_beginning():
    ring = Ring(3.0, 10**6)
    for of, text in (("info/palm/pre", "first"), ("status/palm/acquisition", "board"), ("status/palm/stub", "s")):
        ring.add(heard(of.rpartition("/")[0], 0, text, of))
    for k in range(10):
        ring.add(heard("raw/palm", k, str(k)))
    assert ring.held_s == 3.0 and ring.forgotten == 0
    found = told(ring.since(8 * S))
    assert found[:3] == [("info/palm", 8, "first"), ("status/palm", 8, "board"), ("status/palm", 8, "s")]
    assert found[3:] == [("raw/palm", 8, "8"), ("raw/palm", 9, "9")]
    ring.add(heard("info/palm", 10, "within", "info/palm/pre"))
    assert told(ring.since(8 * S)) == [*found, ("info/palm", 10, "within")]


def test_it_begins_where_the_stages_state_is_known_and_leaves_later_ones_out():
    ring = Ring(100, 10**6)
    for k in range(10):
        if k % 3 == 0:
            ring.add(heard("state/palm", k, f"state {k}", "state/palm", again=True))
        ring.add(heard("raw/palm", k + 0.5, str(k)))
        if k == 4:  # too late for what came before it
            ring.add(heard("state/palm", k + 0.6, "tare", "state/palm"))
    found = told(ring.since(int(5.2 * S)))
    assert found[0] == ("state/palm", 3, "state 3")  # the last one before, and so a little earlier
    assert [data for topic, _, data in found if topic == "state/palm"] == ["state 3", "tare"]
    assert [data for topic, _, data in found if topic == "raw/palm"] == ["3", "4", "5", "6", "7", "8", "9"]


def test_each_skin_begins_with_its_own_state_also_where_it_fell_out_of_memory_which_is_bounded():
    ring, short, small = Ring(100, 10**6), Ring(2.0, 10**6), Ring(1000, 10 * (100 + OVERHEAD_BYTES))
    for skin, at in (("palm", 1), ("sole", 2)):
        ring.add(heard(f"state/{skin}", at, skin, f"state/{skin}", again=True))
    ring.add(heard("raw/palm", 3))
    assert told(ring.since(3 * S)) == [("state/palm", 1, "palm"), ("state/sole", 2, "sole"), ("raw/palm", 3, "")]
    short.add(heard("state/palm", 0, "old", "state/palm", again=True))
    for k in range(1, 6):
        short.add(heard("raw/palm", k))
    assert told(short.since(4 * S))[0] == ("state/palm", 4, "old")
    for k in range(50):
        small.add(heard("raw/palm", k, "x" * 100))
        assert small.bytes <= small.most_bytes
    assert small.forgotten == 40 and len(small.since(0)) == 10
    small.add(heard("raw/palm", 51, "x" * 10**5))  # one that is larger than all of it
    assert len(small.since(0)) == 1
