"""The place itself: what runs in it never outlives the tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.docs.snippets import ROOT

TESTS = """
import os, shlex, sys
from pathlib import Path
from tests.docs.world import World
here = Path(sys.argv[1])
sleeps = shlex.join([sys.executable, "-c", "import time; time.sleep(600)"])
with World(here, here, dict(os.environ)).started(sleeps) as process:
    print(process.pid, flush=True)
    process.wait()
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_command_ends_with_tests_that_are_killed(tmp_path: Path, how: signal.Signals) -> None:
    tests = subprocess.Popen([sys.executable, "-c", TESTS, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert tests.stdout is not None
    with tests, tests.stdout:
        started = Path("/proc", str(int(tests.stdout.readline())))
        end = time.monotonic() + 30
        while not (line := (started / "cmdline").read_text()) and time.monotonic() < end:  # the kernel replaces it
            time.sleep(0.02)
        assert "sleep" in line
        tests.send_signal(how)
    end = time.monotonic() + 30
    while (running := "State:\tZ" not in _status(started)) and time.monotonic() < end:
        time.sleep(0.02)
    if running:
        os.kill(int(started.name), signal.SIGKILL)
    assert not running


def _status(process: Path) -> str:
    try:
        return (process / "status").read_text()
    except OSError:
        return "State:\tZ"
