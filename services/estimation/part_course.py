"""Where a touch is that began within the newest parts of a scan, and how its force grew: by all of their values.

Its force is f(t): 0 before it began, 1 now, a line between, or a step. Likely beginnings are tried one after the other:
each gives a touch (part_image.py), and for that touch all courses are compared anew, on every value of the message. As
long as several are about as likely, the touch may be in the places of all of them, and its uncertainty says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.estimation.part_image import LEAST, LINEAR, PartImage, PartTouch, ellipse, variance_of

Array = NDArray[np.float64]

FAINT = 0.2  # of the newest value, below which one tells too little of the touch
LESS_LIKELY = 3.0  # nats by which a force that grew must be likelier than one that was there at once
CAUTIOUS = 2.0  # times its noise that a value is taken to have: what the model is wrong by is not independent
NEAR = 3.0  # standard deviations of a place, within which no other start is tried
FEW_STEPS = 3  # of a fit, after which it is asked whether it leads where another one did
BEGINS, GROWS = 4, 6  # values of a scan from one beginning that is tried to the next, from one end of the growth
BEFORE = 10  # beginnings that are tried within a scan's time before the oldest value
TINY = 1e-12


@dataclass(frozen=True)
class TouchStart:
    """A touch that may have begun. course (K,): f of each value; theta: x, y, log radius, log drop."""

    course: Array
    theta: Array


@dataclass(frozen=True)
class PartPlace:
    """The touch; course (K,): f of each value that tells; the uncertainty of its place is that of all likely courses.
    expected (K,): what the touch makes of d, where it tells too little too.
    """

    touch: PartTouch
    course: Array
    expected: Array


class Courses(NamedTuple):
    """f (H, K), its square, and how many of them are steps: those come first."""

    f: Array
    squared: Array
    steps: int


def courses(age: Array) -> Courses:
    """Those of values of these ages. Values are measured one after the other, as long as the one before took."""
    return _courses(np.argsort(age).tobytes())


@lru_cache(maxsize=32)
def _courses(ordered: bytes) -> Courses:
    order = np.frombuffer(ordered, dtype=np.intp)
    age = np.empty(len(order))
    age[order] = np.arange(1.0, len(order) + 1)
    steps = np.zeros((len(age), len(age)))
    steps[:, order] = np.tri(len(age))
    whole = float(age[order[-1]]) * np.arange(1, BEFORE + 1) / BEFORE
    old = np.concatenate([age[order], age[order[-1]] + whole])
    begins = [*range(GROWS, len(age), BEGINS), *range(len(age), len(old))]
    tried = [(b, e) for b in begins for e in range(0, min(b - BEGINS, len(age)), GROWS)]
    begin, end = old[np.array(tried).T][:, :, None]
    f = np.concatenate([steps, ((begin - age) / (begin - end)).clip(0.0, 1.0)])
    return Courses(f, f**2, len(steps))


class PartPlaces:
    """For one bundle."""

    def __init__(self, image: PartImage) -> None:
        self._image, self._all = image, np.arange(image.measurements)

    def __call__(self, d: Array, noise: Array, age: Array, starts: Sequence[TouchStart]) -> PartPlace:
        """d (K,) with standard deviation noise (K,), measured at these ages."""
        tried, found = courses(age), list[tuple[float, PartPlace]]()
        for start in starts:
            alike = [place for _, place in found if _grew(place.course) == _grew(start.course)]
            if any(_within(start, place) for place in alike):
                continue
            first = self._towards(d, noise, start, tried) if alike else start
            if any(_same(first, place) for place in alike):
                continue
            found.append(self._fitted(d, noise, first.course, first.theta))
            theta = _theta(found[-1][1].touch)
            course = self._course(d, noise, theta, tried)
            if np.abs(course - first.course).max() > 0.0:
                found.append(self._fitted(d, noise, course, theta))
        cost = np.array([cost for cost, _ in found])
        best = found[int(cost.argmin())][1]
        weight = np.exp((cost.min() - cost) / 2 / CAUTIOUS**2)
        weight /= weight.sum()
        at = np.array([place.touch.at for _, place in found])
        middle = weight @ at
        spread = np.einsum("n,na,nb->ab", weight, at - middle, at - middle)
        own = np.einsum("n,nab->ab", weight, [_covariance(place.touch.sigma) for _, place in found])
        sigma = ellipse(own + spread, 1.0, LEAST)
        touch = replace(best.touch, at=(float(middle[0]), float(middle[1])), sigma=sigma)
        return PartPlace(touch, best.course, best.expected)

    def again(self, d: Array, noise: Array, age: Array, touch: PartTouch) -> PartPlace:
        """The same of a touch whose place is known, which goes on."""
        return self(d, noise, age, [TouchStart(self.course(d, noise, age, touch), _theta(touch))])

    def response(self, touch: PartTouch) -> Array:
        """(K,) d per S/m of this circle."""
        return self._response(_theta(touch))

    def _response(self, theta: Array) -> Array:
        return np.asarray(self._image.responses(theta[None, :3], self._all)[0])

    def _towards(self, d: Array, noise: Array, start: TouchStart, tried: Courses) -> TouchStart:
        """Where a start leads, after a few steps."""
        theta = self._image.towards(*_as_now(d, noise, start.course), start.theta, FEW_STEPS)
        return TouchStart(self._course(d, noise, theta, tried), theta)

    def course(self, d: Array, noise: Array, age: Array, touch: PartTouch) -> Array:
        """(K,) the likeliest course of this touch's force."""
        return self._course(d, noise, _theta(touch), courses(age))

    def _course(self, d: Array, noise: Array, theta: Array, tried: Courses) -> Array:
        response = self._response(theta) / (width := width_of(d, noise, LINEAR))
        along, size = tried.f @ (response * d / width), tried.squared @ response**2
        gain = np.maximum(along, 0.0) ** 2 / (size + TINY)
        gain[tried.steps :] -= 2 * LESS_LIKELY
        return np.asarray(tried.f[int(gain.argmax())])

    def _fitted(self, d: Array, noise: Array, course: Array, theta: Array) -> tuple[float, PartPlace]:
        """The touch of this course, and minus twice the logarithm of its likelihood."""
        touch = self._image.fit(*_as_now(d, noise, course), theta)
        expected = course * touch.drop * self.response(touch)
        cost = float((((d - expected) / width_of(d, noise, LINEAR)) ** 2).sum())
        cost += 2 * LESS_LIKELY * _grew(course)
        return cost, PartPlace(touch, np.where(course > FAINT, course, 0.0), expected)


def _theta(touch: PartTouch) -> Array:
    return np.array([touch.x, touch.y, np.log(touch.radius), np.log(touch.drop)])


def _as_now(d: Array, noise: Array, course: Array) -> tuple[Array, Array]:
    """(K,) d and its standard deviation as they would be if all were measured now: infinite where too little tells."""
    on = course > FAINT
    share = np.where(on, course, 1.0)
    return np.where(on, d / share, 0.0), np.where(on, noise / share, np.inf)


def _grew(course: Array) -> bool:
    """Whether the force was not there at once."""
    return bool(((course > 0) & (course < 1)).any())


def _within(start: TouchStart, place: PartPlace) -> bool:
    """Whether a start is where a touch that explains the values may be anyway."""
    x, y = place.touch.at
    return place.touch.fits and bool(np.hypot(start.theta[0] - x, start.theta[1] - y) < NEAR * place.touch.sigma[0])


def _same(start: TouchStart, place: PartPlace) -> bool:
    """Whether a start leads to a place that was found."""
    away = np.hypot(start.theta[0] - place.touch.x, start.theta[1] - place.touch.y)
    return bool(away < place.touch.sigma[0]) and np.array_equal(
        np.where(start.course > FAINT, start.course, 0.0), place.course
    )


def width_of(d: Array, noise: Array, error: float) -> Array:
    """(n,) standard deviation of d against a picture of it that is wrong by this share."""
    felt = np.sort(d**2)[-len(d) // 2 :]
    return np.asarray(np.sqrt(variance_of(d, noise, float(felt.mean()), error)))


def _covariance(sigma: tuple[float, float, float]) -> Array:
    long, short, angle = sigma
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(axes @ np.diag([long**2, short**2]) @ axes.T)
