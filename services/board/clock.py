"""The device clock says when a scan was measured, on the host's clock: from the board's own times and from bounds.

The unknown is host time minus device time. Whatever the board sends arrives after it was sent: every arrival bounds the
difference from above. A timed question (START, TIME_ASK) is answered after it was asked: every answer bounds it from
below too, within its round trip. A bound holds for ever, but for the crystals: they part by at most MAX_RATE_ERROR, so
it widens by that. The earliest arrivals and the shortest round trips count; what comes late moves nothing.

Between the bounds the line is fitted to the earliest arrivals: of each BLOCK frames only the one that came soonest
after the current line. A frame that is later than the bounds allow is no point of the fit, so that neither a slow link
nor a scheduler bends it.

Without answers to timed questions there is no bound from below but that of START: a delay that was there from the
start, or that grows by less than MAX_RATE_ERROR, cannot be told from the crystals then.
"""

from __future__ import annotations

import math
from collections import deque

BLOCK = 16
BLOCKS = 64
MAX_RATE_ERROR = 1e-3  # s/s that the two crystals part at most; a delay that grows faster is seen as a delay
TOLERANCE_NS = 2_000_000  # beyond the bounds by more: not the same clock; later than the line by more: late
WIDE_NS = 50_000_000  # between the bounds: with more, it is not known how old a frame is
GOOD_NS = 10_000_000  # between the bounds: with more, it is worth asking more often
UNSETTLED_NS = 5_000_000  # standard deviation stated before the line is settled

Bound = tuple[int, int]  # device ns, difference ns


class DeviceClock:
    """A DeviceClock maps device time to host monotonic time, for one connection.

    timed: the board answers timed questions, so that the bounds say how sure a stamp is.
    """

    def __init__(self) -> None:
        self.timed = False
        self.resets = 0
        self._forget()

    def _forget(self) -> None:
        self._upper: Bound | None = None
        self._lower: Bound | None = None
        self._origin: Bound | None = None  # of the line
        self._block: list[tuple[float, float]] = []  # device s since origin, lateness s against slope 1
        self._points: deque[tuple[float, float]] = deque(maxlen=BLOCKS)
        self._slope = self._offset = 0.0
        self._scatter_ns = UNSETTLED_NS

    def reset(self) -> None:
        """Forgets everything: the board's clock or the host's was set anew."""
        self._forget()
        self.resets += 1

    def started(self, sent_ns: int, device_us: int, answered_ns: int) -> None:
        """The answer to a START said device_us: what is known goes on where it agrees, else it is forgotten."""
        if not self.answered(sent_ns, device_us, answered_ns):
            self.reset()
            self.answered(sent_ns, device_us, answered_ns)

    def answered(self, sent_ns: int, device_us: int, answered_ns: int) -> bool:
        """A question of sent_ns was answered with device_us at answered_ns. False, and nothing is learnt, where that
        cannot be by what is known: a clock has jumped.
        """
        device_ns = device_us * 1000
        least, most = sent_ns - device_ns, answered_ns - device_ns
        lower, upper = self._bounds(device_ns)
        if (upper is not None and least > upper + TOLERANCE_NS) or (lower is not None and most < lower - TOLERANCE_NS):
            return False
        self._not_below(device_ns, least)
        self._not_above(device_ns, most)
        return True

    def possible(self, device_us: int, arrival_ns: int) -> bool:
        """Whether what the board finished at device_us can have arrived by then: not before it was finished."""
        lower, _ = self._bounds(device_us * 1000)
        return lower is None or arrival_ns - device_us * 1000 >= lower - TOLERANCE_NS

    def observe(self, device_us: int, arrival_ns: int, fit: bool = True) -> None:
        """A frame that the board finished at device_us arrived at arrival_ns (host monotonic). fit: it may be a point
        of the line; scans of a short list are none, for they arrive sooner.
        """
        device_ns = device_us * 1000
        difference = arrival_ns - device_ns
        _, upper = self._bounds(device_ns)
        self._not_above(device_ns, difference)
        if not fit or (upper is not None and difference > upper + TOLERANCE_NS):
            return
        if self._origin is None:
            self._origin = (device_ns, difference)
        since = (device_ns - self._origin[0]) * 1e-9, (difference - self._origin[1]) * 1e-9
        self._block.append(since)
        if len(self._block) == BLOCK:
            self._points.append(min(self._block, key=lambda point: point[1] - self._slope * point[0]))
            self._block.clear()
            self._fit()

    def host_ns(self, device_us: int) -> int:
        """Returns the host monotonic time [ns] at which the board's clock showed device_us; where that is unknown, the
        earliest that it can have been.
        """
        device_ns = device_us * 1000
        lower, upper = self._bounds(device_ns)
        if upper is None:
            raise ValueError("no frame was observed yet")
        found = self._line(device_ns) if self._points else upper
        if lower is not None:
            found = lower if self.unknown(device_us) else max(lower, found)
        return device_ns + min(upper, found)

    def width_ns(self, device_us: int) -> int | None:
        """Returns how far the bounds are apart at that time [ns]; None without a bound from below."""
        lower, upper = self._bounds(device_us * 1000)
        return None if lower is None or upper is None else max(0, upper - lower)

    def unknown(self, device_us: int) -> bool:
        """Whether it is not known how old something of that time is, although the board could say."""
        width = self.width_ns(device_us)
        return self.timed and (width is None or width > WIDE_NS)

    def sigma_ns(self, device_us: int) -> int:
        """Returns the standard uncertainty of `host_ns`: anywhere between the bounds, or the scatter about the line."""
        width = self.width_ns(device_us)
        if not self.timed or width is None:
            return self._scatter_ns
        scatter = self._scatter_ns if self._settled else 0
        return max(1000, round(math.hypot(scatter, width / 12**0.5)))

    # inside

    @property
    def _settled(self) -> bool:
        return len(self._points) >= 4

    def _bounds(self, device_ns: int) -> tuple[int | None, int | None]:
        """Returns the least and the most that the difference can be at that time."""
        lower, upper = self._lower, self._upper
        return (
            None if lower is None else lower[1] - round(MAX_RATE_ERROR * abs(device_ns - lower[0])),
            None if upper is None else upper[1] + round(MAX_RATE_ERROR * abs(device_ns - upper[0])),
        )

    def _not_above(self, device_ns: int, difference: int) -> None:
        if self._upper is None or _later(self._upper, device_ns, difference, +1):
            self._upper = (device_ns, difference)

    def _not_below(self, device_ns: int, difference: int) -> None:
        if self._lower is None or _later(self._lower, device_ns, difference, -1):
            self._lower = (device_ns, difference)

    def _line(self, device_ns: int) -> int:
        assert self._origin is not None
        since_s = (device_ns - self._origin[0]) * 1e-9
        return self._origin[1] + round((self._offset + self._slope * since_s) * 1e9)

    def _fit(self) -> None:
        self._points = deque((p for p in self._points if not self._late(*p)), maxlen=BLOCKS)
        n = len(self._points)
        if not n:
            return
        mean_t = sum(t for t, _ in self._points) / n
        mean_late = sum(late for _, late in self._points) / n
        spread = sum((t - mean_t) ** 2 for t, _ in self._points)
        if self._settled and spread > 0:
            slope = sum((t - mean_t) * (late - mean_late) for t, late in self._points) / spread
            self._slope = max(-MAX_RATE_ERROR, min(MAX_RATE_ERROR, slope))
        self._offset = mean_late - self._slope * mean_t
        scatter = sum((late - self._offset - self._slope * t) ** 2 for t, late in self._points) / max(1, n - 2)
        self._scatter_ns = max(1000, round(scatter**0.5 * 1e9)) if self._settled else UNSETTLED_NS

    def _late(self, t: float, late: float) -> bool:
        """Whether a point has turned out to be late: others came so much sooner."""
        assert self._origin is not None
        _, upper = self._bounds(self._origin[0] + round(t * 1e9))
        return upper is not None and self._origin[1] + late * 1e9 > upper + TOLERANCE_NS


def _later(bound: Bound, device_ns: int, difference: int, sign: int) -> bool:
    """Returns whether a new bound is tighter than `bound`, from their later time on. sign: +1 above, -1 below."""
    newest = max(device_ns, bound[0])
    new = difference + sign * MAX_RATE_ERROR * (newest - device_ns)
    old = bound[1] + sign * MAX_RATE_ERROR * (newest - bound[0])
    return sign * (old - new) > 0
