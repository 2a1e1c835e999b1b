"""Touches that slide into each other. A scan tells two that overlap badly, or not at all: how they came keeps them two.
Where two that stood apart come near each other, what whole scans told of each is gone on from: its action, and its
place by its velocity. It lasts a while only: then they are asked again as if nothing were known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.measurement.arrays import Array
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, TouchPrior, X, Y
from services.estimation.values import numbers as n


@dataclass
class TrackMotion:
    """A filter of constant velocity: what scans that share no value told of one touch, the last at `at_s`."""

    at_s: float
    x: float
    y: float
    place_sd: float
    action: float
    action_sd: float
    vx: float = 0.0
    vy: float = 0.0
    velocity_sd: float = float(n.SLIDES)
    apart_s: float = -np.inf  # when it last stood apart from all others

    @classmethod
    def begun(cls, state: Array, sd: Array, at_s: float) -> TrackMotion:
        """Of its first scan."""
        return cls(at_s, float(state[X]), float(state[Y]), _place_sd(sd), float(state[ACTION]), float(sd[ACTION]))

    def follow(self, state: Array, sd: Array, at_s: float) -> None:
        """Learn from a scan. A velocity follows the places as far as they are told better than it."""
        passed_s, place_sd = at_s - self.at_s, _place_sd(sd)
        if passed_s <= 0:
            return
        variance = min(self.velocity_sd**2 + n.TURNS**2 * passed_s, float(n.SLIDES) ** 2)
        seen = (place_sd**2 + self.place_sd**2) / passed_s**2
        gain = variance / (variance + seen)
        self.vx += gain * ((float(state[X]) - self.x) / passed_s - self.vx)
        self.vy += gain * ((float(state[Y]) - self.y) / passed_s - self.vy)
        self.velocity_sd = float(np.sqrt((1 - gain) * variance))
        self.at_s, self.x, self.y, self.place_sd = at_s, float(state[X]), float(state[Y]), place_sd
        self.action, self.action_sd = float(state[ACTION]), float(sd[ACTION])

    def goes_on(self, prior: TouchPrior, at_s: float) -> TouchPrior:
        """What is expected of it beside another one, where `prior` is of one by itself."""
        passed_s = at_s - self.at_s
        mean, sd = prior.mean.copy(), prior.sd.copy()
        mean[PLACE] = self.x + self.vx * passed_s, self.y + self.vy * passed_s
        sd[PLACE] = np.hypot(self.place_sd, np.hypot(self.velocity_sd, n.TURNS * np.sqrt(abs(passed_s))) * passed_s)
        mean[ACTION], sd[ACTION] = self.action, np.hypot(self.action_sd, n.ACTION_WALK * self.action)
        start = prior.start.copy()
        start[PLACE], start[ACTION] = mean[PLACE], mean[ACTION]
        return replace(prior, start=start, mean=mean, sd=sd)


def _place_sd(sd: Array) -> float:
    return float(np.hypot(sd[X], sd[Y])) / 2**0.5


def gaps(states: Sequence[Array] | Array) -> Array:
    """(T, T) between the edges of touches; of one with itself infinite."""
    each = np.array(states)
    radius = np.exp(each[:, LOG_RADIUS])
    away = np.hypot(*(each[:, None, PLACE] - each[None, :, PLACE]).transpose(2, 0, 1))
    found = away - radius[:, None] - radius
    np.fill_diagonal(found, np.inf)
    return np.asarray(found)


def neighbours(states: Array, association: Sequence[int]) -> tuple[int, int] | None:
    """Two touches (T, 7) near each other, the new one last. association: of each its track; -1: it is new."""
    for a, b in zip(*np.nonzero(np.triu(gaps(states) < n.NEIGHBOURS)), strict=True):
        if association[a] < 0 or association[b] < 0:
            return (int(a), int(b)) if association[b] < 0 else (int(b), int(a))
    return None


def apart(states: Array, association: Sequence[int]) -> bool:
    """Whether no touch that is new lies on another one: such two are one, as nobody saw them apart."""
    new = np.array(association) < 0
    return bool((gaps(states)[new] > n.NEIGHBOURS).all())
