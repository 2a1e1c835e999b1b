"""A touch that is held or slides, followed from part to part of a scan.

State of each touch: x, y [model units], log radius, log drop, and the velocity of its place [model units/s]. A part's
values, each at its own instant, are the measurement of an extended Kalman filter: circles on the bundle's linear model,
whose error is part of their noise.

A whole scan begins it: the state is fitted to its difference, and that difference itself is the reference. While the
parts differ from the reference by no more than noise, the touch is where it was, and the filter need not run. What the
model gets wrong of the reference is taken along for as long as the touch is near. Where a part is not explained, not
even by a touch that suddenly moves or presses otherwise, nothing is said until the next whole scan.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.circles import DROP, FITS, MODEL, RADIUS, Circles
from services.estimation.part_image import variance_of
from services.estimation.rolling import parts_of
from services.estimation.saved import shaped

Array = NDArray[np.float64]
Rows = NDArray[np.intp]

WANDERS = np.array([0.005, 0.005, 0.1, 2.0, 3.0, 3.0])  # by how much the state does, per square root of a second
KNOWN = np.array([0.01, 0.01, 0.1, 0.2, 2.0, 2.0])  # standard deviation of a touch that begins to change
SUDDEN = np.array([0.03, 0.03, 0.1, 0.5, 6.0, 6.0])  # the same of one that changes at once
NEAR = 0.15  # model units from the reference, within which the model is wrong by what it is there
WINDOWS = (1, 3, 6, 10)  # newest parts among which a change is looked for
STILL = 24.0  # chi-square of a touch's place and strength, up to which it did not change: one in 10^4 parts exceeds it
SPREAD = 6.0  # standard deviations of chi-square that the noise of a part may come to
LIKELY, EXPLAINED = 2.7, 4.0  # chi-square per value up to which a part is, without and with a sudden change
JUMPS = 12.0  # standard deviations of the newest part's chi-square, beyond which a held touch is suddenly another
SURPRISE = 24.0  # chi-square beyond noise, from which on another touch may have begun
OTHER_NATS = 7.0  # that it costs to be anywhere: the logarithm of the grid's touches
SLOW_SIGMAS = 2.0  # standard deviations of its velocity, below which a touch may not move at all
AS_WELL = 1.05  # times what a whole scan leaves of a touch that moves: one that holds still does as well
TINY = 1e-12  # keeps solvable what no value tells
LONGEST_US = 2e5  # without a part: nothing is known of what happened meanwhile
REMEMBERED = 8  # whole scans of a touch that is held, whose mean it is compared with
KEPT = 12  # parts whose states are kept: those of a whole scan


class FollowedState(NamedTuple):
    """One touch as the newest part has it; lengths in model units. sigma: along the longest and the shortest axis,
    angle of the longest [rad]; integral: of the drop over the touch.
    """

    x: float
    y: float
    vx: float
    vy: float
    integral: float
    sigma: tuple[float, float, float]


class PartFilter:
    """For one bundle. Times are in us of the board's clock, of the newest part."""

    def __init__(self, bundle: Bundle) -> None:
        self._circles = Circles(bundle)
        self._count = len(bundle.pattern) // parts_of(bundle)  # values in a part
        self.metres_per_unit = self._circles.metres_per_unit
        self.number = 0  # counts up when other touches are followed
        self.forget()

    def forget(self) -> None:
        """Nothing is followed."""
        self.touches: Array = np.zeros((0, 6))
        self._covariance: Array = np.zeros((0, 0))
        self._fitted: Array = np.zeros((0, 0))  # covariance (4 N, 4 N) of the touches, as the whole scan has it
        self._still = False
        self._as_still = 0  # whole scans in a row that a touch which holds still explains better
        self._at_us = 0.0
        self._past: deque[tuple[float, Array]] = deque(maxlen=KEPT)  # (when, touches)
        self._scans = 0  # whole scans whose mean the reference is
        self._reference: Array | None = None  # (K,) difference where the touches were last held

    @property
    def moves(self) -> bool:
        """Whether what is followed changes."""
        return len(self.touches) > 0 and not self._still

    @property
    def knows(self) -> bool:
        """Whether the last part was explained."""
        return self._reference is not None

    def whole(self, d: Array, noise: Array, at_us: float, shown: bool) -> None:
        """Take a whole scan of a touch that was there all the time: d (K,) as it was at at_us (see `at_once`), noise
        (K,). shown: an image is made of it; else it is the same as before.
        """
        if self.moves:
            return
        before = self._reference if self._still else None
        self._scans = 1 if before is None else min(self._scans + 1, REMEMBERED)
        self._reference = d if before is None else before + (d - before) / self._scans
        self._noise = noise / np.sqrt(self._scans)
        if shown or before is None:
            self._begin(self._reference, self._noise)
        self.touches[:, MODEL:] = 0.0
        self._there = self.touches.copy()
        self._still, self._at_us = True, at_us
        self._refer()
        self._past.clear()
        self._past.append((at_us, self.touches.copy()))

    def _refer(self) -> None:
        """What the model makes of the reference."""
        assert self._reference is not None
        rows = self._circles.all
        expected, slope = self._circles.expected(self._there, rows, np.zeros(len(rows)))
        self._left = self._reference - expected
        self._slope = slope[:, [6 * k + n for k in range(len(self._there)) for n in (0, 1, DROP)]]

    def part(self, d: Array, noise: Array, age: Array, at_us: float) -> bool:
        """Take what is newer than what was taken last, of d, noise and age [us] (K,); False where it is not explained:
        then nothing is followed.
        """
        elapsed = at_us - self._at_us
        if self._reference is None or not 0 < elapsed < LONGEST_US:
            self.forget()
            return False
        by_age: Rows = np.argsort(age)
        fresh = self._count * max(1, int((age < elapsed).sum()) // self._count)  # values measured since
        if self._still and (changed := self._changed(d, noise, by_age, fresh)):
            self._still = False
            self._covariance = np.diag(np.tile(KNOWN**2, len(self.touches)))
            for k in range(len(self.touches)):
                own = self._fitted[MODEL * k : MODEL * k + 2, MODEL * k : MODEL * k + 2]
                self._covariance[6 * k : 6 * k + 2, 6 * k : 6 * k + 2] = own
            fresh = max(fresh, changed)  # what was taken for noise is looked at again
            elapsed *= fresh / max(1, int((age < elapsed).sum()))
        if not self._still and not (len(self.touches) and self._taken(d, noise, age, by_age[:fresh], elapsed)):
            self.forget()
            return False
        self._at_us = at_us
        self._past.append((at_us, self.touches.copy()))
        return True

    def _taken(self, d: Array, noise: Array, age: Array, newest: Rows, elapsed: float) -> bool:
        """Take values (n,), which were measured within `elapsed` us, part after part; False where one is not
        explained.
        """
        parts = newest.reshape(-1, self._count)[::-1]
        for rows in parts:
            tau = 1e-6 * (float(age[rows].mean()) - age[rows])
            if not self._follow(d[rows], noise[rows], tau, rows, 1e-6 * elapsed / len(parts)):
                return False
        return True

    def at_once(self, d: Array, noise: Array, age: Array) -> Array:
        """(K,) what to add to a whole scan's d, of which each value has its age [us], so that all are as if they had
        been measured when the newest part was. Zero where nothing moves, or a touch that holds still explains the
        scan better; twice in a row, or where it is slow, it is held from here on.
        """
        change = np.zeros(len(age))
        if not self.moves:
            return change
        middle = float(np.sort(age)[: self._count].mean())
        now = self._circles.expected(self.touches, self._circles.all, change)[0]
        then = np.array([at for at, _ in self._past])
        measured = self._at_us + middle - age
        nearest = np.abs(then[:, None] - measured).argmin(axis=0)
        for k in np.unique(nearest):
            rows = np.flatnonzero(nearest == k)
            tau = 1e-6 * (measured[rows] - then[k])
            change[rows] = now[rows] - self._circles.expected(self._past[k][1], rows, tau)[0]
        still, moving = (self._circles.fitted(each, noise, self.touches).misfit for each in (d, d + change))
        self._as_still = 0 if still > moving else self._as_still + 1
        if moving > FITS or self._as_still > 1 or (self._slow() and still <= AS_WELL * moving):
            self.forget()
        return change if self.moves and not self._as_still else np.zeros(len(age))

    def jumps(self, d: Array, noise: Array, age: Array) -> bool:
        """Whether a touch that was held is suddenly another in the newest part of d, noise and age (K,)."""
        if not self._still or self._reference is None:
            return False
        rows = np.argsort(age)[: self._count]
        off = (d[rows] - self._reference[rows]) / np.hypot(noise[rows], self._noise[rows])
        return bool(off @ off > len(rows) + JUMPS * np.sqrt(2 * len(rows)))

    def strongest(self) -> Array:
        """(K,) d of the touches as they were when they were strongest, of the last parts."""
        return self._circles.still(max((touches for _, touches in self._past), key=_strength))

    def states(self) -> list[FollowedState]:
        """The touches, as the newest part has them."""
        modelled = [6 * k + n for k in range(len(self.touches)) for n in range(MODEL)]
        covariance = self._fitted
        if not self._still:  # it moved since, and where it was is known no better
            covariance = covariance + self._covariance[np.ix_(modelled, modelled)]
        return [
            FollowedState(x, y, vx, vy, float(np.pi * np.exp(2 * log_r + log_drop)), sigma)
            for (x, y, sigma), (_, _, log_r, log_drop, vx, vy) in zip(
                self._circles.places(self.touches, covariance), self.touches.tolist(), strict=True
            )
        ]

    def _begin(self, d: Array, noise: Array) -> None:
        """Fit the touches to a whole scan, or to the mean of several."""
        before, fit = self.touches, self._circles.found(d, noise)
        self.touches, self._fitted = fit.touches, fit.covariance
        if len(before) != len(self.touches) or (np.hypot(*(self.touches - before).T[:2]) > NEAR).any():
            self.number += 1

    def _slow(self) -> bool:
        """Whether no touch moves for sure."""
        speed = np.hypot(*self.touches.T[MODEL:])
        variance = np.diag(self._covariance).reshape(-1, 6)[:, MODEL:].sum(axis=1)
        return bool((speed < SLOW_SIGMAS * np.sqrt(variance)).all())

    def _changed(self, d: Array, noise: Array, by_age: Rows, fresh: int) -> int:
        """Among how many of the newest values a change shows against the reference; 0: all is noise. fresh: values that
        were not looked at yet.
        """
        assert self._reference is not None
        wide = np.hypot(noise, self._noise)
        off = (d - self._reference) / wide
        new = off[by_age[:fresh]]
        if float(new @ new) > fresh + SPREAD * np.sqrt(2 * fresh):
            return fresh
        slope = self._slope / wide[:, None]
        for parts in WINDOWS if len(self.touches) else ():
            rows = by_age[: parts * self._count]
            part, along = slope[rows], slope[rows].T @ off[rows]
            size = part.T @ part
            if float(along @ np.linalg.solve(size + TINY * np.trace(size) * np.eye(len(size)), along)) > STILL:
                return len(rows)
        return 0

    def _follow(self, d: Array, noise: Array, tau: Array, rows: Rows, elapsed: float) -> bool:
        """One step of the filter; False where it does not explain the values."""
        advance = np.eye(self.touches.size)
        for k in range(len(self.touches)):
            advance[6 * k : 6 * k + 2, 6 * k + MODEL : 6 * k + 6] = elapsed * np.eye(2)
        wandered = np.diag(np.tile(WANDERS**2 * elapsed, len(self.touches)))
        before = advance @ self.touches.ravel()
        for sudden, most in ((0.0, LIKELY), (1.0, EXPLAINED)):
            start = self._covariance + sudden * np.diag(np.tile(SUDDEN**2, len(self.touches)))
            ahead = advance @ start @ advance.T + wandered
            state, covariance, chi, another = self._updated(before, ahead, d, noise, tau, rows)
            if chi <= most:
                if another:
                    return False
                self.touches, self._covariance = state.reshape(-1, 6), covariance
                return True
        return False

    def _another(self, off: Array, variance: Array, spread: Array, rows: Rows, touches: Array) -> bool:
        """Whether what touches (N, 6), which go on as before, leave of values (n,) is likelier of another touch that
        begins elsewhere than of their own change: one that is followed must not go where another one begins. variance
        (n,): of what is no change, spread (n, n): with their change.
        """
        alone = float((off**2 / variance).sum())
        if alone < SURPRISE + len(off):
            return False
        changed = float(off @ np.linalg.solve(spread, off)) + float(np.linalg.slogdet(spread)[1])
        other = alone - self._circles.another(off, np.sqrt(variance), rows, touches) + float(np.log(variance).sum())
        return other + 2 * OTHER_NATS < changed

    def _beside(self, state: Array, d: Array, tau: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """What a state (6 N,) leaves of values (n,), measured tau [s] after it; its derivative (n, 6 N); what is new in
        the values, beside the reference, as far as the touches are near it.
        """
        assert self._reference is not None
        touches = state.reshape(-1, 6)
        near = float(np.exp(-((np.hypot(*(touches - self._there).T[:2]).max() / NEAR) ** 2)))
        expected, slope = self._circles.expected(touches, rows, tau)
        return d - expected - near * self._left[rows], slope, d - near * self._reference[rows]

    def _updated(
        self, before: Array, covariance: Array, d: Array, noise: Array, tau: Array, rows: Rows
    ) -> tuple[Array, Array, float, bool]:
        """State (6 N,), covariance and chi-square per value: of values d (n,), measured tau [s] after the state; and
        whether another touch is likelier.
        """
        state, chi, another = before, np.inf, False
        for _ in range(2):
            off, slope, new = self._beside(state, d, tau, rows)
            variance = variance_of(new, noise, float((new**2).mean()))
            off = off - slope @ (before - state)
            spread = slope @ covariance @ slope.T + np.diag(variance)
            gain = np.linalg.solve(spread, slope @ covariance).T
            if chi == np.inf:
                chi = float(off @ np.linalg.solve(spread, off)) / len(d)
                another = self._another(off, variance, spread, rows, before.reshape(-1, 6))
            state = self._circles.possible((before + gain @ off).reshape(-1, 6)).ravel()
        after = covariance - gain @ slope @ covariance
        return state, np.asarray((after + after.T) / 2), chi, another

    def state(self) -> dict[str, Any]:
        return {
            "number": self.number,
            "touches": self.touches.copy(),
            "covariance": self._covariance.copy(),
            "still": [self._still, self._as_still],
            "at_us": self._at_us,
            "past": [[at, touches.copy()] for at, touches in self._past],
            "reference": None
            if self._reference is None
            else [self._reference.copy(), self._noise.copy(), self._there.copy(), self._scans],
            "fitted": self._fitted.copy(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings have none. Raises KeyError, TypeError or ValueError where it does not fit."""
        self.forget()
        if not state:
            return
        count = len(state["touches"])
        self.number, self._at_us = int(state["number"]), float(state["at_us"])
        self._still, self._as_still = bool(state["still"][0]), int(state["still"][1])
        self.touches = shaped(state["touches"], (count, 6))
        if not self._still and state["reference"] is not None:
            self._covariance = shaped(state["covariance"], (6 * count, 6 * count))
        self._fitted = shaped(state["fitted"], (MODEL * count, MODEL * count))
        self._past.extend((float(at), shaped(touches, (count, 6))) for at, touches in state["past"])
        if state["reference"] is not None:
            d, noise, there, scans = state["reference"]
            self._reference, self._noise = shaped(d, self._circles.all.shape), shaped(noise, self._circles.all.shape)
            self._there, self._scans = shaped(there, (count, 6)), int(scans)
            self._refer()


def _strength(touches: Array) -> float:
    """Drop times area of all touches."""
    return float(np.exp(2 * touches[:, RADIUS] + touches[:, DROP]).sum())
