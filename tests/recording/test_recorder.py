"""The recorder beside real publishers and control sockets."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from protocol.frames import ContactFrame, InfoFrame, RawFrame
from protocol.sockets import ControlServer, Publisher
from services.recorder import Recorder
from services.recordings.recording import Recorded, RecordingError, RecordingReader

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


def test_messages_are_recorded_byte_for_byte(runtime: Path, tmp_path: Path) -> None:
    sent = record(tmp_path / "a.mcap", [raw(k) for k in range(20)], "acquisition", topics=["raw"])
    got = list(RecordingReader(tmp_path / "a.mcap").messages({"raw"}))
    assert [message.wire for message in got] == sent
    times = [message.log_time_ns for message in got]
    assert times == sorted(times) and abs(times[0] - time.time_ns()) < 60e9


def test_the_stages_state_is_recorded_and_again_after_a_tare(stages: dict[str, int], tmp_path: Path) -> None:
    infos = [InfoFrame(skin="palm", info={"baseline_hash": text}) for text in ("one", "one", "two")]
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


def recorded(tmp_path: Path) -> list[Recorded]:
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
