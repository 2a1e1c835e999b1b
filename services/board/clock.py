"""When was a scan measured, on the host's clock? By regression of the time at which frames arrive on the board's own
clock.

A frame arrives late by the link and by the scheduler: always late, never early, and by a varying amount. So the line
is fitted to the earliest arrivals: of each BLOCK frames only the one that came soonest after the current line counts.
The slope is the board's crystal against ours; it is bounded, because a crystal wrong by more than MAX_RATE_ERROR is a
broken clock.
"""

from __future__ import annotations

from collections import deque

BLOCK = 16
BLOCKS = 64
MAX_RATE_ERROR = 1e-3
UNSETTLED_NS = 5_000_000  # standard deviation stated before the first block is full
RESET_NS = 500_000_000  # a frame that is off the line by more: the board's clock was restarted


class DeviceClock:
    """Maps device time to host monotonic time. One object a connection."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: a new connection, or a device clock that jumped."""
        self._origin: tuple[int, int] | None = None  # device ns, host ns
        self._block: list[tuple[float, float]] = []
        self._points: deque[tuple[float, float]] = deque(
            maxlen=BLOCKS
        )  # device s since origin, lateness s against slope 1
        self._slope = 0.0
        self._offset = 0.0
        self.sigma_ns = UNSETTLED_NS
        self.resets = 0

    def observe(self, device_us: int, arrival_ns: int) -> None:
        """A frame that the board finished at device_us arrived at arrival_ns (host monotonic)."""
        if self._origin is None:
            self._origin = (device_us * 1000, arrival_ns)
        device_ns, host_ns = device_us * 1000 - self._origin[0], arrival_ns - self._origin[1]
        late_s = (host_ns - device_ns) * 1e-9
        if abs(late_s - self._line(device_ns * 1e-9)) * 1e9 > RESET_NS:
            resets = self.resets + 1
            self.reset()
            self.resets = resets
            self._origin, device_ns, late_s = (device_us * 1000, arrival_ns), 0, 0.0
        if not self._points:
            self._offset = late_s if not self._block else min(self._offset, late_s)
        self._block.append((device_ns * 1e-9, late_s))
        if len(self._block) == BLOCK:
            self._points.append(min(self._block, key=lambda point: point[1] - self._slope * point[0]))
            self._block.clear()
            self._fit()

    def host_ns(self, device_us: int) -> int:
        """Host monotonic time [ns] at which the board's clock showed device_us."""
        if self._origin is None:
            raise ValueError("no frame was observed yet")
        device_ns = device_us * 1000 - self._origin[0]
        return self._origin[1] + device_ns + round(self._line(device_ns * 1e-9) * 1e9)

    def _line(self, device_s: float) -> float:
        return self._offset + self._slope * device_s

    def _fit(self) -> None:
        n = len(self._points)
        mean_t = sum(t for t, _ in self._points) / n
        mean_late = sum(late for _, late in self._points) / n
        spread = sum((t - mean_t) ** 2 for t, _ in self._points)
        if n >= 4:
            slope = sum((t - mean_t) * (late - mean_late) for t, late in self._points) / spread
            self._slope = max(-MAX_RATE_ERROR, min(MAX_RATE_ERROR, slope))
        self._offset = mean_late - self._slope * mean_t
        scatter = sum((late - self._line(t)) ** 2 for t, late in self._points) / max(1, n - 2)
        self.sigma_ns = max(1000, round(scatter**0.5 * 1e9)) if n >= 4 else UNSETTLED_NS
