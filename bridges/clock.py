"""When a frame was measured by the system's time: nanoseconds since 1970, as ROS and Foxglove have it."""

from __future__ import annotations

import time

TRIES = 5


class WallClock:
    """How far the system's time is ahead of the monotonic clock that frames are stamped with. Measured again and
    again, since the system's time is set now and then (NTP).
    """

    def __init__(self) -> None:
        self.offset_ns, self.uncertainty_ns = 0, 0
        """The offset, and by how much it may be off."""
        self.steps = 0
        """How often the system's time was set by more than a millisecond."""
        self.measure()
        self.steps = 0

    def measure(self) -> None:
        """Read the one clock between two readings of the other; the closest pair counts."""
        best: tuple[int, int] | None = None
        for _ in range(TRIES):
            before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            if best is None or after - before < 2 * best[1]:
                best = wall - (before + after) // 2, (after - before + 1) // 2
        assert best is not None
        self.steps += abs(best[0] - self.offset_ns) > 1_000_000
        self.offset_ns, self.uncertainty_ns = best

    def time_ns(self, monotonic_ns: int) -> int:
        """The system's time at an instant of this host's monotonic clock."""
        return monotonic_ns + self.offset_ns
