"""Supervision, on a real supervisor with small programs: restarts, back-off, stop, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from services.runtime.config import ROOT, load
from services.runtime.supervision import programs

pytestmark = pytest.mark.live

UP = """
import sys
from services.runtime.config import load
from services.runtime.supervision import Program, up
from protocol.runtime import AlreadyRunning
args = [a.split(",") for a in sys.argv[1:]]
try:
    sys.exit(up(load(), wanted=[Program(name, "tests.services.patient", tuple(rest)) for name, *rest in args]))
except AlreadyRunning as why:
    sys.exit(f"refused: {why}")
"""
SLOW = 3.0  # how much longer than on a machine of one's own things may take here


def starts(log: Path) -> list[float]:
    return [float(line) for line in log.read_text().splitlines()] if log.exists() else []


def wait_for(what: Callable[[], object], timeout_s: float = 20.0) -> float:
    """Seconds until `what` is true."""
    began = time.monotonic()
    while time.monotonic() - began < timeout_s:
        if what():
            return time.monotonic() - began
        time.sleep(0.01)
    raise AssertionError("it did not happen")


def children(pid: int) -> dict[str, int]:
    """Name (last but one argument's file) -> pid of our patients under a supervisor."""
    found = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        args = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
        if b"tests.services.patient" in args:
            found[Path(args[3].decode()).name] = int(child)
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.fixture
def up(runtime: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []

    def start(*programs: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", UP, *programs]
        started.append(subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        return started[-1]

    yield start
    for popen in started:
        if popen.poll() is None:
            popen.kill()
        popen.communicate()


def test_killed_programs_come_back_and_all_stop_together(
    up: Callable[..., subprocess.Popen[str]], runtime: Path
) -> None:
    a, b = runtime / "a", runtime / "b"
    service = up(f"a,{a}", f"b,{b}")
    wait_for(lambda: starts(a) and starts(b))
    time.sleep(0.2)
    victim = children(service.pid)["a"]
    os.kill(victim, signal.SIGKILL)
    took = wait_for(lambda: children(service.pid).get("a", victim) != victim)
    assert took < 0.2 * SLOW
    wait_for(lambda: len(starts(a)) == 2)
    assert len(starts(b)) == 1

    second = up(f"c,{runtime / 'c'}")
    out, _ = second.communicate(timeout=30)
    assert second.returncode == 1 and f"in use by process {service.pid}" in out

    pids = list(children(service.pid).values())
    service.send_signal(signal.SIGTERM)
    began = time.monotonic()
    assert service.wait(10) == 0
    assert time.monotonic() - began < 3.0
    assert len(pids) == 2 and not any(alive(pid) for pid in pids)


def test_a_program_that_keeps_failing_is_retried_ever_more_slowly(
    up: Callable[..., subprocess.Popen[str]], runtime: Path
) -> None:
    log = runtime / "f"
    up(f"f,{log},fail")
    wait_for(lambda: len(starts(log)) >= 5, 30)
    at = starts(log)
    gaps = [b - a for a, b in zip(at, at[1:], strict=False)]
    assert gaps[3] > gaps[0] + 0.3  # 0.1, 0.2, 0.4, 0.8 s and what starting takes


def test_children_do_not_outlive_a_killed_supervisor(up: Callable[..., subprocess.Popen[str]], runtime: Path) -> None:
    log = runtime / "a"
    service = up(f"a,{log}")
    wait_for(lambda: starts(log))
    pid = children(service.pid)["a"]
    service.kill()
    wait_for(lambda: not alive(pid), 5)


def test_a_stop_leaves_only_what_is_to_stay(up: Callable[..., subprocess.Popen[str]], runtime: Path) -> None:
    """Sockets of the programs that ran, the stub's links and supervisord's files go; others' sockets stay."""
    log = runtime / "a"
    ours = ["acquisition.ipc", "acquisition.ctl", "stub.ctl"]
    others = ["recorder.ctl", "board.txt"]
    service = up(f"acquisition,{log}", f"stub,{runtime / 's'}")
    wait_for(lambda: starts(log) and starts(runtime / "s"))
    for name in ours + others:
        (runtime / name).touch()
    (runtime / "state").mkdir()
    for name in ("board-palm", "board2"):
        (runtime / name).symlink_to("/dev/pts/none")
    assert (runtime / "supervisord.conf").exists() and (runtime / "supervisord.pid").exists()
    service.send_signal(signal.SIGTERM)
    assert service.wait(10) == 0
    assert {p.name for p in runtime.iterdir()} == {"a", "s", "lock", "state", *others}


def test_the_demo_has_a_stub_a_page_and_a_recorder_and_every_stage_names_itself() -> None:
    found = {p.name: p.module for p in programs(load(ROOT / "skin.toml"))}
    assert found.pop("stub") == "firmware_stub" and found.pop("page") == "services.bridge"
    assert all(module == f"services.{name}" for name, module in found.items())
    assert list(found) == ["acquisition", "preprocessing", "inference", "publisher", "recorder"]


def test_a_recorder_is_started_where_it_is_configured_and_records_at_once_where_asked(tmp_path: Path) -> None:
    config = tmp_path / "skin.toml"
    config.write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    assert "recorder" not in {p.name for p in programs(load(config))}
    assert "--wait" not in {p.name: p for p in programs(load(config), tmp_path / "x")}["recorder"].arguments
    with config.open("a") as file:
        file.write('[recorder]\nfolder = "kept"\n')
    arguments = {p.name: p for p in programs(load(config))}["recorder"].arguments
    assert arguments == ("--wait", "--folder", str(tmp_path / "kept"))
