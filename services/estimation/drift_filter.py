"""The untouched baseline followed through drift: a Kalman filter of what drifts, and slowly of what does not explain.

State: the sheet's factor and each electrode's contact impedance, relative to the tare, and their rates (drift.py),
with a random walk of the values beside. What the values change by, the baseline is moved by. Their variance grows with
the time since frames were last taken in, however that is cut, so that after a touch of ten minutes the first half
second of untouched frames is believed almost wholly, and in between each changes little. What those directions do not
explain (creep of the foam) follows with one time constant.

A press slower than the drift would be swallowed. Therefore the baseline that a touch is measured against is the one of
BACK_S before it was noticed.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.prereconstruction import PreReconstructor
from services.estimation.creep import SHARE, Creep
from services.estimation.drift import DriftProcess, DriftRates, spread
from services.estimation.drift_prior import REST_S
from services.estimation.holding import Holding
from services.estimation.saved import shaped
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

BLOCK_S = 0.5  # frames are taken in by their means over so long
SHORT_BLOCK, STALE_S = 4, 10.0  # of so many frames after a gap of so long: who taps again and again leaves no more
WALK_S = 0.5  # beside its steady rate: a random walk, as large as the rate makes in so long
BACK_S = 2.0  # how far back the baseline goes when a touch begins
TREND_S = 8.0  # before that: how it drifted over so long, it is taken to have gone on
LONGEST_STEP_S = 1.0  # of the slow part: a longer gap counts as this
MOST_S = 600.0  # of drift: a longer gap counts as this


class DriftFilter:
    """Follows (K,) |Z0|. Times are `sample` stamps [ns]; 0: not known yet."""

    def __init__(self, pre: PreReconstructor, rates: DriftRates, tracking_s: float) -> None:
        """tracking_s: time constant with which the baseline follows what drift does not explain."""
        self.pre, self.tracking_s = pre, tracking_s
        self._columns = np.column_stack([np.ones(pre.measurements), pre.m.contact])  # d per relative change
        self._rates = np.array([rates.scale_per_s] + [rates.contact_per_s] * pre.m.contact.shape[1])
        self.process = DriftProcess(self._rates * TUNING.drift_s, np.full(len(self._rates), TUNING.drift_s))
        self.holding = Holding(pre, self._columns, self._rates)
        self.begin(0)

    def begin(self, at_ns: int, age_s: float = 0.0) -> None:
        """A new baseline, whose newest frame is `age_s` older than the stamp at_ns; 0: than the next frame."""
        self._at_ns: int | None = at_ns - round(age_s * 1e9) if at_ns else None
        self._age_s = age_s
        self.mean = np.zeros(2 * len(self._rates))  # values, then rates
        self.covariance = np.diag(np.append((self._rates * REST_S) ** 2, self._rates**2))
        self._past: deque[tuple[int, Array, Array, Array]] = deque()  # (when, |Z0|, mean, covariance) of BACK_S
        self.holding.reset()
        self._clear()

    def _clear(self) -> None:
        k = self.pre.measurements
        self._sum, self._count, self._since_ns = np.zeros(k), np.zeros(k), 0

    def rescale(self, factor: float) -> None:
        """All |Z| so far, times this factor."""
        self._past = deque((at, z0 * factor, mean, covariance) for at, z0, mean, covariance in self._past)
        self._sum = self._sum * factor
        self.holding.rescale(factor)

    def since_s(self, now_ns: int) -> float:
        """Seconds since the baseline last knew the skin as untouched."""
        if self._at_ns is None:
            self._at_ns = now_ns - round(self._age_s * 1e9)
        return max(0.0, (now_ns - self._at_ns) * 1e-9)

    def untouched(
        self,
        z0: Array,
        amplitude: Array,
        live: NDArray[np.bool_],
        sigma: Array,
        now_ns: int,
        creep: Creep | None = None,
    ) -> bool:
        """Take in an untouched frame's |Z| (K,); z0 (K,) is changed in place. sigma (K,): noise of d.

        creep: what the last touch may have left behind. True where z0 changed.
        """
        if not self._since_ns:
            self.holding.reset()
            since_s = self.since_s(now_ns)
            assert self._at_ns is not None
            self._since_ns = self._at_ns if 0 < since_s < 2 * BLOCK_S else now_ns
            if not self._past:
                self._past.append((self._at_ns, z0.copy(), self.mean, self.covariance))
        self._sum += np.where(live, amplitude, 0.0)
        self._count += live
        enough = self.since_s(now_ns) >= STALE_S and self._count.max() >= SHORT_BLOCK
        if not enough and (now_ns - self._since_ns) * 1e-9 < BLOCK_S:
            return False
        self._take_in(z0, sigma, now_ns, creep)
        self._past.append((now_ns, z0.copy(), self.mean, self.covariance))
        while len(self._past) > 1 and (now_ns - self._past[1][0]) * 1e-9 >= BACK_S + TREND_S:
            self._past.popleft()
        self._clear()
        return True

    def begin_touch(self, z0: Array) -> None:
        """A touch: frames not taken in yet are forgotten, and the baseline is what it was BACK_S ago."""
        self._clear()
        if not self._past:
            return
        newest_ns, (first_ns, first, *_) = self._past[-1][0], self._past[0]
        back = [entry for entry in self._past if (newest_ns - entry[0]) * 1e-9 >= BACK_S]
        self._at_ns, before, self.mean, self.covariance = (back or [self._past[0]])[-1]
        z0[:] = before
        trend_s = (self._at_ns - first_ns) * 1e-9
        if trend_s >= TREND_S / 2:
            z0 += (before - first) * (newest_ns - self._at_ns) * 1e-9 / trend_s
        self._past.clear()

    def _take_in(self, z0: Array, sigma: Array, now_ns: int, creep: Creep | None) -> None:
        gap_s = min(self.since_s(now_ns), MOST_S)
        if gap_s > BACK_S:
            self._past.clear()  # what is caught up with is no trend
        self._at_ns = now_ns
        live = (self._count > 0) & np.isfinite(sigma) & (z0 > 0)
        normaliser = np.asarray(self.pre.normaliser(z0), dtype=float)
        d = np.zeros(len(z0))
        d[live] = (self._sum[live] / self._count[live] - z0[live]) / normaliser[live]
        weight = np.zeros(len(z0))
        weight[live] = 1 / (sigma[live] ** 2 / self._count[live] + self.pre.m.model_error**2)
        n, touch = len(self._rates), None if creep is None else creep.direction(now_ns)
        expected, prior = self.predicted(gap_s)
        columns = np.column_stack([self._columns, np.zeros_like(self._columns)])
        if touch is not None:
            columns = np.column_stack([columns, touch])
            prior = np.pad(prior, (0, 1))
            prior[-1, -1] = SHARE**2
        ahead = self._columns @ (expected - self.mean)[:n]
        gathered = columns.T * weight
        covariance = np.linalg.inv(np.linalg.inv(prior) + gathered @ columns)
        found = covariance @ (gathered @ (d - ahead))
        if touch is not None and creep is not None:
            found[-1] = creep.follow(float(found[-1]))
        self.mean, self.covariance = expected + found[: 2 * n], covariance[: 2 * n, : 2 * n]
        drift = ahead + columns @ found
        step_s = min(gap_s, LONGEST_STEP_S)
        slow = np.where(live, d - drift, 0.0) * (step_s / (step_s + self.tracking_s))
        z0 += np.where(z0 > 0, normaliser * (drift + slow), 0.0)

    def predicted(self, dt: float) -> tuple[Array, Array]:
        """Mean and covariance dt seconds on."""
        noise = self.process.noise(dt) + self.process.walked(dt, self._rates**2 * WALK_S)
        phi, q = spread(self.process.transition(dt)), spread(noise)
        return phi @ self.mean, phi @ self.covariance @ phi.T + q

    # state

    def state(self) -> dict[str, Any]:
        return {
            "at_ns": self._at_ns,
            "age_s": self._age_s,
            "covariance": self.covariance.copy(),
            "mean": self.mean.copy(),
            "past": [[at, z0.copy(), mean.copy(), covariance.copy()] for at, z0, mean, covariance in self._past],
            "sum": self._sum.copy(),
            "count": self._count.copy(),
            "since_ns": self._since_ns,
            "holding": self.holding.state(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        k, n = self._columns.shape[0], 2 * self._columns.shape[1]
        self._at_ns = None if state["at_ns"] is None else int(state["at_ns"])
        self._age_s = float(state["age_s"])
        if "mean" not in state:  # older recordings: how old the baseline is counts, the rates are unknown
            return
        self.mean, self.covariance = shaped(state["mean"], (n,)), shaped(state["covariance"], (n, n))
        self._past = deque(
            (int(at), shaped(z0, (k,)), shaped(m, (n,)), shaped(c, (n, n))) for at, z0, m, c in state["past"]
        )
        self._sum, self._count = shaped(state["sum"], (k,)), shaped(state["count"], (k,))
        self._since_ns = int(state["since_ns"])
        self.holding.load(state["holding"])
