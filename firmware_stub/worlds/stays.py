"""Where a touch stayed, and how strongly when: what the foam at each place went through."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from firmware_stub.timeline import TouchPath
from firmware_stub.world import Touch

STILL_M = 1e-9  # a leg that moves by less does not move
BRIEF_S = 0.5  # a touch that stays for less leaves no warmth


@dataclass(frozen=True)
class Stay:
    """One place under a touch: `drops` [S/m] at `times` [s], linear in between, 0 outside. `still`: nothing slid."""

    pose: Touch
    times: tuple[float, ...]
    drops: tuple[float, ...]
    still: bool

    def under(self, touch: Touch) -> float:
        """Share of the place that a touch covers, 0 to 1: linear in the distance, as a trail needs it."""
        far = float(np.hypot(touch.x - self.pose.x, touch.y - self.pose.y))
        return max(0.0, 1 - far / (2 * self.pose.radius))

    @property
    def warms(self) -> bool:
        return self.still and self.times[-1] - self.times[0] >= BRIEF_S


@lru_cache(maxsize=512)
def stays(path: TouchPath) -> tuple[Stay, ...]:
    """The places of a touch in the order of time. A slide leaves a trail of discs a radius apart."""
    found: list[Stay] = []
    times, drops, here = [path.times[0]], [path.poses[0].drop], path.poses[0]
    for a, b, start, end in zip(path.times, path.times[1:], path.poses, path.poses[1:], strict=False):
        way = float(np.hypot(end.x - start.x, end.y - start.y))
        if way < STILL_M or b <= a:
            times.append(b)
            drops.append(end.drop)
            here = max(here, end, key=lambda touch: touch.drop)
            continue
        passing_s = min(b - a, 2 * start.radius * (b - a) / way)
        found.append(Stay(here, (*times, a + passing_s), (*drops, 0.0), still=True))
        found += _trail(a, b, start, end, way)
        times, drops, here = [b - passing_s, b], [0.0, end.drop], end
    return (*found, Stay(here, tuple(times), tuple(drops), still=True))


def _trail(a: float, b: float, start: Touch, end: Touch, way: float) -> list[Stay]:
    """The places between the ends of a slide: each is covered while the touch goes on by its diameter."""
    radius, speed = start.radius, way / (b - a)
    made = []
    for far in np.arange(radius, way - radius / 2, radius):
        share, at = float(far) / way, a + float(far) / speed
        drop = start.drop + share * (end.drop - start.drop)
        pose = replace(start, x=start.x + share * (end.x - start.x), y=start.y + share * (end.y - start.y), drop=drop)
        half = radius / speed
        made.append(Stay(pose, (at - half, at - half / 2, at + half / 2, at + half), (0.0, drop, drop, 0.0), False))
    return made
