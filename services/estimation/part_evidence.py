"""What the newest parts of a scan say before a whole scan can: that a touch began, when, or that it ended.

A touch m of a grid (models/touch_grid.py) that began at an instant changes value k, measured at t_k, by d_k = drop R_mk
f(t_k), with f a step at that instant or a ramp from it. Over all touches, instants and both forms the likelihood ratio
to an untouched skin is exp(z^2 / 2), z the matched filter's value. A begin counts only where

- z exceeds SIGMAS, which noise does less than once in a month of parts,
- one touch explains what changed, within what the linear model of it may be wrong by,
- it explains more than a change of gain would,
- it is seen also without all measurements of any two electrodes: an open or a short is not,
- it explains more than a change of any one contact would, whatever its course (part_contacts.py).

Otherwise the next part decides, or the next whole scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.touch_grid import touches
from services.estimation.part_contacts import PartContacts
from services.estimation.part_course import FAINT, PartPlace, TouchStart
from services.estimation.part_image import variance_of

Array = NDArray[np.floating]

SIGMAS = 7.0
OUTSIDE_SIGMAS = 4.0  # without any two electrodes
GAIN_MARGIN = 10.0  # nats times two, by which a touch is likelier than a change of gain
LINEAR = 0.1  # of d: by so much the linear picture of a touch on a grid position may be wrong
ELSEWHERE = 0.25  # model units: a touch so far from another is in another place
UNLIKELY = 15.0  # nats by which other places must be less likely, for them not to be tried
STARTS = 2  # that are tried: with four no touch was found elsewhere, in 360 simulated ones
MISFIT = 0.3  # of what one touch explains: so much may be left
NEWEST = 3  # parts within which a touch may have begun that nothing is known of yet
RAMP_PARTS = 5  # the same of one that grows
RAMPS = (2.5, 4.5, 7.0, 11.0)  # parts that a force may take to grow, once its beginning is known
NEAR = 0.5  # parts by which a known beginning may be off
TINY = 1e-12  # keeps solvable what no value tells
HELD_SIGMAS = 12.0  # that a held touch must have in the newest parts for its absence to be seen there
ENDS_WITHIN = 5  # parts
GONE_SIGMAS = 3.0


@dataclass(frozen=True)
class PartOnset:
    """A touch that began. since: age of the oldest value that felt it; starts: what it may be, the likeliest first."""

    sigmas: float
    since: float
    starts: list[TouchStart]


class Responses(NamedTuple):
    """What each of M touches changes n measurements by, per S/m: (n, M), and its square."""

    change: Array
    squared: Array

    @classmethod
    def of(cls, response: Array) -> Responses:
        """response (M, n)."""
        change = np.ascontiguousarray(response.T)
        return cls(change, change**2)

    def at(self, rows: NDArray[np.intp]) -> Responses:
        """Those of these measurements."""
        return Responses(self.change[rows], self.squared[rows])

    def only(self, touch: int) -> Responses:
        """That of one touch."""
        return Responses(self.change[:, touch : touch + 1], self.squared[:, touch : touch + 1])


class PartEvidence:
    """For one bundle. `knows` is false where its differences have no sign: then parts say nothing."""

    def __init__(self, bundle: Bundle, parts: int) -> None:
        m = bundle.matrices
        self.knows = m.normalisation == "model" and parts > 1
        grid = touches(m, bundle.half_width)
        self._touches = Responses.of(np.asarray(grid.response, dtype=np.float64))
        self._position, self._radius = np.asarray(grid.position, dtype=np.float64), grid.radius
        self._count = len(bundle.pattern) // parts  # values in a part
        electrodes = int(bundle.pattern.max()) + 1
        uses = np.array([np.isin(np.arange(electrodes), row) for row in bundle.pattern])
        self._outside = np.array([~(uses[:, a] | uses[:, b]) for a, b in combinations(range(electrodes), 2)])
        self._contacts = PartContacts(bundle, uses.T)

    def sigmas(self, d: Array, noise: Array, age: Array, parts: int = 1) -> float:
        """The largest matched filter of so many of the newest parts. d, noise, age: (K,) each."""
        rows = np.argsort(age)[: parts * self._count]
        return float(_filters(self._touches.at(rows), d[rows], noise[rows], np.ones((1, len(rows)))).max())

    def began(self, d: Array, noise: Array, age: Array, since: float | None = None) -> PartOnset | None:
        """The touch that began within the newest parts, or so long ago as is known; None where that is not sure. since:
        its beginning, in the unit of age (K,).
        """
        order = np.argsort(age)
        rows = order[: RAMP_PARTS * self._count]
        if since is None:
            courses = _courses(len(rows), self._count)
        else:
            near = NEAR * float(age[order[self._count]] - age[order[0]])
            rows = order[age[order] < since + near]
            courses = _courses(len(rows), self._count, max(2, int((age[rows] < since - near).sum())))
        z = _filters(self._touches.at(rows), d[rows], noise[rows], courses)
        touch, best = np.unravel_index(int(z.argmax()), z.shape)
        f, found = courses[best], float(z[touch, best])
        if found < SIGMAS or not self._is_touch(d[rows[f > 0]], noise[rows[f > 0]], f[f > 0], rows[f > 0]):
            return None
        starts = []
        for m, h in self._likely(d[rows], noise[rows], courses, rows):
            course = np.zeros(len(d))
            course[rows] = courses[h]
            unit = self._touches.change[:, m] * course / noise
            drop = float(np.clip(unit @ (d / noise) / (unit @ unit + TINY), 0.01, 0.9))
            starts.append(TouchStart(course, np.array([*self._position[m], np.log(self._radius[m]), np.log(drop)])))
        return PartOnset(found, float(age[rows[f > 0]].max()), starts)

    def goes_on(self, d: Array, noise: Array, course: Array, response: Array) -> float | None:
        """Sigmas of a touch that began, response (K,) per S/m; None where it could be no touch by now."""
        rows = np.flatnonzero(course)
        d, noise, f, one = d[rows], noise[rows], course[rows], Responses.of(response[None, rows])
        found = float(_filters(one, d, noise, f[None]).max())
        return found if found >= SIGMAS and self._is_touch(d, noise, f, rows, one) else None

    def no_contact(self, d: Array, noise: Array, age: Array, place: PartPlace) -> bool:
        """Whether the touch explains what was measured since it began better than any contact that changed. d, noise,
        age: (K,) each.
        """
        d, noise, age = (np.asarray(each, dtype=np.float64) for each in (d, noise, age))
        return self._contacts.beaten(d, noise, age, place.expected, float(age[place.expected > 0].max()))

    def _likely(self, d: Array, noise: Array, courses: Array, rows: NDArray[np.intp]) -> list[tuple[int, int]]:
        """(touch, course) of the likeliest and of those that are nearly as likely, each of another form, or elsewhere:
        a few values may fit two.
        """
        z = _filters(self._touches.at(rows), d, _with_misfit(d, noise), courses).clip(0.0) ** 2
        ramp = np.asarray(((courses > 0) & (courses < 1.0)).any(axis=1))
        found: list[tuple[int, int]] = []
        likely = float(z.max()) - 2 * UNLIKELY
        while len(found) < STARTS and float(z.max()) >= max(likely, TINY):
            m, h = (int(n) for n in np.unravel_index(int(z.argmax()), z.shape))
            found.append((m, h))
            near = np.hypot(*(self._position - self._position[m]).T) <= ELSEWHERE
            z[np.ix_(near, ramp == ramp[h])] = 0.0
        return found

    def _is_touch(
        self, d: Array, noise: Array, f: Array, rows: NDArray[np.intp], response: Responses | None = None
    ) -> bool:
        """response: of the touches that it may be; None: all of the grid."""
        response, one = self._touches.at(rows) if response is None else response, f[None]
        wide = _with_misfit(d, noise)
        z = _filters(response, d, wide, one)[:, 0]
        explained = float(z.max()) ** 2
        left = float(((d / wide) ** 2).sum()) - explained
        if left > len(d) + 3 * np.sqrt(2 * len(d)) + MISFIT * explained:
            return False
        gain = float((d * f / noise**2).sum()) ** 2 / float((f**2 / noise**2).sum())
        if float(_filters(response, d, noise, one).max()) ** 2 < gain + GAIN_MARGIN:
            return False
        outside = self._outside[:, rows] * f
        if _filters(response.only(int(z.argmax())), d, noise, outside).min() > OUTSIDE_SIGMAS:
            return True  # this touch alone shows it
        return bool(_filters(response, d, noise, outside).max(axis=0).min() > OUTSIDE_SIGMAS)

    def ended(self, d: Array, held: Array, noise: Array, age: Array) -> bool:
        """Whether nothing touched while the newest parts were measured, although `held` (K,), the difference of the
        touch until then, would be plain in them.
        """
        order = np.argsort(age)
        expected, left = (np.cumsum((each[order] / noise[order]) ** 2) for each in (held, d))
        for parts in range(1, ENDS_WITHIN + 1):
            count = parts * self._count
            if expected[count - 1] > HELD_SIGMAS**2 + count:
                silent = left[count - 1] < count + 3 * np.sqrt(2 * count)
                return bool(silent and self.sigmas(d, noise, age, parts) < GONE_SIGMAS + 1.0)
        return False


def _with_misfit(d: Array, noise: Array) -> Array:
    """Standard deviation of d (n,) against the linear picture of a touch on a grid position."""
    felt = d**2 > (3 * noise) ** 2
    size = float((d[felt] ** 2).mean()) if felt.any() else 0.0
    return np.asarray(np.sqrt(variance_of(d, noise, size, LINEAR)))


def _filters(response: Responses, d: Array, noise: Array, courses: Array) -> Array:
    """(M, H) matched filters of touches that took one of the courses (H, n)."""
    weight = noise**-2.0
    along = (courses * (d * weight)) @ response.change
    size = (courses**2 * weight) @ response.squared
    return np.asarray(along / np.sqrt(np.maximum(size, 1e-12))).T


@lru_cache(maxsize=256)
def _courses(values: int, count: int, least: int = 2) -> Array:
    """(H, n) courses of a touch over so many values, the newest first, each measured as long after the one before:
    steps, and ramps that go on. least: so many values are newer than a step that is known.
    """
    age = np.arange(values)
    most = NEWEST * count if least == 2 else values
    steps = [age < n for n in range(least, min(most, values) + 1)]
    ramps = []
    for n in range(max(count, least), values + 1, max(1, count // (2 if least == 2 else 4))):
        lasts = [float(n - 1)]
        if least > 2:
            lasts += [took for each in RAMPS if (took := each * count) < lasts[0]]
        for took in lasts:
            f = np.clip((n - 1 - age) / max(took, 1e-9), 0.0, 1.0)
            ramps.append(np.where(f > FAINT, f, 0.0))
    return np.array([*steps, *ramps], dtype=np.float64)
