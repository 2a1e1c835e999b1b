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
contact's unless somebody presses right on the electrode (`sure` is False: nothing is valid until contact_evidence.py
tells), from TELLING on it is a contact's. Under a touch that stays as it is, the change since a few frames ago is the
contact's alone. A fall is named at once: no touch lowers an impedance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.saved import shaped

Array = NDArray[np.floating]

MODEL_ERROR = 1.5e-3  # of |d|: what a contact's change may be off the formula
SHORT_WAY = 4.7  # times the nominal contact impedance: what the current's short way through an electrode comes to
OTHER_BEFORE = 1.25  # b may be so many times what follows of a, and its inverse
TELLING = 800.0  # |d| over the noise of one measurement from which a touch on an electrode would show
SUSPECT = 60.0  # from which one elsewhere would
UNTOUCHED = 0.03  # of |d|, what a changed contact leaves of it where nothing else changed
LEAST_RISE = 0.03  # of the nominal contact impedance
LOOK_BACK = 3  # frames over which a contact that rises under a touch is told from it
LOOK_FAR_BACK = 24  # the same, where it rises slowly
RISES_WITHIN = 0.5  # the same, where it rises within a scan
STEEPEST = 1.2  # of a: it rises from nothing within a scan, at most
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


class ChangedContacts:
    """ChangedContacts keeps which contacts changed, and what they do to pairs of other electrodes; members (E, K)."""

    def __init__(self, bundle: Bundle, members: NDArray[np.bool_]) -> None:
        self._drift, self._k = ContactDrift(bundle, members), members.shape[1]
        self.reset()

    @property
    def knows(self) -> bool:
        """Whether the bundle predicts what a contact does."""
        return self._drift.knows

    def reset(self) -> None:
        self.felt: dict[int, Array] = {}  # by changed contact: (K,) relative, on pairs of other electrodes
        self._before: dict[int, Array] = {}  # by contact that rose under a touch: |Z| (K,) from before
        self._past: deque[Array] = deque(maxlen=LOOK_FAR_BACK)  # |Z| (K,) of the frames before, the newest last

    def follow(self, amplitude: Array) -> None:
        """Takes a frame's |Z| (K,), after it was judged."""
        self._past.append(amplitude.copy())

    def rescale(self, factor: float) -> None:
        """Multiplies all |Z| so far by this factor."""
        self._before = {k: row * factor for k, row in self._before.items()}
        self._past = deque((row * factor for row in self._past), maxlen=LOOK_FAR_BACK)

    def forget_past(self) -> None:
        """The frames so far say nothing of those to come: some had another gain."""
        self._past.clear()

    def changed(self, amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the electrode whose contact this frame shows to have changed."""
        found = self._drift(_difference(amplitude, untouched.z0, untouched, live), untouched.sigma, live)
        if found is not None or len(self._past) < LOOK_BACK:
            return found
        # Under a touch that stays, what changed is the contact's.
        sigma = np.sqrt(2.0) * untouched.sigma
        for past in (*self._before.values(), self._past[-LOOK_BACK], self._past[0]):
            both = live & np.isfinite(past)
            found = self._drift.risen(_difference(amplitude, past, untouched, both), sigma, both)
            if found is not None:
                self._before.setdefault(found.electrode, past)
                return found
        return self._changed_under_motion(amplitude, untouched, live)

    def _changed_under_motion(self, amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Changed | None:
        """Returns the same under a touch that moves steadily: the frames before say which change is its own."""
        back = 2 * LOOK_BACK
        if len(self._past) < 2 * back + LOOK_BACK:
            return None
        now, middle, first = (self._past[-LOOK_BACK - k * back] for k in range(3))
        live = live & np.isfinite(now) & np.isfinite(middle) & np.isfinite(first)
        velocity = _difference(now, middle, untouched, live)
        bend = velocity - _difference(middle, first, untouched, live)
        aside, _ = np.linalg.qr(np.column_stack([velocity, bend]))
        d = _difference(amplitude, now, untouched, live)
        found = self._drift.risen(d, np.sqrt(2.0) * untouched.sigma, live, aside)
        if found is None:
            return None
        self._before.setdefault(found.electrode, now)
        return found._replace(sure=False)

    def before(self, k: int) -> Array | None:
        """Returns |Z| (K,) of the touch under which the contact of electrode k rose."""
        return self._before.get(k)

    def forget(self, k: int) -> None:
        """Drops what is kept of electrode k: its contact is what it was."""
        self.felt.pop(k, None)
        self._before.pop(k, None)

    def keep(self, drifting: Sequence[int], like: Callable[[int, Array], bool] = lambda k, past: True) -> None:
        """Forgets all others. like: whether the measurements of electrode k are what they were in a past |Z| (K,)."""
        for k in drifting:  # what was wrong at once may have begun under a touch too
            if k not in self._before and len(self._past) >= LOOK_BACK and not like(k, self._past[-LOOK_BACK]):
                self._before[k] = self._past[-LOOK_BACK]  # a contact that drifts slowly was not well then either
        self.felt = {k: felt for k, felt in self.felt.items() if k in drifting}
        self._before = {k: before for k, before in self._before.items() if k in drifting}

    def shift(self, drifting: Sequence[int], amplitude: Array, untouched: Reference, live: NDArray[np.bool_]) -> Array:
        """Returns (K,) the change of |Z|, followed while nothing else changes: untouched, or under the touch it began
        under.
        """
        for k in drifting:
            for since in (untouched.z0, self._before.get(k)):
                if since is not None:
                    both = live & np.isfinite(since)
                    d = _difference(amplitude, since, untouched, both)
                    felt = self._drift.felt_by_others(k, d, untouched.sigma, both)
                    if felt is not None:
                        self.felt[k] = felt
                        break
        return np.asarray(untouched.normaliser * np.sum([*self.felt.values(), np.zeros(self._k)], axis=0))

    def state(self) -> dict[str, Any]:
        felt, before = ([[k, list(row)] for k, row in rows.items()] for rows in (self.felt, self._before))
        return {"felt": felt, "before": before, "past": np.array(self._past)}

    def load(self, state: dict[str, Any]) -> None:
        """Older recordings lack some. Raises ValueError where it does not fit."""
        self.reset()
        shape = (self._k,)
        self.felt = {int(k): shaped(row, shape) for k, row in state.get("felt", [])}
        self._before = {int(k): shaped(row, shape, finite=False) for k, row in state.get("before", [])}
        self._past.extend(shaped(row, shape, finite=False) for row in state.get("past", []))


def _difference(amplitude: Array, since: Array, untouched: Reference, live: NDArray[np.bool_]) -> Array:
    change = np.where(live, amplitude - np.where(live, since, 0.0), 0.0)
    return change / untouched.normaliser
