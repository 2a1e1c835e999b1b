"""The recorder beside real publishers and control sockets."""

from __future__ import annotations

import os
import resource
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from protocol.frames import ContactFrame, InfoFrame, RawFrame, ReferenceFrame
from protocol.sockets import ControlClient, ControlServer, Publisher
from services.recordings import patient_file
from services.recordings.patient_file import PatientFile
from services.recordings.recorder import Recorder
from services.recordings.recording import RecordedMessage, RecordingError, RecordingReader, RecordingWriter

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]


def raw(scan: int) -> RawFrame:
    return RawFrame(skin="palm", scan=scan, z=np.full(120, scan, "c8"), status=np.zeros(120, "u1"), valid=True)


@pytest.fixture
def stages(runtime: Path) -> Iterator[dict[str, int]]:
    """The three stages' control sockets: each counts how often it was asked for its state."""
    asked = dict.fromkeys(("preprocessing", "inference", "publisher"), 0)
    stop = threading.Event()

    def serve(name: str) -> None:
        def state(args: dict[str, object]) -> dict[str, object]:
            asked[name] += 1
            return {"state": {"of": name, "skin": args["skin"], "time": asked[name]}}

        server = ControlServer(name, {"state": state})
        while not stop.is_set():
            server.serve_once(0.02)
        server.close()

    threads = [threading.Thread(target=serve, args=(name,)) for name in asked]
    for thread in threads:
        thread.start()
    yield asked
    stop.set()
    for thread in threads:
        thread.join()


def record(path: Path, publish: list[object], producer: str, **options: object) -> list[bytes]:
    """What was sent after the recorder had subscribed, while it recorded."""
    publisher = Publisher(producer)
    with Recorder(path, **options) as recorder:  # type: ignore[arg-type]
        end = time.monotonic() + 5
        while not publisher.wanted("raw" if producer == "acquisition" else "info", "palm"):
            recorder.step(0.01)
            publisher.poll()
            assert time.monotonic() < end
        sent = []
        for frame in publish:
            sent.append(publisher.send(frame))  # type: ignore[arg-type]
            recorder.step(0.02)
        recorder.step(0.7)
    publisher.close()
    return sent


def test_a_reference_is_recorded_like_all_others(runtime: Path, tmp_path: Path) -> None:
    publisher = Publisher("reference")
    with Recorder(tmp_path / "a.mcap") as recorder:
        end = time.monotonic() + 5
        while not publisher.wanted("reference", "palm"):
            recorder.step(0.01)
            publisher.poll()
            assert time.monotonic() < end
        sent = publisher.send(ReferenceFrame(skin="palm", valid=True, force_n=2.5))
        recorder.step(0.5)
    publisher.close()
    (got,) = RecordingReader(tmp_path / "a.mcap").messages({"reference"})
    assert got.wire == sent


def test_messages_are_recorded_byte_for_byte(runtime: Path, tmp_path: Path) -> None:
    sent = record(tmp_path / "a.mcap", [raw(k) for k in range(20)], "acquisition", topics=["raw"])
    got = list(RecordingReader(tmp_path / "a.mcap").messages({"raw"}))
    assert [message.wire for message in got] == sent
    times = [message.log_time_ns for message in got]
    assert times == sorted(times) and abs(times[0] - time.time_ns()) < 60e9


def test_the_stages_state_is_recorded_and_again_after_a_tare(stages: dict[str, int], tmp_path: Path) -> None:
    """Not where the baseline only drifted: all stages would be asked every few seconds."""
    told = [("one", 1), ("drifted", 1), ("two", 2)]
    infos = [InfoFrame(skin="palm", info={"baseline_hash": text, "tare_sample_ns": at}) for text, at in told]
    record(tmp_path / "a.mcap", infos, "preprocessing", topics=["info"])
    states = [msgpack.unpackb(m.data) for m in RecordingReader(tmp_path / "a.mcap").messages({"state"})]
    assert [state["preprocessing"]["time"] for state in states] == [1, 2]
    assert states[0].keys() == stages.keys() and states[0]["publisher"]["skin"] == "palm"


def test_only_the_wanted_topics_and_skin(runtime: Path, tmp_path: Path) -> None:
    other = raw(1)
    other.skin = "sole"
    record(tmp_path / "a.mcap", [other, raw(2)], "acquisition", topics=["raw"], skin="palm")
    topics = {message.topic for message in RecordingReader(tmp_path / "a.mcap").messages()}
    assert "raw/palm" in topics and "raw/sole" not in topics


def test_an_unknown_topic_is_refused_before_a_file_is_made(runtime: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no topic 'sound'"):
        Recorder(tmp_path / "a.mcap", ["raw", "sound"])
    assert not (tmp_path / "a.mcap").exists()


def start(tmp_path: Path, publisher: Publisher) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-m", "services.recorder", "--folder", str(tmp_path)], cwd=ROOT)
    end = time.monotonic() + 20
    while not publisher.wanted("contact", "palm"):
        publisher.poll()
        time.sleep(0.01)
        assert process.poll() is None and time.monotonic() < end
    return process


def recorded(tmp_path: Path) -> list[RecordedMessage]:
    (file,) = tmp_path.glob("*.mcap")
    return list(RecordingReader(file).messages({"contact"}))


def test_a_killed_recorder_loses_at_most_two_tenths_of_a_second(runtime: Path, tmp_path: Path) -> None:
    publisher = Publisher("publisher")
    process = start(tmp_path, publisher)
    sent_ns = []
    for _ in range(60):
        publisher.send(ContactFrame(skin="palm"))
        sent_ns.append(time.time_ns())
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    publisher.close()
    got = recorded(tmp_path)
    assert got and sent_ns[len(got) - 1] > sent_ns[-1] - 0.2e9 - 0.05e9  # and what was still on its way to it


def test_a_stopped_recorder_loses_nothing(runtime: Path, tmp_path: Path) -> None:
    publisher = Publisher("publisher")
    process = start(tmp_path, publisher)
    for _ in range(30):
        publisher.send(ContactFrame(skin="palm"))
        time.sleep(0.005)
    time.sleep(0.2)
    process.terminate()
    assert process.wait(5) == 0
    publisher.close()
    assert len(recorded(tmp_path)) == 30


def test_a_full_disk_is_named_and_recording_goes_on_when_there_is_room(runtime: Path, tmp_path: Path) -> None:
    """The recorder's files may grow to 8 kB, then to any size: to it that is a disk that is full for a while."""
    publisher = Publisher("publisher")
    process = start(tmp_path, publisher)
    control = ControlClient("recorder", 5.0)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (8192, resource.RLIM_INFINITY))
    sent = 0

    def send_until(level: str) -> dict[str, object]:
        nonlocal sent
        end = time.monotonic() + 30
        while (status := control.call("status"))["level"] != level:
            for _ in range(20):
                publisher.send(ContactFrame(skin="palm", reasons=["gap"], stamps={"publish": time.monotonic_ns()}))
                sent += 1
                time.sleep(0.001)
            assert time.monotonic() < end and process.poll() is None
        return status

    status = send_until("ERROR")
    assert f"make room in {tmp_path}" in " ".join(status["problems"]) and status["lost"] == 0  # type: ignore[arg-type]
    (file,) = tmp_path.glob("*.mcap")
    assert file.stat().st_size <= 8192
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    send_until("OK")
    for _ in range(50):
        publisher.send(ContactFrame(skin="palm"))
        sent += 1
        time.sleep(0.001)
    time.sleep(0.5)
    process.terminate()
    assert process.wait(5) == 0
    publisher.close()
    assert len(recorded(tmp_path)) == sent
    assert str(RecordingReader(file).damage) == "whole"


def test_what_does_not_fit_is_kept_up_to_a_bound_then_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that takes 10 000 bytes, one write in parts, until it has room again."""
    room, real = 10_000, os.write

    def write(descriptor: int, data: bytes) -> int:
        nonlocal room
        if room <= 0:
            raise OSError(28, "No space left on device")
        count = real(descriptor, data[:room])
        room -= count
        return count

    monkeypatch.setattr(patient_file.os, "write", write)
    monkeypatch.setattr(patient_file, "KEPT_BYTES", 100_000)
    monkeypatch.setattr(patient_file, "RETRY_S", 0.0)
    writer = RecordingWriter(tmp_path / "a.mcap")
    data = [msgpack.packb({"n": n, "noise": os.urandom(1000)}) for n in range(1000)]
    for n in range(500):
        writer.write("contact/palm", data[n], n)
        writer.flush()
    assert "No space left" in writer.full and 350 < writer.lost < 450
    lost, room = writer.lost, 10**9
    writer.flush_if_due()
    assert not writer.full
    for n in range(500, 1000):
        writer.write("contact/palm", data[n], n)
    writer.close()
    assert writer.lost == lost
    reader = RecordingReader(tmp_path / "a.mcap")
    got = [message.data for message in reader.messages()]
    assert got == data[: 500 - lost] + data[500:] and str(reader.damage) == "whole"


def test_what_is_no_file_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "a.mcap")
    pipe.chmod(0o666)
    held = os.open(pipe, os.O_RDWR)  # somebody reads it: without that, opening it would wait
    with pytest.raises(RecordingError, match="a device, a pipe or a socket, expected a file"):
        RecordingWriter(pipe, overwrite=True)
    assert stat.S_IMODE(pipe.stat().st_mode) == 0o666
    os.close(held)


def test_a_disk_that_is_broken_is_no_full_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = PatientFile(tmp_path / "a")
    file.write(b"x")

    def broken(descriptor: int, data: bytes) -> int:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(patient_file.os, "write", broken)
    with pytest.raises(OSError, match="Input"):
        file.flush()
    with pytest.raises(OSError, match="Input"):
        file.close()
