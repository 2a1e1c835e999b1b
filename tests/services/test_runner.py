"""The runner: what comes out of its sockets, what it does about silence, lateness, failures and rubbish."""

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from protocol.frames import DeltaFrame, ImageFrame, InfoFrame, RawFrame, StatusFrame, pack
from protocol.sockets import AllReader, ControlClient, ControlError, Publisher
from services.runner import Runner
from services.runtime import lateness
from services.runtime.config import ROOT, parse
from services.runtime.lateness import Lateness
from services.runtime.stage import Health, Stage
from tests.waiting import WAIT_S, until

PALM = {"port": "stub", "bundle": "square16"}
CONFIG = '[skins.palm]\nport = "stub"\nbundle = "square16"\nnetwork = "none"\n'


def measured(frame, ago_s=0.01):
    """With stamps of now; the bound is generous, for a machine that runs tests may be slow."""
    now = time.monotonic_ns()
    frame.stamps, frame.valid_for_s = {"sample": now - int(ago_s * 1e9), "read": now}, 20.0
    return frame


class Process:
    """preprocessing as a process of its own, fed by us in acquisition's place."""

    def __init__(self, folder):
        (folder / "skin.toml").write_text(CONFIG)
        self.upstream, self.log = Publisher("acquisition"), open(folder / "log", "w+")
        self.out = AllReader(["delta", "status", "info"], "palm", endpoint=f"ipc://{folder}/preprocessing.ipc")
        self.control = ControlClient("preprocessing", WAIT_S)
        self.env = dict(os.environ, EITSKIN_CONFIG=str(folder / "skin.toml"))

    def start(self, board):
        command = [sys.executable, "-m", "services.preprocessing"]
        self.popen = subprocess.Popen(command, cwd=ROOT, env=self.env, stderr=self.log)
        self.connect(board)

    def connect(self, board):
        until(lambda: self.send(board.frame()) and isinstance(self.out.recv(0.1), DeltaFrame), self.popen)

    def send(self, frame, ago_s=0.01):
        self.upstream.poll(), self.upstream.send(measured(frame, ago_s))
        return frame.scan

    def feed(self, board, n, difference=0.0, ago_s=0.01):
        """Send frames, each when the one before has come out; what came out."""
        scans = (self.send(board.frame(difference), ago_s) for _ in range(n))
        return [self.until(DeltaFrame, lambda f, scan=scan: f.scan == scan) for scan in scans]

    def until(self, kind, fits):
        return until(lambda: isinstance(f := self.out.recv(0.5), kind) and fits(f) and f, self.popen)

    def refused(self, match, kind, command, **args):
        with pytest.raises(ControlError, match=match) as refused:
            self.control.call(command, **args)
        assert refused.value.kind == kind

    def kill(self):
        self.popen.kill(), self.popen.wait()


@pytest.fixture
def process(runtime, board):
    made = Process(runtime)
    made.start(board)
    yield made
    made.kill()
    for each in (made.upstream, made.out, made.log):
        each.close()


@pytest.mark.live
def test_frames_commands_silence_and_a_crash(process, board, bundle, runtime):
    """One process, all the way: it takes seconds to start, so what can be looked at together is."""
    outs = process.feed(board, 80)
    first, last = outs[0], outs[-1]
    assert last.valid and not last.touched and last.source == "board" and last.valid_for_s == 20.0
    assert last.session == first.session and last.seq == first.seq + 79
    assert last.stamps["sample"] < last.stamps["read"] < last.stamps["preprocess"] <= time.monotonic_ns()
    latched = AllReader(["info"], "palm")
    info = until(lambda: (f := latched.recv(1)) and isinstance(f, InfoFrame) and "baseline" in f.info and f.info)
    assert info["bundle_hash"] == bundle.hash and len(info["baseline"]) == 120
    latched.close()

    for rubbish in (b"raw/palm\0\xc1", b"raw/palm\0" + bytes(range(256)), pack(board.frame())[:-7]):
        process.upstream.socket.send(rubbish)
        assert process.feed(board, 1)[0].valid
    (late,) = process.feed(board, 1, ago_s=30.0)
    assert not late.valid and "late" in late.reasons, "not silence, and not to be acted on"
    assert process.feed(board, 1)[0].valid
    status = process.until(StatusFrame, lambda f: f.counters["late"] == 1 and f.drops["malformed"] > 0)
    assert "30.0 s after they were measured" in " ".join(status.messages) and status.level != "OK"
    assert status.process == "preprocessing" and 0 < status.rates["delta"] and status.latency["work_p50"] > 0

    touch = board.disc(0.0, 0.0, 0.2, 0.3)
    assert process.feed(board, 3, touch)[-1].touched
    process.refused("touched", "refused", "tare", skin="palm")
    process.refused("configured: palm", "bad_request", "tare", skin="plam")
    assert process.feed(board, 1, touch)[-1].touched  # by the baseline that it had

    silent = process.until(StatusFrame, lambda f: f.level == "STALE")
    assert "no raw/palm" in " ".join(silent.messages) and not process.control.call("status")["flowing"]

    process.kill()
    process.start(board)
    again = process.feed(board, 1, touch)[0]
    assert again.valid and again.touched  # by the baseline of before the crash, although touched all the while
    assert again.session != last.session

    state = process.control.call("state", skin="palm")["state"]
    session = process.control.call("reset", skin="palm", new_session=True)["session"]
    out = process.feed(board, 1)[0]
    assert not out.valid and out.session == session and out.seq == 0
    process.control.call("load", skin="palm", state=state)
    assert process.feed(board, 1)[0].valid
    process.refused("does not fit", "refused", "load", skin="palm", state=state | {"hold": 3, "window": {}})
    process.popen.send_signal(signal.SIGTERM)
    assert process.popen.wait(WAIT_S) == 0 and "Traceback" not in (runtime / "log").read_text()


class Feed:
    """Frames that the test gives, all at once."""

    malformed = skipped = 0

    def __init__(self):
        self.socket, self._waiting = os.eventfd(0, os.EFD_NONBLOCK), []
        self.close = lambda: os.close(self.socket)

    def give(self, *frames):
        self._waiting += frames
        os.eventfd_write(self.socket, 1)

    def recv(self):
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.socket)
        return self._waiting.pop(0) if self._waiting else None


def raws(*ages_s, source="board"):
    """Frames that have queued up, measured so many seconds ago."""
    z, status = np.ones(120, np.complex64), np.zeros(120, np.uint8)
    frames = (RawFrame(skin="palm", scan=n, valid=True, z=z, status=status, source=source) for n in range(len(ages_s)))
    return [measured(frame, age) for frame, age in zip(frames, ages_s, strict=True)]


class Passing(Stage):
    """What comes in goes out. Notes what the runner tells it."""

    reads, writes, stamp = "", ("raw",), "read"
    fails = 0  # so many frames fail in what can wait

    def __init__(self, skin):
        super().__init__(skin)
        self.wanted, self.told = [], []
        self.joined, self.wake = self.told.append, lambda: self.told.append("awake")

    def process(self, frame, wanted):
        self.wanted.append(wanted)
        return [dataclasses.replace(frame, skin=self.skin)]

    def beside(self, wanted):
        if self.fails:
            self.fails -= 1
            raise ValueError(f"what can wait of scan {self.fails}")
        return []


@pytest.fixture
def driven(runtime):
    """Runs a runner, as a process would, while a thread does its steps; then ends it by a signal."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def drive(runner, steps):
        with ThreadPoolExecutor() as pool:
            done = pool.submit(steps)
            done.add_done_callback(lambda _: os.kill(os.getpid(), signal.SIGTERM))
            runner.run()
            done.result()

    yield drive
    signal.set_wakeup_fd(-1)
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.live
@pytest.mark.parametrize("skip", [True, False])
def test_what_queued_up_is_judged_and_what_fails_is_counted(driven, caplog, skip):
    runner = Runner("acquisition", parse({"skins": {"palm": PALM}, "skip": {"unwanted": skip}}))
    stage, feed = Passing("palm"), Feed()
    runner.add(stage, feed)
    out, control = AllReader(["raw"], "palm"), ControlClient("acquisition", WAIT_S)

    def sent(*frames, count):
        feed.give(*frames)
        seen = [until(lambda: out.recv(0.1)) for _ in range(count)]
        return [(frame.scan, frame.valid, frame.reasons) for frame in seen]

    def steps():
        until(lambda: "raw" in stage.told)
        stage.health = lambda: Health("ERROR", ["no board"])  # which says why no frames come
        time.sleep(1.0)
        assert control.call("status")["messages"] == ["no board"]
        del stage.health
        late = sent(*raws(90, 80, 1, 0.1, 70), count=3)
        assert late == [(2, True, []), (3, True, []), (4, False, ["late"])]
        assert control.call("status")["drops"] == {"late": 2, "failed": 0, "malformed": 0, "skipped": 0}
        replayed = sent(*raws(90, 80, source="replay"), count=2)
        assert replayed == [(0, True, []), (1, True, [])], "the same frames however slow the machine"
        assert stage.wanted[-1] == {"raw"}
        stage.fails = 3
        assert len(sent(*raws(0.1, 0.1, 0.1, 0.1), count=4)) == 4, "what can wait fails after the first has left"
        status = until(lambda: (said := control.call("status"))["failures"] == 3 and said)
        assert status["drops"]["failed"] == 3 and status["unlogged"] == 2 and "what can wait" in caplog.text

        out.close()
        until(lambda: runner.publisher.sent["status/palm"] > 1)  # nobody subscribes any more
        until(lambda: (feed.give(*raws(0.1)), stage.wanted[-1] == (frozenset() if skip else {"raw"}))[1])

    driven(runner, steps)


@pytest.mark.live
def test_who_subscribes_is_told_of_and_what_is_lacking_is_asked_for_by_subscribing(driven):
    upstream, asked = Publisher("inference"), []
    upstream.on_join = asked.append
    runner, stage = Runner("publisher", parse({"skins": {"palm": PALM}})), Passing("palm")
    stage.reads, stage.writes, stage.sleeps, stage.lacks = "image", ("contact",), True, True
    stage.process = lambda frame, wanted: []
    contacts, control = AllReader(["contact"], "palm"), ControlClient("publisher", WAIT_S)
    runner.add(stage)

    def pumped(what):
        until(lambda: (upstream.poll(), upstream.send(ImageFrame(skin="palm")), what())[2])

    def steps():
        pumped(lambda: "contact" in stage.told)
        pumped(lambda: len(asked) >= 5 and set(asked) == {b"image/palm\0", b"part/palm\0"})
        contacts.close()
        pumped(lambda: control.call("status")["idle"])
        asked.clear()
        again = AllReader(["contact"], "palm")
        pumped(lambda: asked and "awake" in stage.told[stage.told.index("contact") + 1 :])
        again.close()

    driven(runner, steps)
    upstream.close()


def test_a_stop_and_a_sleep_of_the_host_are_noticed_and_the_newest_is_taken_only(monkeypatch):
    """By the loop's own time; and by the clock that goes on while the host is suspended. Ages are of the real one."""
    clock = SimpleNamespace(now=1000.0, slept=0.0, naps=[], monotonic_ns=time.monotonic_ns)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(lateness, "time", clock)
    monkeypatch.setattr(lateness, "pause", clock.naps.append)
    monkeypatch.setattr("protocol.ages._slept_ns", lambda: int(clock.slept * 1e9))
    judge = Lateness()

    def after(seconds, timeout_s):
        clock.now += seconds
        return judge.stood_still(timeout_s)

    def news(stood, source="board"):
        return [frame.scan for frame in judge.news(raws(30.0, 1.0, 0.5, 25.0, source=source), stood)]

    assert news(stood=False) == [1, 2, 3] and news(stood=True) == [3]
    assert news(stood=True, source="replay") == [0, 1, 2, 3]
    assert not after(0.2, 0.2) and not after(0.01, -3.0) and not after(0.29, 0.2) and not clock.naps
    assert after(0.31, 0.2) and len(clock.naps) == 1 and not after(0.2, 0.2)
    (frame,) = raws(0.1)
    assert not judge.late(frame)
    clock.slept = 30.0
    assert after(0.0, 0.2), "the monotonic clock stood still"
    assert judge.late(frame), "measured before the host slept"
    assert not judge.late(raws(0.0)[0]) and not after(0.2, 0.2)
    judge.close()
