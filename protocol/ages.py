"""How old a frame is by this host's clock, also after the host slept, and for stamps of another host's clock.

CLOCK_MONOTONIC stands still while the host is suspended; CLOCK_BOOTTIME does not, so their difference shows the sleep.
Another host's stamps cannot be compared with our clock until that host has told its own; a thread asks, so that nobody
waits. Until then a frame's least age is what its own stamps say that it took to be sent, plus its waiting time here.
"""

from __future__ import annotations

import logging
import threading
import time

from .control import ControlClient, ControlError, clock_offset
from .frames import Frame
from .runtime import host_id

ASK_AGAIN_S = 5.0
"""How often another host's clock is asked; in between, two clocks drift apart by DRIFT at most."""
DRIFT = 2e-4
FORGET_S = 60.0
"""An answer older than that says nothing any more: the other host may have slept, or have been started anew."""
TIMEOUT_S = 1.0
SLEPT_NS = 20_000_000
"""Less than that may have passed between reading the one clock and the other."""
BOOTTIME = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)

log = logging.getLogger(__name__)


class Ages:
    """The ages of the frames that one thread reads. `processes`: those to ask for their host's clock."""

    def __init__(self, processes: tuple[str, ...] = ("acquisition", "publisher")) -> None:
        self._processes = processes
        self._slept_ns = _slept_ns()
        self._woke_ns = 0
        self._missed_ns = 0  # by stamps from before `_woke_ns`
        self._other: OtherClocks | None = None

    def look(self) -> bool:
        """Notice that the host has slept; whether it has since the last look. Called by each of the others."""
        slept = _slept_ns()
        if slept - self._slept_ns < SLEPT_NS:
            return False
        self._missed_ns += slept - self._slept_ns
        self._slept_ns, self._woke_ns = slept, time.monotonic_ns()
        if self._other is not None:
            self._other.forget()
        return True

    def measured_ns(self, frame: Frame, received_ns: int) -> int | None:
        """When a frame was measured, by our clock and not later than it can have been; None where it does not say.
        `received_ns`: by when it had arrived here, at the latest.

        A replayed frame counts as measured when it was read, and its host is ours or nothing can be said.
        """
        self.look()
        sample = frame.stamps.get("read" if frame.source == "replay" else "sample")
        if sample is None:
            return None
        if frame.host in ("", host_id()):
            return min(sample, received_ns)
        there = max(frame.stamps.values()) - sample  # how long it took to be sent
        born = received_ns - max(0, there)
        if self._other is None:
            self._other = OtherClocks(self._processes)
        offset = self._other.ahead_ns(frame.host)
        return born if offset is None else min(born, sample - offset)

    def age_s(self, measured_ns: int) -> float:
        """Seconds since then, those in which this host slept among them."""
        self.look()
        age = time.monotonic_ns() - measured_ns
        if measured_ns < self._woke_ns:
            age += self._missed_ns
        return age * 1e-9

    def close(self) -> None:
        if self._other is not None:
            self._other.close()
            self._other = None


class OtherClocks:
    """The monotonic clocks of the hosts that some processes run on, asked again and again by a thread."""

    def __init__(self, processes: tuple[str, ...]) -> None:
        self._found: dict[str, tuple[str, int, int, int]] = {}  # process -> host, offset, uncertainty, when [ns]
        self._processes = processes
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="clocks of other hosts", daemon=True)
        self._thread.start()

    def ahead_ns(self, host: str) -> int | None:
        """The most by which that host's clock may be ahead of ours, so that a frame's age is overestimated rather than
        underestimated. None where no process says that it runs on that host.
        """
        now = time.monotonic_ns()
        for found, offset, uncertainty, asked_ns in list(self._found.values()):
            if found == host and now - asked_ns < FORGET_S * 1e9:
                return offset + uncertainty + int(DRIFT * (now - asked_ns))
        return None

    def forget(self) -> None:
        """Forget all offsets: our own clock has stood still."""
        self._found.clear()

    def _ask(self) -> None:
        while not self._stop.is_set():
            for process in self._processes:
                client = ControlClient(process, TIMEOUT_S)
                try:
                    host = str(client.call("clock").get("host"))
                    offset, uncertainty = clock_offset(client, host=host)
                except ControlError as why:
                    log.debug("the clock of %s: %s", process, why)
                else:
                    self._found[process] = host, offset, uncertainty, time.monotonic_ns()
            self._stop.wait(ASK_AGAIN_S)

    def close(self) -> None:
        """Ask no more. The thread ends by itself, within its timeout."""
        self._stop.set()


def _slept_ns() -> int:
    """How long this host has been suspended since it started."""
    return time.clock_gettime_ns(BOOTTIME) - time.monotonic_ns()
