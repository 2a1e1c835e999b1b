"""The force on the skin by another sensor, topic reference/SKIN: its readings, its delay, what it says of a press.

A press's force is what the reference rises by, from before the press to its steady part. It may have any offset, lose
messages and be late by a constant time. That delay is found: the one by which its course, over all presses so far,
follows the skin's own best.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.ages import Ages
from protocol.errors import EitskinError
from protocol.frames import ReferenceFrame, as_sent

Array = NDArray[np.float64]

STALE_S = 1.0  # silence from which it counts as gone
MOST_GAP_S = 0.25  # between two readings of what is averaged
MOST_DELAY_S = 0.5
LAGS_S = np.arange(-0.3, 1.001, 0.01)  # delays that are tried: images may be a little late themselves
SETTLE_S = float(LAGS_S[-1])  # how long after a press its reference is awaited
AROUND_S = 0.4  # of a press's course before it begins: where it tells the delay
FOLLOWS = 0.9  # correlation with the skin's course, at least
GUARD_S, ZERO_S = 0.2, 0.5  # the zero is taken for ZERO_S until GUARD_S before the touch was seen
FEWEST_READINGS = 5
LEAST_N, SIGMAS = 0.05, 5.0  # a smaller rise is none
STEADY = 0.05  # standard deviation over the force while it is held, beyond the noise of the zero
KEPT = 200_000  # readings: more than a minute of 2 kHz


class Doubtful(EitskinError):
    """A press whose force the reference does not tell; the text says why, and what to do."""


@dataclass(frozen=True, eq=False)
class PressCourse:
    """One press as the skin saw it. Times [s] of the clock that the reference's are of."""

    times: Array  # (N,) of its images, from before the touch until after it
    shown: Array  # (N,) what they show of it, in any unit: 0 where nothing touches
    began: float
    steady: tuple[float, float]  # from, to
    ended: float


class ReferenceForce:
    """Follows one skin's reference."""

    def __init__(self, skin: str) -> None:
        self._skin = skin
        self._ages = Ages()
        self._readings: deque[tuple[float, float]] = deque(maxlen=KEPT)
        self._sessions: dict[str, float] = {}
        self._heard = -np.inf  # when the newest message came [s]
        self._wrong = ""  # of the newest message
        self._likeness = np.zeros(len(LAGS_S))
        self.delay_s: float | None = None

    def take(self, frame: ReferenceFrame, arrived_s: float) -> None:
        """One message. What is no number, not valid or too late is no reading."""
        self._heard = self._sessions[frame.session] = arrived_s
        measured = self._ages.measured_ns(frame, int(arrived_s * 1e9))
        when = arrived_s if measured is None else 1e-9 * measured
        valid, reasons = as_sent(frame)
        self._wrong = ""
        if not np.isfinite(frame.force_n):
            self._wrong = f"found a force of {frame.force_n} N in the reference, expected a number: look at its sensor"
        elif not valid:
            said = f" ({', '.join(reasons)})" if reasons else ""
            self._wrong = f"the reference says that it is not valid{said}: look at its sensor"
        elif arrived_s - when > MOST_DELAY_S:
            self._wrong = (
                f"the reference comes {arrived_s - when:.1f} s after its stamp `sample`, expected {MOST_DELAY_S:g} s "
                "at most: stamp it with this host's CLOCK_MONOTONIC, and send it at once"
            )
        else:
            self._readings.append((when, frame.force_n))

    def trouble(self, now_s: float) -> str:
        """Why it says nothing at present; "" where it does."""
        if self._heard == -np.inf:
            return f"no message of reference/{self._skin} has come: start what publishes it (docs/your-skin.md)"
        if now_s - self._heard > STALE_S:
            return f"the reference has been silent for more than {STALE_S:g} s: look at what publishes it"
        if sum(now_s - heard < STALE_S for heard in self._sessions.values()) > 1:
            return f"two programs publish reference/{self._skin}: expected one, end the other"
        return self._wrong

    def force(self, course: PressCourse) -> float:
        """Force [N] of a press that is over since SETTLE_S. Raises Doubtful."""
        times, force = np.array(self._readings).reshape(-1, 2).T
        self._find_delay(course, times, force)
        assert self.delay_s is not None
        until = course.began - GUARD_S + self.delay_s
        zeros = force[(times >= until - ZERO_S) & (times <= until)]
        if len(zeros) < FEWEST_READINGS:
            raise Doubtful(
                f"found {len(zeros)} readings of the reference in the {ZERO_S:g} s before the touch, expected "
                f"{FEWEST_READINGS} for its zero: it dropped out, or the skin was not free for a second"
            )
        begin, end = (t + self.delay_s for t in course.steady)
        during = (times >= begin) & (times <= end)
        gap = float(np.diff(np.concatenate([[begin], times[during], [end]])).max())
        if gap > MOST_GAP_S or during.sum() < FEWEST_READINGS:
            wrong = f" ({self._wrong})" if self._wrong else ""
            raise Doubtful(f"the reference dropped out for {gap:.2f} s of it, expected {MOST_GAP_S:g} s at most{wrong}")
        rise = float(force[during].mean() - zeros.mean())
        return _judged(rise, float(force[during].std()), float(zeros.std()))

    def _find_delay(self, course: PressCourse, times: Array, force: Array) -> None:
        """From this press and those before it. Raises Doubtful where the reference does not follow this one."""
        rows = (times >= course.began - AROUND_S) & (times <= course.ended + SETTLE_S)
        if rows.sum() < FEWEST_READINGS:
            raise Doubtful(f"found {rows.sum()} readings of the reference during it: look at what publishes it")
        likeness = np.array(
            [_likeness(np.interp(times[rows] - lag, course.times, course.shown), force[rows]) for lag in LAGS_S]
        )
        best = int(np.abs(likeness).argmax())
        if likeness[best] < -FOLLOWS:
            raise Doubtful(
                "the reference fell while the skin was pressed, expected it to rise: change its sign (of a ROS topic: "
                "the node's parameter reference_axis)"
            )
        if abs(likeness[best]) < FOLLOWS:
            raise Doubtful(
                "the reference does not follow the press: check that it measures what presses this skin, and that it "
                f"is later by {MOST_DELAY_S:g} s at most"
            )
        if LAGS_S[best] > MOST_DELAY_S:
            raise Doubtful(
                f"the reference is {LAGS_S[best]:.1f} s late, expected {MOST_DELAY_S:g} s at most: publish it sooner, "
                "or stamp it when it is measured"
            )
        self._likeness += likeness
        self.delay_s = float(LAGS_S[self._likeness.argmax()])

    def close(self) -> None:
        self._ages.close()


def _likeness(one: Array, other: Array) -> float:
    """Correlation, 0 where one of them does not change."""
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0


def _judged(rise: float, scatter: float, noise: float) -> float:
    """The rise, where it is one. Raises Doubtful."""
    if rise < max(LEAST_N, SIGMAS * noise):
        raise Doubtful(
            f"the reference rose by {rise:.3g} N with a noise of {noise:.2g} N, expected at least "
            f"{max(LEAST_N, SIGMAS * noise):.2g} N: press more firmly"
        )
    if scatter > np.hypot(STEADY * rise, 2 * noise):
        raise Doubtful(
            f"the reference changed by {100 * scatter / rise:.0f} % while the skin was held, expected "
            f"{100 * STEADY:.0f} %: hold still"
        )
    return rise
