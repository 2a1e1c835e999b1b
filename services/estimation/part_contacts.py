"""Is what began within the newest parts of a scan a touch, or the contact of one electrode that changed?

A contact that rises is felt by other pairs too, and from a dozen values a touch on its electrode explains that about as
well. What a contact's change does is known far better than what a touch does (contact_drift.py): so both are asked how
likely they make the very values since the beginning, each with its own error. A touch is shown only where it is
likelier than a change of any one contact by LIKELIER nats. Until then the next part decides, and then a whole scan.
Every contact is asked with a few courses. Those that come near to explaining it are asked with many.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from services.estimation.contact_drift import OTHER_BEFORE, SHORT_WAY, ContactDrift
from services.estimation.part_course import width_of
from services.estimation.part_image import LINEAR

Array = NDArray[np.float64]

LIKELIER = 10.0  # nats by which a touch must be likelier than a changed contact
ERROR = 0.005  # of d: what the change of a contact may be off its form
MOST_RISE = 10.0  # relative, of a contact impedance
LEAST_REST = 1 / OTHER_BEFORE / (1 + MOST_RISE / SHORT_WAY)  # of a change of its rest: b / a in contact_drift.py
LASTS = (1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 35.0, 60.0, 120.0)  # values within which a contact changes
BEFORE = 3  # values before the touch's beginning that are looked at too: a contact may change sooner
BEYOND = 1.5  # times as many: what rises slowly may be faint in the oldest of them
BEGINS = 32  # beginnings that are tried of every contact, at most
LOOKED_AT = 3  # contacts of which others are tried, near the likeliest
HOPELESS = 0.7  # of what a contact must explain: where those beginnings explain less, no other is tried. In 85 parts of
# contacts that rose (six electrodes, three amounts) they came to 0.99 at least; in touches to 0.5, in the median
SLOW, KNOT = 48, 12  # values from which on a contact may have any course, values between two knots of it
BENDS = (0.0, 0.5, 1.5)  # of a contact's rest while it rises slowly: a / SHORT_WAY (contact_drift.py)
NEAR, LONGER = np.linspace(-1.0, 1.0, 9), np.geomspace(0.48, 2.08, 13)  # of a gap, of a duration
TINY = 1e-12  # keeps solvable what no value tells


class PartContacts:
    """For one bundle. members (E, K): measurement uses electrode. Where nothing is known of contacts (ContactDrift says
    so) every touch is likelier.
    """

    def __init__(self, bundle: Bundle, members: NDArray[np.bool_]) -> None:
        drift = ContactDrift(bundle, members)
        self._knows = drift.knows
        if self._knows:
            forms = np.array([drift.form(k) for k in range(len(members))])
            self._own, self._rest = forms[:, :, 0], forms[:, :, 1]  # (E, K)

    def beaten(self, d: Array, noise: Array, age: Array, touch: Array, since: float) -> bool:
        """Whether a touch that makes `touch` (K,) of d explains what was measured within `since`, its age, better than
        any contact, by LIKELIER nats. d, noise, age: (K,) each.
        """
        if not self._knows:
            return True
        rows = np.argsort(age)[: int((age <= since).sum()) + BEFORE]
        d, noise, touch = d[rows], noise[rows], touch[rows]
        width, of_touch = width_of(d, noise, ERROR), width_of(d, noise, LINEAR)
        left = float((((d - touch) / of_touch) ** 2).sum() + 2 * np.log(of_touch / width).sum())
        own, rest, seen = self._own[:, rows] / width, self._rest[:, rows] / width, d / width
        return not _comes_to(own, rest, seen, float(seen @ seen) - left - 2 * LIKELIER)


def _comes_to(own: Array, rest: Array, seen: Array, needed: float) -> bool:
    """Whether a change of one contact explains so much of |seen|^2. own, rest (E, n), seen (n,), the newest first."""
    begin, lasts, apart = _courses(len(seen))
    every = _explained(own, rest, seen, begin, lasts).max(axis=0)
    if not HOPELESS * needed <= every.max() < needed:
        return bool(every.max() >= needed)
    looked_at = np.argsort(every)[-LOOKED_AT:]
    own, rest = own[looked_at], rest[looked_at]
    for bend in BENDS:
        found = _explained(own, rest, seen, begin, lasts, bend)
        for k, at in enumerate(found.argmax(axis=0)):
            if found[at, k] < HOPELESS * needed:
                continue
            best = float(begin[at]), float(lasts[at])
            for step in (apart, apart / len(NEAR) * 2):
                near = _each(best[0] + step * NEAR, best[1] * LONGER)
                gain = _explained(own[[k]], rest[[k]], seen, *near, bend)
                best = float(near[0][gain.argmax()]), float(near[1][gain.argmax()])
                if gain.max() >= needed:
                    return True
    return len(seen) >= SLOW and any(_explained_anyhow(*of, seen) >= needed for of in zip(own, rest, strict=True))


def _explained(own: Array, rest: Array, seen: Array, begin: Array, lasts: Array, bend: float = 0.0) -> Array:
    """(H, E) of |seen|^2 that a change of each contact explains, over the courses (H,): a line from 0 to 1 that begins
    so many values ago and lasts so many. own, rest (E, n), seen (n,): the newest value first. bend: how far the rest
    dies out on the way, as far as it goes.
    """
    f = ((begin[:, None] - np.arange(len(seen))) / lasts[:, None]).clip(0.0, 1.0)
    squared = f * f
    g, across, rests = f, squared, squared
    if bend:
        g = f * (1 + bend) / (1 + bend * f)
        across, rests = f * g, g * g
    by_own, by_rest = f @ (own * seen).T, g @ (rest * seen).T
    of_own, both, of_rest = squared @ (own**2).T, across @ (own * rest).T, rests @ (rest**2).T
    free = of_own * of_rest - both**2 + TINY
    a, b = (of_rest * by_own - both * by_rest) / free, (of_own * by_rest - both * by_own) / free
    gain = np.zeros_like(a)
    for share in (LEAST_REST, OTHER_BEFORE, np.clip(b / np.where(a > 0, a, np.inf), LEAST_REST, OTHER_BEFORE)):
        pull, size = by_own + share * by_rest, of_own + 2 * share * both + share**2 * of_rest
        gain = np.maximum(gain, np.maximum(pull, 0.0) ** 2 / (size + TINY))
    return np.asarray(gain)


def _explained_anyhow(own: Array, rest: Array, seen: Array) -> float:
    """The same of one contact, own, rest (n,), that changes along lines between knots, as it likes."""
    at = np.arange(len(seen)) / KNOT
    hats = np.maximum(0.0, 1.0 - np.abs(at - np.arange(int(at[-1]) + 2)[:, None]))
    found, *_ = np.linalg.lstsq(columns := np.concatenate([hats * own, hats * rest]).T, seen, rcond=None)
    return float(seen @ seen - ((seen - columns @ found) ** 2).sum())


@lru_cache(maxsize=128)
def _courses(count: int) -> tuple[Array, Array, float]:
    """Beginnings and durations of the courses that are tried first over `count` values, and how far apart the
    beginnings are.
    """
    every = np.arange(1.0, BEYOND * count + 1)
    apart = -(-len(every) // BEGINS)
    begin, lasts = _each(every[::-apart], np.array(LASTS))
    possible = lasts < 2 * begin
    return begin[possible], lasts[possible], float(apart)


def _each(begins: Array, lasts: Array) -> tuple[Array, Array]:
    """Each beginning with each duration."""
    begin, last = np.meshgrid(begins, lasts)
    return begin.ravel(), last.ravel()
