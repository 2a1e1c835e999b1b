"""HostTime and Suspensions are this host's clocks as acquisition needs them. Tests have clocks of their own."""

from __future__ import annotations

import time

from protocol.pause import pause

STOOD_STILL_S = 0.2  # a loop that comes round every 0.1 s has not run for so long: stopped, suspended, swapped out
SUSPENDED_NS = 50_000_000  # that the suspended time must have grown by
READ_NS = 1_000_000  # two clocks read within this belong together


class HostTime:
    """The monotonic clock, and what it has missed."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def suspended_ns(self) -> int:
        """Returns for how long this machine has been suspended in all: the monotonic clock stands still then."""
        if not hasattr(time, "CLOCK_BOOTTIME"):  # not Linux
            return 0
        while True:
            before = time.monotonic_ns()
            boot = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            after = time.monotonic_ns()
            if after - before < READ_NS:
                return boot - (before + after) // 2

    def sleep(self, seconds: float) -> None:
        pause(seconds)


class Suspensions:
    """Suspensions tells whether the machine was suspended since it was asked last."""

    def __init__(self, host: HostTime) -> None:
        self._host, self._known_ns = host, host.suspended_ns()

    def happened(self) -> bool:
        known_ns, self._known_ns = self._known_ns, self._host.suspended_ns()
        return self._known_ns - known_ns > SUSPENDED_NS
