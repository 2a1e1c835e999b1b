"""One electrode's contact with the skin that changes, told from a touch.

A contact impedance adds to every pair of its electrode alike (a touch near it lets the current go round, and is felt by
other pairs too), so the difference of a frame is

    d = u a + n b + s        u: the series resistance, n: the rest of the contact's Jacobian, s: global scale

with 0 <= b <= a for a contact that rises: the current between neighbours that takes the short way through the
electrode, of which n comes, dies out as the contact does. Contacts that rise to 30 times fit within 0.07 % of d. While
one rises, each measurement of a scan finds it a little higher: a and b are lines along the scan. The best of 2000
touches on electrodes (radii 0.05 to 0.5, drops to 0.85 S/m) leaves 0.5 %, the best of 20 000 anywhere 10 %. So a rise
is named where it is large enough against the noise to show that difference. Under a touch that stays as it is, the
change since a few frames ago is the contact's alone. A fall is named at once: no touch lowers an impedance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle

Array = NDArray[np.floating]

MODEL_ERROR = 1.5e-3  # of |d|: what a contact's change may be off the formula
TELLING = 1500.0  # |d| over the noise of one measurement from which a touch on an electrode would show
UNTOUCHED = 0.03  # of |d|, what a changed contact leaves of it where nothing else changed
LEAST_RISE = 0.5  # of the nominal contact impedance
STEEPEST = 1.2  # of a: it rises from nothing within a scan, at most
FALL = 0.004  # relative: a pair that fell by more, and by 6 sigma
SIGMAS = 6.0
MOST_OF = 0.6  # share of the electrode's pairs that fell (a touch may have raised the others)
FEW_OF = 0.05  # share of the other pairs that may have


class ContactDrift:
    """For a bundle that predicts impedances (`knows`); members (E, K): measurement uses electrode."""

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

    def __call__(self, d: Array, sigma: Array, live: NDArray[np.bool_]) -> int | None:
        """The electrode, 0-based, whose contact changed, or None. d, sigma (K,); live: measurements that count."""
        if not self.knows or live.sum() < len(d) / 2:
            return None
        fell = live & (d < -np.maximum(FALL, SIGMAS * np.where(live, sigma, 0.0)))
        if fell.any():
            return self._fallen(fell, live)
        return self.risen(d, sigma, live)

    def _fallen(self, fell: NDArray[np.bool_], live: NDArray[np.bool_]) -> int | None:
        own = (self.members & fell).sum(axis=1)
        k = int(own.argmax())
        mine, others = self.members[k] & live, ~self.members[k] & live
        if fell[mine].mean() >= MOST_OF and fell[others].mean() <= FEW_OF:
            return k
        return None

    def risen(self, d: Array, sigma: Array, live: NDArray[np.bool_]) -> int | None:
        """The electrode whose contact rose, where that is all that d (K,) shows."""
        if not self.knows or live.sum() < len(d) / 2:
            return None
        noise = float(np.sqrt(np.mean(sigma[live] ** 2)))
        size = float(np.linalg.norm(d[live]))
        if size < TELLING * noise:
            return None
        strength = self.members @ np.where(live, d, 0.0)
        k = int(strength.argmax())
        if strength[k] < 2 * np.partition(strength, -2)[-2]:
            return None  # the next electrode shares one pair only
        (a, b, _, slope, _), left = self._fit(k, d, live, [self._u[k] * self._time, self._n[k] * self._time])
        count = int(live.sum())
        expected = count * noise**2 * (1 + 4 * np.sqrt(2 / count)) + (MODEL_ERROR * size) ** 2
        if a >= LEAST_RISE and -0.1 * a <= b <= 1.3 * a and abs(slope) <= STEEPEST * a and left <= expected:
            return k
        return None

    def _fit(self, k: int, d: Array, live: NDArray[np.bool_], more: Sequence[Array] = ()) -> tuple[Array, float]:
        """a, b, s and what there is of `more` (K,) in d; the energy that is left."""
        columns = np.column_stack([self._u[k], self._n[k], np.ones(len(d)), *more])[live]
        found, *_ = np.linalg.lstsq(columns, d[live], rcond=None)
        left = d[live] - columns @ found
        return found, float(left @ left)

    def felt_by_others(self, k: int, d: Array, live: NDArray[np.bool_]) -> Array | None:
        """(K,) what the change at electrode k does to the pairs that do not use it; None while something else changes
        too.
        """
        if not self.knows:
            return None
        (_, b, _), left = self._fit(k, d, live)
        if left > UNTOUCHED**2 * float(d[live] @ d[live]):
            return None
        return np.where(self.members[k], 0.0, b * self._n[k])
