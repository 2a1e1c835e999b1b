"""Processes: supervision, while the system's clock runs backwards; healthcheck, real time, waiting for many sockets."""

import contextlib
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
import zmq

from protocol.sockets import ControlError, ControlServer
from services import health
from services.runtime import realtime, supervision
from services.runtime.config import ROOT, load
from services.runtime.config_sections import RealTime
from services.runtime.stage import Health
from services.runtime.supervision import programs
from services.runtime.waiting import Waiter
from tests.waiting import WAIT_S, until

UP = """
import sys, time
began, real = time.monotonic(), time.time()
time.time = lambda: real - 100 * (time.monotonic() - began)
from services.runtime.config import load
from services.runtime.supervision import Program, up
args = [a.split(",") for a in sys.argv[1:]]
sys.exit(up(load(), wanted=[Program(name, "tests.services.patient", tuple(rest)) for name, *rest in args]))
"""


def starts(log):
    return [float(line) for line in log.read_text().splitlines()] if log.exists() else []


def children(pid):
    """Name (of its log) -> pid of our patients under a supervisor."""
    pids = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    args = {child: Path(f"/proc/{child}/cmdline").read_text().split("\0") for child in pids}
    return {Path(said[3]).name: int(child) for child, said in args.items() if "tests.services.patient" in said}


def alive(pid):
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"


@pytest.fixture
def up(runtime):
    started = []

    def start(*programs):
        command = [sys.executable, "-c", UP, *programs]
        started.append(subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        return started[-1]

    yield start
    for popen in started:
        popen.kill(), popen.communicate()


@pytest.mark.live
def test_killed_programs_come_back_and_a_stop_ends_all_and_leaves_only_what_is_to_stay(up, runtime):
    """Sockets of the programs that ran, the stub's links and supervisord's files go; others' sockets stay."""
    a, b = runtime / "a", runtime / "b"
    service = up(f"acquisition,{a}", f"stub,{b}")
    until(lambda: starts(a) and starts(b), service)
    victim = children(service.pid)["a"]
    os.kill(victim, signal.SIGKILL)
    until(lambda: children(service.pid).get("a", victim) != victim and len(starts(a)) == 2, service)
    assert len(starts(b)) == 1

    out, _ = (second := up(f"c,{runtime / 'c'}")).communicate(timeout=WAIT_S)
    assert second.returncode == 1 and f"in use by process {service.pid}" in out and not (runtime / "c").exists()

    for name in ("acquisition.ipc", "acquisition.ctl", "stub.ctl", "recorder.ctl"):
        (runtime / name).touch()
    for name in ("board-palm", "board2"):
        (runtime / name).symlink_to("/dev/pts/none")
    pids = list(children(service.pid).values())
    service.send_signal(signal.SIGTERM)
    assert service.wait(WAIT_S) == 0 and len(pids) == 2 and not any(alive(pid) for pid in pids)
    assert {p.name for p in runtime.iterdir()} == {"a", "b", "lock", "recorder.ctl"}


@pytest.mark.live
def test_a_program_that_keeps_failing_is_retried_ever_more_slowly(up, runtime):
    log = runtime / "f"
    service = up(f"f,{log},fail")
    until(lambda: len(starts(log)) >= 5, service)
    gaps = [b - a for a, b in pairwise(starts(log))]
    assert all(gap > 0.95 * least_s for gap, least_s in zip(gaps, (0.1, 0.2, 0.4, 0.8), strict=False))


def test_the_first_retry_comes_after_a_tenth_of_a_second_and_the_later_ones_within_five(monkeypatch):
    monkeypatch.setattr(supervision.Subprocess, "change_state", lambda *_: True)
    monkeypatch.setattr(supervision, "time", SimpleNamespace(monotonic=lambda: 100.0))
    stage, after = object.__new__(supervision._Stage), []
    for stage.backoff in range(1, 9):
        stage.change_state(supervision.ProcessStates.BACKOFF)
        after.append(stage.delay - 100.0)
    assert after == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])


@pytest.mark.live
def test_children_do_not_outlive_a_killed_supervisor(up, runtime):
    service = up(f"a,{runtime / 'a'}")
    until(lambda: starts(runtime / "a"), service)
    pid = children(service.pid)["a"]
    service.kill()
    until(lambda: not alive(pid))


def test_what_is_started_is_what_is_configured(tmp_path):
    found = {p.name: p.module for p in programs(load(ROOT / "skin.toml"))}
    assert found.pop("stub") == "firmware_stub" and found.pop("page") == "services.bridge"
    assert all(module == f"services.{name}" for name, module in found.items())
    assert list(found) == ["acquisition", "preprocessing", "inference", "publisher", "recorder"]
    config, text = tmp_path / "skin.toml", '[skins.palm]\nport = "stub"\nbundle = "square16"\n'
    for more, arguments in (("", None), ('[recorder]\nfolder = "kept"\n', ("--wait", "--folder", f"{tmp_path}/kept"))):
        config.write_text(text + more)
        assert {p.name: p.arguments for p in programs(load(config))}.get("recorder") == arguments


def found(process, status):
    """What the check finds in a process whose control socket knows nothing but `status`."""
    server = ControlServer(process, {"status": status})
    with ThreadPoolExecutor() as pool, contextlib.closing(server):
        said = pool.submit(health.check, process, ["palm", "back"])
        while not said.done():
            server.serve_once(0.02)
        return said.result()


def stage(**flowing):
    def status(args):
        skin = args.get("skin") or next(iter(flowing))
        if skin not in flowing:
            raise ControlError("bad_request", f"no skin called {skin!r}")
        return {"flowing": flowing[skin], "quiet_s": 7.0, "messages": [f"{skin} is unplugged"]}

    return status


def recorder(growing):
    counts = {"contact/palm": 10, "status/palm": 3}

    def status(args):
        counts[growing] += 5
        return {"file": "x.mcap", "messages": dict(counts), "gaps": 0}

    return status


@pytest.mark.live
def test_a_process_is_well_while_frames_of_every_skin_flow(runtime, monkeypatch):
    monkeypatch.setattr(health, "GROWING_S", 0.01)
    for process, status, expected in (
        ("inference", stage(palm=True, back=True), []),
        ("inference", stage(palm=True, back=False), ["no frames of back for 7.0 s", "back is unplugged"]),
        ("inference", stage(palm=False, back=False), ["no frames of palm", "no frames of back"]),
        ("inference", stage(palm=True), ["no skin called 'back'"]),
        ("stub", lambda args: {"scanning": True, "plugged": True}, []),
        ("stub", lambda args: {"scanning": False, "plugged": True}, ["stub: not scanning"]),
        ("stub", lambda args: {"scanning": True, "plugged": False}, ["stub: unplugged"]),
        ("recorder", recorder("contact/palm"), []),
        ("recorder", recorder("status/palm"), ["recorder"]),
    ):
        said = found(process, status)
        assert all(text in said for text in expected) and bool(said) == bool(expected), (process, expected, said)
    monkeypatch.setattr(health, "TIMEOUT_S", 0.05)
    assert health.check("publisher", ["palm"]).startswith("publisher: publisher does not answer")


@pytest.mark.live
def test_what_is_asked_of_the_kernel_is_had_or_said(monkeypatch):
    """Pinning needs no privilege, and is for the process named."""
    mine, asked = os.sched_getaffinity(0), []
    last = max(mine)
    for cpus, pinned, said in (({"inference": [last]}, {last}, []), ({"publisher": [last]}, mine, [])):
        assert (realtime.apply(RealTime(cpus=cpus), "inference"), os.sched_getaffinity(0)) == (said, pinned)
        os.sched_setaffinity(0, mine)
    (said,) = realtime.apply(RealTime(cpus={"inference": [last, 4000]}), "inference")
    assert "not on processors" in said and "4000" in said and os.sched_getaffinity(0) == {last}
    os.sched_setaffinity(0, mine)

    def refuse(pid, policy, param):
        asked.append((policy, param.sched_priority))
        raise PermissionError(1, "not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(realtime, "_lock_memory", lambda: "limited")
    priority, memory = realtime.apply(RealTime(priority=20, lock_memory=True), "inference")
    assert "priority 20" in priority and "CAP_SYS_NICE" in priority and asked == [(os.SCHED_FIFO, 20)]
    assert "not locked: limited" in memory and realtime.apply(RealTime(), "inference") == []


def test_a_problem_of_the_process_makes_its_health_a_warning():
    told = Health("OK", [], {"frames": 3}).with_problems(["no real-time priority"])
    assert (told.level, told.messages, told.counters) == ("WARN", ["no real-time priority"], {"frames": 3})
    assert Health("ERROR", ["broken"]).with_problems(["more"]).level == "ERROR"


@pytest.fixture
def context():
    yield (made := zmq.Context())
    made.destroy(0)


def pair(context, waiter, k=0, newest=0):
    """(sender, receiver), the receiver registered; newest: it holds the newest message alone."""
    send, receive = context.socket(zmq.PUSH), context.socket(zmq.PULL)
    receive.setsockopt(zmq.CONFLATE, newest)
    receive.bind(f"inproc://{k}")
    send.connect(f"inproc://{k}")
    waiter.register(receive)
    return send, receive


def silence(waiter):
    """What is registered is asked once, whether it has something or not."""
    while waiter.wait(0.02):
        pass


@pytest.mark.live
def test_only_what_has_something_comes_and_what_is_not_read_empty_comes_again(context):
    waiter = Waiter()
    pairs = [pair(context, waiter, k) for k in range(40)]
    silence(waiter)
    for k in (7, 30) * 5:
        pairs[k][0].send(b"x")
    assert set(map(id, waiter.wait(1.0) + waiter.wait(0.0))) == {id(pairs[k][1]) for k in (7, 30)}
    for k in (7, 30) * 5:  # one each time, as a channel that takes the newest does
        assert pairs[k][1] in waiter.wait(1.0) and pairs[k][1].recv(zmq.NOBLOCK) == b"x"
    silence(waiter)
    send, receive = pairs[3]
    send.send(b"x")
    receive.get(zmq.EVENTS)  # another use of the socket takes the signal
    waiter.doubt()
    assert waiter.wait(0.0) == [receive]
    receive.recv()
    silence(waiter)
    assert waiter.wait(-1.0) == []  # a deadline that is over
    waiter.close()


@pytest.mark.live
def test_a_message_between_reading_and_waiting_is_not_missed(context):
    """The descriptor does not wake again for a message that came while the socket was read."""
    waiter = Waiter()
    send, receive = pair(context, waiter, newest=1)
    for k in range(2000):
        send.send(b"%d" % k)
        assert receive in waiter.wait(1.0), k
        send.send(b"%d again" % k)  # its signal is taken by the read below, or is not
        if receive.recv(zmq.NOBLOCK) == b"%d" % k:
            assert receive in waiter.wait(1.0), k
            assert receive.recv(zmq.NOBLOCK) == b"%d again" % k
    waiter.close()
