"""What disturbs single measurements: contact impedances that flicker and jump, and interference on the electrodes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Flicker:
    """A contact impedance's own noise, relative: about 1 / f, a sum of decays of several times (J. Timmer, M. Koenig,
    "On generating power law noise", Astronomy and Astrophysics 300, 1995, lists others).
    """

    sd: float
    times_s: tuple[float, ...] = (0.03, 0.3, 3.0)


@dataclass(frozen=True)
class Telegraph:
    """A contact that lifts and closes under bending: it jumps between two impedances, `jump` apart, relative."""

    jump: float
    dwell_s: float


@dataclass(frozen=True)
class Hum:
    """A disturbing voltage on the electrodes, as a share of the measured one: `share` is its root mean square.

    begins at low_hz; with another high_hz it sweeps there and back in `sweep_s` each. on_s: of bursts, how long one is,
    one every `every_s` at a moment of its own; 0: always on.
    """

    share: float
    low_hz: float
    high_hz: float = 0.0
    sweep_s: float = 20.0
    on_s: float = 0.0
    every_s: float = 2.0

    def phase(self, t: Array) -> Array:
        """Turns (whole ones count) since 0 s."""
        if not self.high_hz:
            return self.low_hz * t
        rounds, within = np.divmod(t, 2 * self.sweep_s)
        rate = (self.high_hz - self.low_hz) / self.sweep_s
        back = np.maximum(within - self.sweep_s, 0.0)
        there = np.minimum(within, self.sweep_s)
        turns = self.low_hz * there + rate * there**2 / 2 + self.high_hz * back - rate * back**2 / 2
        return np.asarray(rounds * self.sweep_s * (self.low_hz + self.high_hz) + turns)

    def on(self, t: Array, seed: int) -> NDArray[np.bool_]:
        if not self.on_s:
            return np.ones(len(t), bool)
        number = np.floor(t / self.every_s)
        begins = [np.random.default_rng([seed, int(k), 3]).uniform(0, self.every_s - self.on_s) for k in number]
        since = t - number * self.every_s - np.array(begins)
        return np.asarray((since >= 0) & (since < self.on_s))


@dataclass
class Disturbances:
    """One skin's. slopes (n, n, n): see Sheet.contact_slopes. Questions come in the order of time.

    Contact impedances act by the untouched sheet's slopes: under a touch of 5 N on the electrode itself their effect is
    so told to 20 %, elsewhere to 3 %.
    """

    slopes: Array
    seed: int
    flicker: Flicker | None = None
    telegraph: Telegraph | None = None
    jumping: int = 3  # electrodes that do
    hum: Hum | None = None
    _then: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        n = len(self.slopes)
        self._rng = np.random.default_rng([self.seed, 41])
        self._pickup = self._rng.standard_normal(n)
        self._turns = self._rng.random()
        self._states = self._rng.standard_normal((len(self.flicker.times_s) if self.flicker else 0, n))
        self._jumpers = self._rng.permutation(n)[: self.jumping]
        self._high = self._rng.random(self.jumping) < 0.5

    def ohm(self, rows: NDArray[np.int64], instants: Array, z: Array) -> Array:
        """(K,) what is added to impedances z (K,) that are measured between electrodes `rows` (K, 4) at `instants`."""
        added = np.zeros(len(rows))
        if self.flicker is not None or self.telegraph is not None:
            dp, dm, sp, sm = rows.T
            slopes = self.slopes
            read = slopes[:, sp, dp] - slopes[:, sp, dm] - slopes[:, sm, dp] + slopes[:, sm, dm]
            added += (read.T * self._contacts(instants)).sum(axis=1)
        if self.hum is not None:
            wave = np.sqrt(2) * np.sin(2 * np.pi * (self.hum.phase(instants) + self._turns))
            wave *= self.hum.on(instants, self.seed)
            between = (self._pickup[rows[:, 2]] - self._pickup[rows[:, 3]]) / np.sqrt(2)
            added += self.hum.share * np.abs(z) * wave * between
        return added

    def _contacts(self, instants: Array) -> Array:
        """(K, n) by how much each contact impedance is off, relative, at each instant."""
        off = np.zeros((len(instants), len(self.slopes)))
        for k, t in enumerate(instants.tolist()):
            passed, self._then = max(0.0, t - self._then), t
            if self.flicker is not None:
                keep = np.exp(-passed / np.array(self.flicker.times_s))[:, None]
                fresh = self._rng.standard_normal(self._states.shape)
                self._states = keep * self._states + np.sqrt(1 - keep**2) * fresh
                off[k] += self.flicker.sd / np.sqrt(len(keep)) * self._states.sum(axis=0)
            if self.telegraph is not None:
                self._high ^= self._rng.random(self.jumping) < -np.expm1(-passed / self.telegraph.dwell_s)
                off[k, self._jumpers] += self.telegraph.jump * self._high
        return off
