"""A step of the system's clock changes nothing: supervision, and the whole service, under libfaketime."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.sockets import NewestReader
from services.runtime import persistence
from services.runtime.config import ROOT
from tests import needs
from tests.services.test_supervisor import UP, starts, wait_for

pytestmark = pytest.mark.live

HOUR_S = 3600
CONFIG = '[skins.palm]\nport = "stub"\nbundle = "square16"\nnetwork = "none"\n'


class Clock:
    """The system's clock as programs with `environment` see it; the monotonic one is left alone, as the kernel does."""

    def __init__(self, folder: Path) -> None:
        needs.FAKETIME.here()
        found = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
        self._file, self.ahead_s = folder / "clock", 0
        self.step(0)
        self.environment = {
            **os.environ,
            "LD_PRELOAD": str(found[0]),
            "FAKETIME_TIMESTAMP_FILE": str(self._file),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }

    def step(self, seconds: int) -> None:
        self.ahead_s += seconds
        fresh = self._file.with_name("clock.new")
        fresh.write_text(f"{self.ahead_s:+d}")
        os.replace(fresh, self._file)


@pytest.fixture
def clock(runtime: Path) -> Clock:
    return Clock(runtime)


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[bytes]]]:
    found: list[subprocess.Popen[bytes]] = []
    yield found
    for process in found:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def test_a_failing_program_is_retried_while_the_clock_is_set_back_again_and_again(
    clock: Clock, runtime: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    log = runtime / "f"
    started.append(subprocess.Popen([sys.executable, "-c", UP, f"f,{log},fail"], cwd=ROOT, env=clock.environment))
    wait_for(lambda: len(starts(log)) >= 3, 30)
    over = threading.Event()

    def set_back() -> None:
        while not over.wait(0.1):
            clock.step(-10)

    setting = threading.Thread(target=set_back)
    setting.start()
    try:
        wait_for(lambda: len(starts(log)) >= 5, 15)
    finally:
        over.set()
        setting.join()


def test_frames_go_on_and_a_killed_process_comes_back(
    clock: Clock, runtime: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    (runtime / "skin.toml").write_text(CONFIG)
    said = runtime / "said"
    with said.open("wb") as log:
        command = [sys.executable, str(ROOT / "skin"), "up", "--config", str(runtime / "skin.toml")]
        started.append(subprocess.Popen(command, env=clock.environment, stdout=log, stderr=log))
    service = started[0]
    reader = NewestReader("contact", "palm", f"ipc://{runtime}/publisher.ipc")

    def valid() -> bool:
        assert service.poll() is None, said.read_text()
        frame = reader.recv(0.5)
        return frame is not None and frame.valid

    def processes() -> set[str]:
        return set(Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split())

    try:
        wait_for(valid, 60)
        running = processes()
        for step in (-HOUR_S, 24 * HOUR_S, -30 * 24 * HOUR_S):
            clock.step(step)
            wait_for(lambda: sum(valid() for _ in range(25)) >= 20, 30)
        assert processes() == running
        os.kill(_named(running, b"services.preprocessing"), signal.SIGKILL)
        clock.step(-HOUR_S)
        wait_for(lambda: processes() != running, 10)
        wait_for(valid, 30)
    finally:
        reader.close()
    log_text = said.read_text()
    assert "Traceback" not in log_text and "in the future" not in log_text and "clock set back" not in log_text
    assert "took over the baseline of" in log_text


def _named(pids: set[str], module: bytes) -> int:
    return next(int(pid) for pid in pids if module in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"))


@pytest.mark.parametrize("step_s", [-HOUR_S, 24 * HOUR_S])
def test_a_kept_state_is_as_old_as_it_is(runtime: Path, monkeypatch: pytest.MonkeyPatch, step_s: int) -> None:
    persistence.save("preprocessing", "palm", {"quiet_s": 1.5})
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + step_s)
    found = persistence.restore("preprocessing", "palm")
    assert found is not None and found[1] < 60
