"""After a process that stood still while the touch changed, live: `skin up` with its stub, seen from outside."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import pytest

from protocol.control import ControlClient
from protocol.frames import ContactFrame
from protocol.sockets import AllReader
from services.runtime.stage import PROCESSES
from tests.processes import pid_of
from tests.services.gap_host import FAR_M, Press, Wrong, what_is_wrong

STOPS_S = (0.2, 1.0, 3.0)
MODULES = (*(f"services.{name}" for name in PROCESSES), "firmware_stub")
PLACES = ((-0.03, 0.03), (0.025, -0.02))  # each is pressed in turn: once both are solved the stub measures them at once
AFTER_S = 0.4  # how long is looked after the new touch is shown
PATIENCE_S = 20.0
CLOCKS_S = 0.005  # the board's, as acquisition knows it, and ours


class Finger:
    """Goes from one place to another at once; what is known of when."""

    def __init__(self) -> None:
        self.presses: list[Press] = []

    def press(self, x: float, y: float) -> None:
        before_s = time.monotonic()
        ControlClient("stub", PATIENCE_S).call("press", x=x, y=y, force=3.0, seconds=300.0, finger="one")
        took_s = time.monotonic() - before_s
        if self.presses:
            last = self.presses[-1]
            self.presses[-1] = Press(last.x, last.y, last.start, before_s + took_s, ramp=max(last.ramp, took_s))
        self.presses.append(Press(x, y, before_s, math.inf, ramp=took_s))


class Watcher:
    """Reads every contact frame, and keeps those that are valid."""

    def __init__(self) -> None:
        self.reader = AllReader(["contact"], "palm")
        self.valid: list[ContactFrame] = []

    def look(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            frame = self.reader.recv(left)
            if isinstance(frame, ContactFrame) and frame.valid:
                self.valid.append(frame)

    def until_shown(self, x: float, y: float) -> None:
        """Until this place is all that is shown, as what was measured just now."""
        now_ns, end = time.monotonic_ns(), time.monotonic() + PATIENCE_S
        while not self._shows(now_ns, x, y):
            assert time.monotonic() < end, f"({x}, {y}) was not shown; last: {self.valid[-1:]}"
            self.look(0.02)

    def _shows(self, since_ns: int, x: float, y: float) -> bool:
        if not self.valid or self.valid[-1].stamps["sample"] < since_ns:
            return False
        shown = [c for c in self.valid[-1].contacts if c.state != "end"]
        return len(shown) == 1 and math.hypot(shown[0].position[0] - x, shown[0].position[1] - y) < FAR_M


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.slow
@pytest.mark.usefixtures("service_that_nobody_hears")
@pytest.mark.parametrize("service_that_nobody_hears", ["full", "rolling"], indirect=True)
def test_no_process_that_stood_still_hides_a_touch_or_shows_one_that_is_gone() -> None:
    finger, watcher = Finger(), Watcher()
    for place in PLACES:
        finger.press(*place)
        watcher.until_shown(*place)
    wrong: list[tuple[str, float, str]] = []
    for n, (module, seconds) in enumerate(product(MODULES, STOPS_S)):
        begin_ns, to = time.monotonic_ns(), PLACES[n % 2]
        moves = threading.Timer(0.3 * seconds, finger.press, to)
        with stopped(pid_of(module)):
            moves.start()
            watcher.look(seconds)
        moves.join()
        watcher.until_shown(*to)
        watcher.look(AFTER_S)
        since = [frame for frame in watcher.valid if frame.stamps["sample"] >= begin_ns]
        assert len(since) > 3
        for frame in since:
            for what in what_is_wrong(frame, finger.presses, CLOCKS_S):
                wrong.append((module, seconds, str(Wrong(frame.stamps["sample"] * 1e-9, what, frame))))
    assert not wrong, "\n".join(map(str, wrong))
