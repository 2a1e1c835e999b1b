"""What touches the skin when: tracks of keyframes, cut into segments on which everything moves linearly."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

from .world import Touch, World, blend


@dataclass(frozen=True)
class TouchPath:
    """One touch from its first key to its last, linear in between."""

    times: tuple[float, ...]  # s, not decreasing
    poses: tuple[Touch, ...]
    finger: str = ""  # of a press that its maker goes on moving: the next one of this name takes its place

    def pose(self, t: float, inside: float) -> Touch | None:
        """The pose at t on the leg that holds the instant `inside`; None where the touch is not there then."""
        if not self.times[0] <= inside < self.times[-1]:
            return None
        k = bisect_right(self.times, inside)
        a, b = self.times[k - 1], self.times[k]
        return blend(World((self.poses[k - 1],)), World((self.poses[k],)), (t - a) / (b - a)).touches[0]

    def until(self, t: float) -> TouchPath | None:
        """The path as it is up to t; None where it begins later."""
        if t >= self.times[-1]:
            return self
        if (last := self.pose(t, t)) is None or t == self.times[0]:
            return None
        k = bisect_right(self.times, t)
        return replace(self, times=(*self.times[:k], t), poses=(*self.poses[:k], last))


@dataclass(frozen=True)
class PiecewiseLinear:
    """A number over time: linear between keys, constant outside."""

    times: tuple[float, ...]
    values: tuple[float, ...]

    def value(self, t: float, inside: float) -> float:
        k = bisect_right(self.times, inside)
        if k == 0 or k == len(self.times):
            return self.values[max(0, k - 1)]
        a, b = self.times[k - 1], self.times[k]
        return self.values[k - 1] + (t - a) / (b - a) * (self.values[k] - self.values[k - 1])


@dataclass(frozen=True)
class WorldSegment:
    """From `start` to `end` the world goes linearly from `first` to `last`; an endless one stays as it is."""

    start: float
    end: float
    first: World
    last: World

    def at(self, t: float) -> World:
        if self.first == self.last:
            return self.first
        return blend(self.first, self.last, (t - self.start) / (self.end - self.start))


@dataclass(frozen=True)
class Cue:
    """A fault that the scene sets off at `t` seconds."""

    t: float
    name: str
    args: dict[str, object] = field(default_factory=dict)
    seconds: float = 5.0


@dataclass(frozen=True)
class Script:
    """One scene. Without a loop it stays as its last keys leave it; a loop starts over after `duration` seconds."""

    name: str
    about: str = ""
    tracks: tuple[TouchPath, ...] = ()
    background: PiecewiseLinear | None = None
    contact: tuple[
        tuple[int | None, PiecewiseLinear], ...
    ] = ()  # electrode (None: all) and the factor on its impedance
    cues: tuple[Cue, ...] = ()
    sections: tuple[tuple[float, str], ...] = ()  # (from when on [s], name), for whoever keeps the score
    duration: float = 0.0
    loop: bool = False

    @cached_property
    def breaks(self) -> tuple[float, ...]:
        """Times (s) between which everything is linear."""
        curves = [*(c for _, c in self.contact), *([self.background] if self.background else [])]
        times = {t for keys in (*(p.times for p in self.tracks), *(c.times for c in curves)) for t in keys}
        if self.loop:
            times = {t for t in times if t < self.duration} | {self.duration}
        return tuple(sorted(times | {0.0}))

    def world(self, t: float, inside: float, electrodes: int) -> World:
        touches = tuple(pose for track in self.tracks if (pose := track.pose(t, inside)))
        factors = [1.0] * electrodes
        for electrode, curve in self.contact:
            for k in range(electrodes) if electrode is None else (electrode,):
                factors[k] *= curve.value(t, inside)
        background = self.background.value(t, inside) if self.background else 1.0
        return World(touches, background, tuple(factors) if self.contact else ())


class Cutter(Protocol):
    """What a real skin makes of a timeline, see worlds/nature.py."""

    def piece(self, timeline: Timeline, segment: WorldSegment, t: float) -> WorldSegment:
        """The piece of a segment around t on which what the skin feels is linear."""


@dataclass(frozen=True)
class Timeline:
    """A script begun at `start`, and the presses made on request. Times are seconds since the stub started."""

    script: Script
    start: float = 0.0
    presses: tuple[TouchPath, ...] = ()
    electrodes: int = 16
    nature: Cutter | None = None

    def segment(self, t: float) -> WorldSegment:
        """The stretch of time around t on which everything is linear: start <= t < end."""
        plain = self._plain(t)
        return plain if self.nature is None else self.nature.piece(self, plain, t)

    def _plain(self, t: float) -> WorldSegment:
        script, breaks = self.script, self.script.breaks
        base = self.start
        if script.loop and t >= base:
            base += math.floor((t - base) / script.duration) * script.duration
            if not base <= t < base + script.duration:  # rounding
                base += math.copysign(script.duration, t - base)
        k = bisect_right(breaks, t - base)
        starts = [base + breaks[k - 1] if k else -math.inf]
        ends = [base + breaks[k] if k < len(breaks) else math.inf]
        for press in self.presses:
            for edge in (press.times[0], press.times[-1]):
                (starts if edge <= t else ends).append(edge)
        start, end = max(starts), min(ends)
        if math.isinf(start) or math.isinf(end):
            still = self._world(t, t, base)
            return WorldSegment(start, end, still, still)
        return WorldSegment(start, end, self._world(start, t, base), self._world(end, t, base))

    def _world(self, t: float, inside: float, base: float) -> World:
        world = self.script.world(t - base, inside - base, self.electrodes)
        pressed = tuple(pose for press in self.presses if (pose := press.pose(t, inside)))
        return replace(world, touches=world.touches + pressed)

    def at(self, t: float) -> World:
        return self.segment(t).at(t)


def press_track(
    start: float, seconds: float, touch: Touch, to: Sequence[float] | None = None, finger: str = ""
) -> TouchPath:
    """A press from `start` on, sliding to the point `to` (metres) where one is given."""
    end = replace(touch, x=to[0], y=to[1]) if to else touch
    return TouchPath((start, start + seconds), (touch, end), finger)
