"""Waiting for what a live test is about to see: no test asserts how long it took."""

import subprocess
import time
from collections.abc import Callable
from typing import TypeVar

WAIT_S = 60.0  # for anything; what comes at all comes far sooner
POLL_S = 0.005
T = TypeVar("T")


def until(condition: Callable[[], T], *processes: subprocess.Popen[bytes] | subprocess.Popen[str]) -> T:
    """What `condition` gives once it is true. Fails after WAIT_S, and at once where one of `processes` has ended."""
    end = time.monotonic() + WAIT_S
    while not (found := condition()):
        ended = [f"{p.args} (exit {p.returncode})" for p in processes if p.poll() is not None]
        assert not ended, f"ended while a test waited for it: {ended}"
        assert time.monotonic() < end, f"waited {WAIT_S:g} s in vain"
        time.sleep(POLL_S)
    return found


def end(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> None:
    """End a process as its user would; by force where it does not, so that it takes nothing from the tests after."""
    process.terminate()
    try:
        process.wait(WAIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
