"""What the newest parts of a scan say before a whole scan can: that a touch began, when, or that it ended.

A touch m of a grid (models/sentinel.py) that began at an instant changes value k, measured at t_k, by d_k = drop R_mk
f(t_k), with f a step at that instant or a ramp from it. Over all touches, instants and both forms the likelihood ratio
to an untouched skin is exp(z^2 / 2), z the matched filter's value. A begin counts only where

- z exceeds SIGMAS, which noise does less than once in a month of parts,
- one touch explains what changed, within what the linear model of it may be wrong by,
- it explains more than a change of gain would,
- it is seen also without all measurements of any two electrodes: a contact, an open or a short is not.

Otherwise the next part decides, or the next whole scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.sentinel import touches

Array = NDArray[np.floating]

SIGMAS = 7.0
OUTSIDE_SIGMAS = 4.0  # without any two electrodes
GAIN_MARGIN = 10.0  # nats times two, by which a touch is likelier than a change of gain
LINEAR = 0.1  # of d: by so much the linear picture of a touch on a grid position may be wrong
ELSEWHERE = 0.25  # model units: a touch so far from another is in another place
UNLIKELY = 8.0  # nats by which other places must be less likely
MISFIT = 0.3  # of what one touch explains: so much may be left
NEWEST = 3  # parts within which a touch may have begun that nothing is known of yet
RAMP_PARTS = 5  # the same of one that grows
RAMPS = (2.5, 4.5, 7.0, 11.0)  # parts that a force may take to grow, once its beginning is known
NEAR = 0.5  # parts by which a known beginning may be off
FAINT = 0.2  # of a ramp's newest value, below which a value tells too little
HELD_SIGMAS = 12.0  # that a held touch must have in one part for its absence to be seen there
GONE_SIGMAS = 3.0


@dataclass(frozen=True)
class PartOnset:
    """A touch that began. course (K,): f at each value's instant, 1 at the newest, 0 before the touch began."""

    sigmas: float
    since: float  # age of the oldest value that felt it
    grown: float  # of the oldest value that felt all of it
    course: NDArray[np.float64]


class PartEvidence:
    """For one bundle. `knows` is false where its differences have no sign: then parts say nothing."""

    def __init__(self, bundle: Bundle, parts: int) -> None:
        m = bundle.matrices
        self.knows = m.normalisation == "model" and parts > 1
        grid = touches(m, bundle.half_width)
        self._response = np.asarray(grid.response, dtype=np.float64)  # (M, K)
        self._position = np.asarray(grid.position, dtype=np.float64)
        self._count = len(bundle.pattern) // parts  # values in a part
        electrodes = int(bundle.pattern.max()) + 1
        uses = np.array([np.isin(np.arange(electrodes), row) for row in bundle.pattern])
        self._outside = np.array([~(uses[:, a] | uses[:, b]) for a, b in combinations(range(electrodes), 2)])

    def sigmas(self, d: Array, noise: Array, age: Array) -> float:
        """The largest matched filter of the newest part alone. d, noise, age: (K,) each."""
        rows = np.argsort(age)[: self._count]
        return float(_filters(self._response[:, rows], d[rows], noise[rows], np.ones((1, len(rows)))).max())

    def began(self, d: Array, noise: Array, age: Array, since: float | None = None) -> PartOnset | None:
        """The touch that began within the newest parts, or so long ago as is known; None where that is not sure. since:
        its beginning, in the unit of age (K,).
        """
        order = np.argsort(age)
        rows = order[: RAMP_PARTS * self._count]
        if since is None:
            courses = _courses(age[rows], self._count)
        else:
            near = NEAR * float(age[order[self._count]] - age[order[0]])
            rows = order[age[order] < since + near]
            courses = _courses(age[rows], self._count, max(2, int((age[rows] < since - near).sum())))
        z = _filters(self._response[:, rows], d[rows], noise[rows], courses)
        touch, best = np.unravel_index(int(z.argmax()), z.shape)
        f, found = courses[best], float(z[touch, best])
        if found < SIGMAS or not self._in_one_place(d[rows], noise[rows], courses, rows):
            return None
        on = f > 0
        rows, f = rows[on], f[on]
        if not self._is_touch(d[rows], noise[rows], f, rows):
            return None
        course = np.zeros(len(d))
        course[rows] = f
        return PartOnset(found, float(age[rows].max()), float(age[rows][f >= 1.0].max()), course)

    def _in_one_place(self, d: Array, noise: Array, courses: Array, rows: NDArray[np.intp]) -> bool:
        """Whether no touch elsewhere, of whatever course, is nearly as likely as the likeliest: a few values may fit
        two places.
        """
        z = _filters(self._response[:, rows], d, _with_misfit(d, noise), courses).max(axis=1).clip(0.0)
        far = np.hypot(*(self._position - self._position[int(z.argmax())]).T) > ELSEWHERE
        return bool(z.max() ** 2 - z[far].max() ** 2 > 2 * UNLIKELY)

    def _is_touch(self, d: Array, noise: Array, f: Array, rows: NDArray[np.intp]) -> bool:
        response, one = self._response[:, rows], f[None]
        wide = _with_misfit(d, noise)
        explained = float(_filters(response, d, wide, one).max()) ** 2
        left = float(((d / wide) ** 2).sum()) - explained
        if left > len(d) + 3 * np.sqrt(2 * len(d)) + MISFIT * explained:
            return False
        gain = float((d * f / noise**2).sum()) ** 2 / float((f**2 / noise**2).sum())
        if float(_filters(response, d, noise, one).max()) ** 2 < gain + GAIN_MARGIN:
            return False
        outside = self._outside[:, rows] * f
        return bool(_filters(response, d, noise, outside).max(axis=0).min() > OUTSIDE_SIGMAS)

    def ended(self, d: Array, held: Array, noise: Array, age: Array) -> bool:
        """Whether nothing touched while the newest part was measured, although `held` (K,), the difference of the
        touch until then, would be plain in it.
        """
        rows = np.argsort(age)[: self._count]
        count = len(rows)
        expected = float(((held[rows] / noise[rows]) ** 2).sum())
        left = float(((d[rows] / noise[rows]) ** 2).sum())
        silent = left < count + 3 * np.sqrt(2 * count) and self.sigmas(d, noise, age) < GONE_SIGMAS + 1.0
        return expected > HELD_SIGMAS**2 + count and silent


def _with_misfit(d: Array, noise: Array) -> Array:
    """Standard deviation of d (n,) against the linear picture of a touch on a grid position."""
    felt = d**2 > (3 * noise) ** 2
    size = float((d[felt] ** 2).mean()) if felt.any() else 0.0
    return np.asarray(np.sqrt(noise**2 + (LINEAR * d) ** 2 + (LINEAR / 2) ** 2 * size))


def _filters(response: Array, d: Array, noise: Array, courses: Array) -> Array:
    """(M, H) matched filters of touches (M, n) that took one of the courses (H, n)."""
    whitened = response / noise
    along = (whitened * (d / noise)) @ courses.T
    size = (whitened**2) @ (courses**2).T
    return np.asarray(along / np.sqrt(np.maximum(size, 1e-12)))


def _courses(age: Array, count: int, least: int = 2) -> Array:
    """(H, n) courses of a touch over values of these ages, the newest first: steps, and ramps that go on. least: so
    many values are newer than a step that is known.
    """
    most = NEWEST * count if least == 2 else len(age)
    steps = [np.arange(len(age)) < n for n in range(least, min(most, len(age)) + 1)]
    ramps = []
    for n in range(max(count, least), len(age) + 1, max(1, count // (2 if least == 2 else 4))):
        since = float(age[n - 1])
        lasts = [since - float(age[0])]
        if least > 2:
            lasts += [took for each in RAMPS if (took := each * count * float(np.median(np.diff(age)))) < lasts[0]]
        for took in lasts:
            f = np.clip((since - age) / max(took, 1e-9), 0.0, 1.0)
            ramps.append(np.where(f > FAINT, f, 0.0))
    return np.array([*steps, *ramps], dtype=np.float64)
