"""Is what began within the newest parts of a scan a touch, or the contact of one electrode that changed?

A contact that rises is felt by other pairs too, and from a dozen values a touch on its electrode explains that about as
well. What a contact's change does is known far better than what a touch does (contact_drift.py): so both are asked how
likely they make the very values since the beginning, each with its own error. A touch is shown only where it is
likelier than a change of any one contact, whatever its course, by LIKELIER nats. Until then the next part decides, and
a whole scan at the latest.
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
LOOKED_AT = 3  # contacts of which all are tried
SLOW, KNOT = 48, 12  # values from which on a contact may have any course, values between two knots of it
BENDS = (0.0, 0.5, 1.5)  # of a contact's rest while it rises slowly: a / SHORT_WAY (contact_drift.py)
NEAR, LONGER = np.linspace(-1.0, 1.0, 9), 1.13 ** np.arange(-6, 7)  # values apart, times as long: last of all
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
        any contact. d, noise, age: (K,) each.
        """
        return not self._knows or self.odds(d, noise, age, touch, since) > LIKELIER

    def odds(self, d: Array, noise: Array, age: Array, touch: Array, since: float) -> float:
        """Nats by which the touch is likelier."""
        rows = np.argsort(age)[: int((age <= since).sum()) + BEFORE]
        d, noise = d[rows], noise[rows]
        width = width_of(d, noise, LINEAR)
        of_touch = float((((d - touch[rows]) / width) ** 2).sum() + 2 * np.log(width).sum())
        return (self._of_contact(d, noise, rows) - of_touch) / 2

    def _of_contact(self, d: Array, noise: Array, rows: NDArray[np.intp]) -> float:
        """Minus twice the log likelihood of the likeliest change of a contact. Values (n,), the newest first."""
        width = width_of(d, noise, ERROR)
        own, rest, seen = self._own[:, rows] / width, self._rest[:, rows] / width, d / width
        every = _explained(own, rest, seen, *_courses(len(rows), BEGINS)).max(axis=0)
        gain = 0.0
        for k in np.argsort(every)[-LOOKED_AT:]:
            one = own[[k]], rest[[k]], seen
            begin, lasts = _courses(len(rows))
            for bend in BENDS:
                best = int(_explained(*one, begin, lasts, bend).argmax())
                near = _each(begin[best] + NEAR, lasts[best] * LONGER)
                gain = max(gain, float(_explained(*one, *near, bend).max()))
            if len(rows) >= SLOW:
                gain = max(gain, _explained_anyhow(own[k], rest[k], seen))
        return float(seen @ seen) - gain + 2 * float(np.log(width).sum())


def _explained(own: Array, rest: Array, seen: Array, begin: Array, lasts: Array, bend: float = 0.0) -> Array:
    """(H, E) of |seen|^2 that a change of each contact explains, over the courses (H,): a line from 0 to 1 that begins
    so many values ago and lasts so many. own, rest (E, n), seen (n,): the newest value first. bend: how far the rest
    dies out on the way, as far as it goes.
    """
    f = ((begin[:, None] - np.arange(len(seen))) / lasts[:, None]).clip(0.0, 1.0)
    g = f * (1 + bend) / (1 + bend * f)
    by_own, by_rest = f @ (own * seen).T, g @ (rest * seen).T
    of_own, both, of_rest = f**2 @ (own**2).T, (f * g) @ (own * rest).T, g**2 @ (rest**2).T
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
def _courses(count: int, most: int = 1000) -> tuple[Array, Array]:
    """Beginnings, at most so many, and durations of the courses that are tried over `count` values."""
    every = np.arange(1.0, BEYOND * count + 1)
    begin, lasts = _each(every[:: -(-len(every) // most)], np.array(LASTS))
    possible = lasts < 2 * begin
    return begin[possible], lasts[possible]


def _each(begins: Array, lasts: Array) -> tuple[Array, Array]:
    """Each beginning with each duration."""
    begin, last = np.meshgrid(begins, lasts)
    return begin.ravel(), last.ravel()
