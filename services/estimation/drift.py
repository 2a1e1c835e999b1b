"""How an untouched skin changes over time: the sheet's conductivity, contact impedances and creep, each with its rate.

Each quantity is a random motion with friction and a spring, critically damped (an Ornstein-Uhlenbeck process of its
value and rate; its covariance over time is Matern's with smoothness 3/2):

    dx = r dt,   dr = -(2 r / T + x / T^2) dt + noise       standard deviations: x: s, r: s / T, at all times

So it goes on steadily within T, as drying and ageing do, and never grows beyond s. With a = dt / T

    Phi(dt) = exp(-a) [[1 + a, dt], [-a / T, 1 - a]]        Q(dt) = P - Phi P Phi^T,  P = diag(s^2, s^2 / T^2)

Q is exact: to predict over dt1 and then dt2 is to predict over dt1 + dt2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc

from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]


class DriftProcess:
    """N quantities; sd (N,) stationary standard deviations, time_s (N,) time constants."""

    def __init__(self, sd: Array, time_s: Array) -> None:
        self.sd, self.time_s = np.asarray(sd, dtype=float), np.asarray(time_s, dtype=float)
        if self.sd.shape != self.time_s.shape or not ((self.sd >= 0) & (self.time_s > 0)).all():
            raise ValueError("a drift needs a standard deviation from 0 on and a time above 0 for each quantity")

    @classmethod
    def of_skin(cls, electrodes: int, creep: bool = True, tuning: Tuning = TUNING) -> DriftProcess:
        """Scale, contacts, and (last) creep."""
        sd = [tuning.scale_sd, *[tuning.contact_sd] * electrodes, *[tuning.creep_sd] * creep]
        time_s = [*[tuning.drift_s] * (1 + electrodes), *[tuning.creep_s] * creep]
        return cls(np.array(sd), np.array(time_s))

    def transition(self, dt: float) -> Array:
        """Phi (N, 2, 2) over dt seconds."""
        if not dt >= 0:
            raise ValueError(f"time goes on by {dt} s: expected 0 or more")
        a = dt / self.time_s
        rows = [[1 + a, np.full_like(a, dt)], [-a / self.time_s, 1 - a]]
        return np.asarray(np.exp(-a) * np.array(rows)).transpose(2, 0, 1)

    def noise(self, dt: float) -> Array:
        """Q (N, 2, 2) that dt seconds add."""
        a = dt / self.time_s
        x = 2 * a
        value = gammainc(3, x)  # 1 - exp(-x) (1 + x + x^2 / 2), without its cancellation at short times
        cross = 2 * a**2 * np.exp(-x) / self.time_s
        rate = (value + 2 * x * np.exp(-x)) / self.time_s**2
        q = np.array([[value, cross], [cross, rate]]) * self.sd**2
        return np.asarray(q.transpose(2, 0, 1))

    def walked(self, dt: float, density: Array) -> Array:
        """What dt seconds add where the values also walk at random, by density (N,) 1/s: the integral over them of
        Phi diag(density, 0) Phi^T.
        """
        x = 2 * dt / self.time_s
        g0, g1, g2 = gammainc(1, x) / 2, gammainc(2, x) / 4, gammainc(3, x) / 4  # of u^n exp(-2 u), u up to dt / T
        value, cross, rate = self.time_s * (g0 + 2 * g1 + g2), -(g1 + g2), g2 / self.time_s
        return np.asarray((np.array([[value, cross], [cross, rate]]) * density).transpose(2, 0, 1))

    def stationary(self) -> Array:
        """P (N, 2, 2)."""
        p = np.zeros((len(self.sd), 2, 2))
        p[:, 0, 0], p[:, 1, 1] = self.sd**2, (self.sd / self.time_s) ** 2
        return p

    def value_covariance(self, since_s: float) -> Array:
        """(N, N) of the values that were known to be 0 `since_s` seconds ago, their rates unknown."""
        phi, start = self.transition(since_s), self.stationary()
        start[:, 0, 0] = 0.0
        return np.diag((phi @ start @ phi.transpose(0, 2, 1) + self.noise(since_s))[:, 0, 0])


class DriftRates(NamedTuple):
    """How fast an untouched skin may change, relative, 1/s: `[skins.NAME.tare]` in skin.toml."""

    scale_per_s: float  # the sheet's conductivity
    contact_per_s: float  # each electrode's contact impedance


def spread(blocks: Array) -> Array:
    """(N, 2, 2) -> (2 N, 2 N), values first."""
    n = len(blocks)
    full = np.zeros((2, n, 2, n))
    at = np.arange(n)
    full[:, at, :, at] = blocks
    return full.reshape(2 * n, 2 * n)
