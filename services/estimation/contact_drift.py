"""A contact that changes is told from a touch by the form of what it does to the pairs.

A contact impedance adds to every pair of its electrode alike (a touch near it lets the current go round, and is felt by
other pairs too), so the difference of a frame is

    d = u a + n b + s        u: the series resistance, n: the rest of the contact's Jacobian, s: global scale

with a the relative change of the contact impedance. The current between neighbours that takes the short way through the
electrode, of which n comes, dies out as the contact does: b = a / (1 + a / SHORT_WAY), within 0.1 % of d from 1.05 to
100 times; less or more by up to a quarter where the contact was not the nominal one before. While one rises, each
measurement of a scan finds it a little higher: a and b are lines along the scan.

Of 120 touches within 1 mm of an electrode (radii 0.05 to 0.5, drops to 0.85 S/m) the most alike is off this line by 1.4
% of its d, of 120 anywhere within 40 mm of the centre by 37 %. So there are two answers: from SUSPECT on a change is a
contact's unless somebody presses right on the electrode (`sure` is False: nothing is valid until contact_evidence.py or
steady_change.py tells), from TELLING on it is a contact's. Under a touch that stays as it is, the change since a few
frames ago is the contact's alone. A fall is named at once: no touch lowers an impedance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle

Array = NDArray[np.floating]

MODEL_ERROR = 1.5e-3  # of |d|: what a contact's change may be off the formula
SHORT_WAY = 4.7  # times the nominal contact impedance: what the current's short way through an electrode comes to
OTHER_BEFORE = 1.25  # b may be so many times what follows of a, and its inverse
TELLING = 800.0  # |d| over the noise of one measurement from which a touch on an electrode would show
SUSPECT = 36.0  # from which one elsewhere would
UNTOUCHED = 0.03  # of |d|, what a changed contact leaves of it where nothing else changed
LEAST_RISE = 0.03  # of the nominal contact impedance
RISES_WITHIN = 0.5  # the same, where it rises within a scan
STEEPEST = 1.2  # of a: it rises from nothing within a scan, at most
RESEMBLES = 0.2  # of |d|, what it leaves where a touch goes on meanwhile
FALL = 0.004  # relative: a pair that fell by more, and by 6 sigma
SIGMAS = 6.0
MOST_OF = 0.6  # share of the electrode's pairs that fell (a touch may have raised the others)
FEW_OF = 0.05  # share of the other pairs that may have


class Changed(NamedTuple):
    electrode: int
    sure: bool  # whether it is no touch on this electrode


@dataclass(frozen=True)
class Reference:
    """What is known of the untouched skin, each (K,): |Z0| (0 where unknown), what differences are divided by, and
    their standard deviation (infinite where unknown).
    """

    z0: Array
    normaliser: Array
    sigma: Array


class ContactDrift:
    """ContactDrift compares frames with what a change of one contact does. It `knows` that for bundles that predict
    impedances. members (E, K): measurement uses electrode.
    """

    def __init__(self, bundle: Bundle, members: NDArray[np.bool_]) -> None:
        m = bundle.matrices
        self.members = members
        pairs = bool((m.pattern[:, 0] == m.pattern[:, 2]).all() and (m.pattern[:, 1] == m.pattern[:, 3]).all())
        self.knows = m.normalisation == "model" and pairs
        if not self.knows:
            return
        skin = bundle.skin
        series = np.asarray(skin["contact_impedance"], dtype=float) / np.asarray(skin["electrodes"]["width"])
        self._u = np.where(members, series[:, None] / m.z0, 0.0)  # (E, K)
        self._n = np.asarray(m.contact, dtype=float).T - self._u
        self._time = np.linspace(-1.0, 1.0, len(m.z0))  # the scan goes through the pattern in its order

    def form(self, k: int) -> Array:
        """Returns (K, 3): what a small change of electrode k's contact, of its rest and of the scale do to d."""
        return np.column_stack([self._u[k], self._n[k], np.ones(len(self._n[k]))])

    def __call__(self, d: Array, sigma: Array, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the electrode whose contact changed, or None. d, sigma (K,); live (K,): measurements that count."""
        if not self._tells(live):
            return None
        fell = live & (d < -np.maximum(FALL, SIGMAS * np.where(live, sigma, 0.0)))
        if fell.any():
            fallen = self._fallen(fell, live)
            return None if fallen is None else Changed(fallen, True)
        return self.risen(d, sigma, live)

    def _tells(self, live: NDArray[np.bool_]) -> bool:
        return self.knows and bool(live.sum() >= len(live) / 2)

    def _fallen(self, fell: NDArray[np.bool_], live: NDArray[np.bool_]) -> int | None:
        own = (self.members & fell).sum(axis=1)
        k = int(own.argmax())
        mine, others = self.members[k] & live, ~self.members[k] & live
        if fell[mine].mean() >= MOST_OF and fell[others].mean() <= FEW_OF:
            return k
        return None

    def risen(self, d: Array, sigma: Array, live: NDArray[np.bool_], aside: Array | None = None) -> Changed | None:
        """Returns the electrode whose contact rose, where that is all that d (K,) shows beside directions `aside` (K,
        n), which are orthonormal.
        """
        if not self._tells(live):
            return None
        noise = float(np.sqrt(np.mean(sigma[live] ** 2)))
        size = float(np.linalg.norm(_without(aside, d)[live]))
        if size < SUSPECT * noise:
            return None
        strength = self.members @ np.where(live, _without(aside, d), 0.0)
        k = int(strength.argmax())
        if strength[k] < 2 * np.partition(strength, -2)[-2]:
            return None  # the next electrode shares one pair only
        expected = _most_noise(sigma[live]) + (MODEL_ERROR * size) ** 2
        sure = size >= TELLING * noise
        if self._left_by_rise(k, d, live, aside) <= expected:
            return Changed(k, sure)
        within = sure and aside is None and self._rises_within(k, d, live, expected)
        return Changed(k, True) if within else None

    def resembles(self, d: Array, sigma: Array, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the electrode whose contact may have risen while something else changed a little too: where d (K,)
        has most of its energy in the form of that rise.
        """
        if not self._tells(live):
            return None
        strength = self.members @ np.where(live, d, 0.0)
        k = int(strength.argmax())
        energy = float(d[live] @ d[live])
        if energy < SUSPECT**2 * float(np.mean(sigma[live] ** 2)) or strength[k] < 2 * np.partition(strength, -2)[-2]:
            return None
        return Changed(k, False) if self._left_by_rise(k, d, live, None) <= RESEMBLES**2 * energy else None

    def _left_by_rise(self, k: int, d: Array, live: NDArray[np.bool_], aside: Array | None) -> float:
        """Returns the energy that a rise of electrode k's contact leaves of d; infinite where it is no rise."""
        beside = [] if aside is None else list(aside.T)
        (a, b, *_), left = self._fit(k, d, live, beside)
        if a < LEAST_RISE:
            return np.inf
        short = a / (1 + a / SHORT_WAY)
        most = float(np.clip(b, short / OTHER_BEFORE, short * OTHER_BEFORE))
        if most == b:
            return left
        rest = d[live] - most * self._n[k][live]
        columns = np.column_stack([self._u[k], np.ones(len(d)), *beside])[live]
        found, *_ = np.linalg.lstsq(columns, rest, rcond=None)
        rest = rest - columns @ found
        return float(rest @ rest)

    def _rises_within(self, k: int, d: Array, live: NDArray[np.bool_], expected: float) -> bool:
        """Returns whether electrode k's contact rose in the course of the scan."""
        (a, b, _, slope, _), left = self._fit(k, d, live, [self._u[k] * self._time, self._n[k] * self._time])
        return bool(a >= RISES_WITHIN and -0.1 * a <= b <= 1.3 * a and abs(slope) <= STEEPEST * a and left <= expected)

    def _fit(self, k: int, d: Array, live: NDArray[np.bool_], more: Sequence[Array] = ()) -> tuple[Array, float]:
        """Fits a, b, s and the amounts of `more` (K,) to d; returns them and the energy that is left."""
        columns = np.column_stack([self._u[k], self._n[k], np.ones(len(d)), *more])[live]
        found, *_ = np.linalg.lstsq(columns, d[live], rcond=None)
        left = d[live] - columns @ found
        return found, float(left @ left)

    def felt_by_others(self, k: int, d: Array, sigma: Array, live: NDArray[np.bool_]) -> Array | None:
        """Returns (K,) what the change at electrode k does to the pairs that do not use it; None while something else
        changes too.
        """
        if not self.knows or not live.any():
            return None
        energy = float(d[live] @ d[live])
        noise = _most_noise(sigma[live])
        if energy <= noise:
            return np.zeros(len(d))
        (_, b, _), left = self._fit(k, d, live)
        if not left <= UNTOUCHED**2 * energy + noise:  # NaN says nothing
            return None
        return np.where(self.members[k], 0.0, b * self._n[k])


def _without(aside: Array | None, d: Array) -> Array:
    return d if aside is None else np.asarray(d - aside @ (aside.T @ d))


def _most_noise(sigma: Array) -> float:
    """Returns the energy that noise alone may come to."""
    return float(sigma @ sigma) * (1 + 4 * float(np.sqrt(2 / len(sigma))))
