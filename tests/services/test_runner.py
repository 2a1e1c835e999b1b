"""The runner, as a process of its own: what comes out of its sockets, what it does about silence and rubbish."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from models.bundle import Bundle
from models.mismatch import MismatchedSheet, named
from protocol.frames import DeltaFrame, Frame, ImageFrame, InfoFrame, RawFrame, StatusFrame, pack
from protocol.sockets import AllReader, ControlClient, ControlError, Publisher
from services.runner import Runner
from services.runtime.config import ROOT, parse
from services.runtime.lateness import Lateness
from services.runtime.stage import Stage
from tests.services.conftest import Board

pytestmark = pytest.mark.live

PALM = {"skins": {"palm": {"port": "stub", "bundle": "square16"}}}
CONFIG = '[skins.palm]\nport = "stub"\nbundle = "square16"\nnetwork = "none"\n'


def just_measured(frame: RawFrame, ago_s: float = 0.01) -> RawFrame:
    """With stamps of now; the bound is generous, for a machine that runs tests may be slow."""
    now = time.monotonic_ns()
    frame.stamps = {"sample": now - int(ago_s * 1e9), "read": now}
    frame.valid_for_s = 2.0
    return frame


class Process:
    """preprocessing, fed by us in acquisition's place."""

    def __init__(self, folder: Path) -> None:
        (folder / "skin.toml").write_text(CONFIG)
        self.env = dict(os.environ, EITSKIN_CONFIG=str(folder / "skin.toml"))
        self.upstream = Publisher("acquisition")
        self.out = AllReader(["delta", "status", "info"], "palm", endpoint=f"ipc://{folder}/preprocessing.ipc")
        self.control = ControlClient("preprocessing", 10.0)
        self.log = open(folder / "log", "w+")
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "services.preprocessing"]
        self.popen = subprocess.Popen(command, cwd=ROOT, env=self.env, stderr=self.log)

    def feed(self, board: Board, n: int, difference: np.ndarray | float = 0.0) -> list[DeltaFrame]:
        """Send frames, each when the one before has come out; what came out."""
        outs = []
        for _ in range(n):
            frame = just_measured(board.frame(difference))
            self.upstream.send(frame)
            outs.append(self.until(DeltaFrame, lambda f, scan=frame.scan: f.scan == scan))
        return outs

    def connect(self, board: Board) -> None:
        """Send frames until one comes out."""
        end = time.monotonic() + 20
        while time.monotonic() < end:
            self.upstream.send(just_measured(board.frame()))
            if any(isinstance(f, DeltaFrame) for f in self.take(0.1)):
                return
        raise AssertionError("no frame came through: " + self.logged())

    def take(self, seconds: float) -> list[Frame]:
        found, end = [], time.monotonic() + seconds
        while (frame := self.out.recv(max(0.0, end - time.monotonic()))) is not None:
            found.append(frame)
        return found

    def until(self, kind: type, fits=lambda frame: True, timeout_s: float = 15.0):
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            frame = self.out.recv(0.5)
            if isinstance(frame, kind) and fits(frame):
                return frame
        raise AssertionError(f"no such {kind.__name__}: {self.logged()}")

    def logged(self) -> str:
        self.log.seek(0)
        return self.log.read()

    def close(self) -> None:
        self.popen.kill()
        self.popen.wait()
        self.upstream.close()
        self.out.close()
        self.log.close()


@pytest.fixture
def process(runtime: Path) -> Iterator[Process]:
    made = Process(runtime)
    yield made
    made.close()


def test_frames_commands_silence_and_a_crash(process: Process, board: Board, bundle: Bundle) -> None:
    """One process, all the way: it takes seconds to start, so what can be looked at together is."""
    process.connect(board)
    outs = process.feed(board, 80)
    first, last = outs[0], outs[-1]
    assert last.valid and not last.touched
    assert last.session == first.session and last.seq == first.seq + 79
    assert last.stamps["sample"] < last.stamps["read"] < last.stamps["preprocess"] <= time.monotonic_ns()
    assert last.source == "board" and last.valid_for_s == 2.0

    late = AllReader(["info"], "palm")
    info = late.recv(10)  # latched
    while isinstance(info, InfoFrame) and "baseline" not in info.info:  # the tick that says of the tare may be to come
        info = late.recv(10)
    late.close()
    assert isinstance(info, InfoFrame)
    assert info.info["bundle_hash"] == bundle.hash and len(info.info["baseline"]) == 120

    for rubbish in (b"raw/palm\0", b"raw/palm\0\xc1", b"raw/palm\0" + os.urandom(300), pack(board.frame())[:-7]):
        process.upstream.socket.send(rubbish)
        time.sleep(0.05)
    old = just_measured(board.frame(), ago_s=3.0)
    process.upstream.send(old)
    late = process.until(DeltaFrame, lambda f: f.scan == old.scan)
    assert not late.valid and "late" in late.reasons, "not silence, and not to be acted on"
    assert process.feed(board, 1)[0].valid
    status = process.until(StatusFrame, lambda f: f.counters["late"] == 1 and f.drops["malformed"] > 0)
    assert "3.0 s after they were measured" in " ".join(status.messages) and status.level != "OK"
    assert status.process == "preprocessing" and 0 < status.rates["delta"] and status.latency["work_p50"] > 0

    touch = board.disc(0.0, 0.0, 0.2, 0.3)
    assert process.feed(board, 3, touch)[-1].touched
    with pytest.raises(ControlError, match="touched") as refused:
        process.control.call("tare", skin="palm")
    assert refused.value.kind == "refused"
    for truthy in ("no", "false", 1, [0]):
        with pytest.raises(ControlError, match="argument force: found .*, expected true or false") as refused:
            process.control.call("tare", skin="palm", force=truthy)
        assert refused.value.kind == "bad_request"
    assert process.feed(board, 1, touch)[-1].touched  # by the baseline that it had
    with pytest.raises(ControlError, match="configured: palm"):
        process.control.call("tare", skin="plam")
    for no_name in ([1], {"palm": 1}, 7):
        with pytest.raises(ControlError, match="argument skin: found .*, expected text") as refused:
            process.control.call("status", skin=no_name)
        assert refused.value.kind == "bad_request"
    assert process.control.call("status")["flowing"]

    silent = process.until(StatusFrame, lambda f: f.level == "STALE")
    assert "no raw/palm" in " ".join(silent.messages)
    assert not [f for f in process.take(0.3) if isinstance(f, DeltaFrame)]
    assert not process.control.call("status")["flowing"]

    process.popen.kill()
    process.popen.wait()
    process.start()
    process.connect(board)
    again = process.feed(board, 1, touch)[0]
    assert again.valid and again.touched  # by the baseline of before the crash, although touched all the while
    assert again.session != last.session

    state = process.control.call("state", skin="palm")["state"]
    session = process.control.call("reset", skin="palm", new_session=True)["session"]
    out = process.feed(board, 1)[0]
    assert not out.valid and out.session == session and out.seq == 0
    process.control.call("load", skin="palm", state=state)
    assert process.feed(board, 1)[0].valid
    with pytest.raises(ControlError, match="does not fit"):
        process.control.call("load", skin="palm", state={"bundle": bundle.hash, "baseline": 3})
    with pytest.raises(ControlError, match="does not fit"):
        process.control.call("load", skin="palm", state=state | {"hold": 3, "window": {}, "seen": []})

    began = time.monotonic()
    process.popen.send_signal(signal.SIGTERM)
    assert process.popen.wait(5) == 0 and time.monotonic() - began < 3
    assert "Traceback" not in process.logged()


class Counting(Stage):
    """Says which frames came together."""

    reads, writes, stamp = "raw", ("delta",), "preprocess"
    groups: ClassVar[list[int]] = []

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        return [DeltaFrame(skin=self.skin, scan=frame.scan)]

    @classmethod
    def together(cls, work: Sequence[tuple[Stage, Frame]]) -> None:
        cls.groups.append(len(work))


class OneFrame:
    """A feed that holds one frame."""

    malformed = skipped = 0

    def __init__(self, skin: str) -> None:
        self.socket = object()
        z, status = np.ones(120, np.complex64), np.zeros(120, np.uint8)
        stamps = {"read": time.monotonic_ns()}
        self.waiting: list[Frame] = [RawFrame(skin=skin, stamps=stamps, valid=True, z=z, status=status)]

    def recv(self) -> Frame | None:
        return self.waiting.pop() if self.waiting else None

    def close(self) -> None:
        pass


@pytest.mark.release
def test_a_tare_by_command_is_followed_by_a_calibration_that_outlives_a_crash(
    process: Process, board: Board, bundle: Bundle, runtime: Path
) -> None:
    """The fit runs in a process of its own: frames go on meanwhile, and name it once it is in use."""
    off = np.abs(MismatchedSheet("square16", named("mild"), "stub").solve().impedances()) / bundle.z0 - 1
    process.connect(board)
    assert process.feed(board, 80, off)[-1].calibration == ""
    assert process.control.call("tare", skin="palm", force=True)["calibrating"]
    end, out = time.monotonic() + 240, None
    while time.monotonic() < end and (out is None or not out.calibration):
        out = process.feed(board, 1, off)[0]
        time.sleep(0.05)
    assert out is not None and out.calibration and out.valid, process.logged()
    latched = AllReader(["info"], "palm", endpoint=f"ipc://{runtime}/preprocessing.ipc")
    frame = latched.recv(15.0)
    latched.close()
    assert isinstance(frame, InfoFrame) and frame.info["bundle_hash"] == out.calibration
    assert frame.info["mounting"]["bundle_hash"] == bundle.hash
    time.sleep(2.0)  # ticks, in which it is kept
    process.popen.kill()
    process.popen.wait()
    process.start()
    process.connect(board)
    assert process.feed(board, 3, off)[-1].calibration == out.calibration


@pytest.mark.parametrize("skip", [True, False])
def test_rules_that_no_skin_owns_have_their_switches(runtime: Path, skip: bool) -> None:
    skins = {name: {"port": "stub", "bundle": "square16"} for name in ("palm", "arm")}
    runner = Runner("preprocessing", parse({"skins": skins, "skip": {"batch": skip, "unwanted": skip}}))
    try:
        Counting.groups.clear()
        for name in skins:
            runner.add(Counting(name), OneFrame(name))
        assert runner._wanted(runner.channels["arm"].stage) == (frozenset() if skip else {"delta"})
        runner._serve(list(runner.channels.values()))
        assert Counting.groups == ([2] if skip else [])
        assert runner.publisher.sent == {"delta/palm": 1, "delta/arm": 1}
    finally:
        runner.close()


class Waiting(OneFrame):
    """A feed in which frames have queued up, measured so many seconds ago."""

    def __init__(self, skin: str, *ages: float, source: str = "board") -> None:
        super().__init__(skin)
        (first,), now = self.waiting, time.monotonic_ns()
        self.waiting = [
            dataclasses.replace(
                first,
                scan=n,
                source=source,
                valid_for_s=2.0,
                reasons=[],
                stamps={"sample": now - int(age * 1e9), "read": now},
            )
            for n, age in enumerate(ages)
        ][::-1]  # `pop` takes the oldest
        self.count = len(ages)


class Passing(Stage):
    """What comes in goes out."""

    reads, writes, stamp = "", ("raw",), "read"

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        return [frame]


@pytest.fixture
def passed(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., list[RawFrame]]]:
    """What a runner sends of what has queued up."""
    runner = Runner("acquisition", parse({"skins": {"palm": {"port": "stub", "bundle": "square16"}}}))
    sent: list[RawFrame] = []
    monkeypatch.setattr(runner.publisher, "send", sent.append)

    def serve(feed: Waiting, stood: bool = False) -> list[RawFrame]:
        runner.add(Passing("palm"), feed)
        runner._serve(list(runner.channels.values()), stood)
        assert sum(runner.channels["palm"].heartbeat.drops.values()) == feed.count - len(sent)
        return sent

    yield serve
    runner.close()


class FailingBeside(Passing):
    """Makes what can wait from a frame, or fails to."""

    def beside(self, wanted: frozenset[str]) -> list[Frame]:
        raise ValueError("what can wait")


def test_what_can_wait_is_made_after_the_first_frame_has_left(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    runner = Runner("acquisition", parse(PALM))
    sent: list[RawFrame] = []
    monkeypatch.setattr(runner.publisher, "send", sent.append)
    try:
        runner.add(FailingBeside("palm"), Waiting("palm", 0.1))
        runner._serve(list(runner.channels.values()))
        assert [f.scan for f in sent] == [0]
        assert runner.channels["palm"].heartbeat.drops["failed"] == 1 and "what can wait" in caplog.text
    finally:
        runner.close()


def test_what_is_late_is_skipped_and_the_newest_is_sent_all_the_same(passed: Callable[..., list[RawFrame]]) -> None:
    sent = passed(Waiting("palm", 9.0, 8.0, 1.0, 0.1, 7.0))
    assert [(f.scan, f.valid, f.reasons) for f in sent] == [(2, True, []), (3, True, []), (4, False, ["late"])]


def test_a_process_that_stood_still_takes_the_newest_only(passed: Callable[..., list[RawFrame]]) -> None:
    assert [f.scan for f in passed(Waiting("palm", 1.0, 0.5, 0.1), True)] == [2]


def test_replayed_frames_are_neither_late_nor_skipped(passed: Callable[..., list[RawFrame]]) -> None:
    """A replay gives the same frames however slow the machine."""
    sent = passed(Waiting("palm", 9e3, 8e3, 7e3, source="replay"), True)
    assert [(f.scan, f.valid) for f in sent] == [(0, True), (1, True), (2, True)]


class Lacking(Passing):
    """Wants again what upstream sends only once, and notes what the runner tells it."""

    reads, writes, sleeps = "image", ("contact",), True

    def __init__(self, skin: str) -> None:
        super().__init__(skin)
        self.told: list[str] = []

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        self.lacks = True
        return []

    def joined(self, topic: str) -> None:
        self.told.append(topic)

    def wake(self) -> None:
        self.told.append("awake")


def test_who_subscribes_is_told_of_and_what_is_lacking_is_asked_for_by_subscribing(runtime: Path) -> None:
    upstream = Publisher("inference")
    asked: list[bytes] = []
    upstream.on_join = asked.append
    runner = Runner("publisher", parse({"skins": {"palm": {"port": "stub", "bundle": "square16"}}}))
    contacts = AllReader(["contact"], "palm")
    stage = Lacking("palm")

    def until(what: Callable[[], object]) -> None:
        end = time.monotonic() + 20
        while not what():
            assert time.monotonic() < end
            runner._tick()
            upstream.poll()
            upstream.send(ImageFrame(skin="palm"))
            runner._serve(list(runner.channels.values()))
            time.sleep(0.01)

    try:
        runner.add(stage)
        until(lambda: "contact" in stage.told)
        until(lambda: len(asked) >= 5 and set(asked) == {b"image/palm\0", b"part/palm\0"})
        contacts.close()
        until(lambda: runner.channels["palm"].asleep)
        asked.clear()
        contacts = AllReader(["contact"], "palm")
        until(lambda: asked)
        assert "awake" in stage.told[stage.told.index("contact") + 1 :]
    finally:
        contacts.close()
        runner.close()
        upstream.close()


def test_a_stop_and_a_sleep_of_the_host_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the loop's own time; and by the clock that goes on while the host is suspended."""
    now, slept, naps = [100.0], [0.0], []
    monkeypatch.setattr("services.runtime.lateness.time.monotonic", lambda: now[0])
    monkeypatch.setattr("services.runtime.lateness.pause", naps.append)
    monkeypatch.setattr("protocol.ages._slept_ns", lambda: int(slept[0] * 1e9))
    lateness = Lateness()

    def after(seconds: float, timeout_s: float) -> bool:
        now[0] += seconds
        return lateness.stood_still(timeout_s)

    assert not after(0.2, 0.2) and not after(0.01, -3.0) and not naps
    assert after(2.0, 0.2) and len(naps) == 1
    assert not after(0.2, 0.2)
    frame = RawFrame(skin="palm", z=np.ones(1, "c8"), status=np.zeros(1, "u1"), valid_for_s=2.0)
    frame.stamps = {"sample": time.monotonic_ns()}
    assert not lateness.late(frame)
    slept[0] = 30.0
    assert after(0.0, 0.2), "the monotonic clock stood still"
    assert lateness.late(frame), "measured before the host slept"
    frame.stamps = {"sample": time.monotonic_ns()}
    assert not lateness.late(frame) and not after(0.2, 0.2)


class Failing(Stage):
    reads, writes, stamp = "image", ("contact",), "publish"
    text = ""

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        raise ValueError(self.text)


def test_failures_are_logged_however_many_there_were_and_all_are_counted(
    runtime: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, stage, now = Runner("publisher", parse(PALM)), Failing("palm"), [time.monotonic()]
    lines = 0

    def fail(text: str) -> int:
        caplog.clear()
        stage.text = text
        runner._handle(runner.channels["palm"], ImageFrame(skin="palm"))
        return len(caplog.records)

    def words(k: int) -> str:
        return "".join(chr(ord("a") + int(digit)) for digit in str(k))

    try:
        runner.add(stage)
        monkeypatch.setattr("services.runtime.said_once.time.monotonic", lambda: now[0])
        assert fail("scan 1 is odd") == 1 and fail("scan 2 is odd") == 0, "the same failure of another scan"
        lines = sum(fail(words(k)) for k in range(200))
        assert 10 <= lines <= 50, "a flood of different ones does not fill the disk"
        now[0] += 120.0
        assert fail("of another kind") == 1 and fail("scan 3 is odd") == 1, "nor does it silence what comes later"
        said = runner._commands.handlers()["status"]({})
        assert said["failures"] == 204 and said["unlogged"] == 204 - 3 - lines
    finally:
        runner.close()


def test_a_configuration_that_is_wrong_ends_in_one_clear_line(runtime: Path) -> None:
    (runtime / "skin.toml").write_text(CONFIG.replace("square16", "square17"))
    env = dict(os.environ, EITSKIN_CONFIG=str(runtime / "skin.toml"))
    command = [sys.executable, "-m", "services.inference"]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "square17" in done.stderr and "Traceback" not in done.stderr
