"""What a skin's foam and warmth make of what touches it: a timeline's worlds, with all that no truth tells."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from firmware_stub.timeline import Timeline, TouchPath, WorldSegment
from firmware_stub.world import Touch, WarmSpot, World

from .foam import CreepLaw
from .stays import Stay, stays

FIRST_S, GROWS, LONGEST_S = 0.05, 1.3, 1.0
"""After each event a stretch of time is cut into pieces, each longer than the one before, on which all goes linearly: a
power of time is then within 3e-4 of itself.
"""
REMEMBERED_S = 400.0  # for so long after its end a touch can be felt
FAINT = 5e-4  # S/m: less is not felt
FAINT_WARMTH = 2e-4  # share of the conductivity


@dataclass(frozen=True)
class Rise:
    """A temperature that rises from a start, as a body on a heater does: share (1 - exp(-t / tau)) of conductivity."""

    share: float
    tau_s: float
    begin_s: float = 0.0

    def at(self, t: float) -> float:
        return 0.0 if t <= self.begin_s else self.share * -math.expm1(-(t - self.begin_s) / self.tau_s)

    def while_on(self, t: float, begin: float, end: float) -> float:
        """Of what heats from `begin` to `end` alone."""
        risen = replace(self, begin_s=begin).at(t)
        return risen - replace(self, begin_s=end).at(t)


@dataclass(frozen=True)
class Nature:
    """One skin's. even, sloped: of the whole sheet, and a metre along `slope`; spot: where something warms it; hand: at
    each touch that stays, `hand_radius` times as wide as it.
    """

    creep: CreepLaw | None = None
    even: Rise | None = None
    sloped: Rise | None = None
    slope: tuple[float, float] = (1.0, 0.0)
    spot: Rise | None = None
    spot_place: tuple[float, float, float] = (0.0, 0.0, 0.02)  # x, y, standard deviation [m]
    hand: Rise | None = None
    hand_radius: float = 1.0

    def piece(self, timeline: Timeline, segment: WorldSegment, t: float) -> WorldSegment:
        """The piece of a timeline's segment around t, within which everything is linear."""
        if math.isinf(segment.start):
            return segment
        low, high = _around(t - segment.start)
        start, end = segment.start + low, min(segment.start + high, segment.end)
        middle = (start + end) / 2
        return WorldSegment(
            start, end, self._world(timeline, segment, start, middle), self._world(timeline, segment, end, middle)
        )

    def _world(self, timeline: Timeline, segment: WorldSegment, t: float, inside: float) -> World:
        """The world at t; what there is of touches, residues and spots is that of the instant `inside`."""
        plain = segment.at(t)
        paths = list(_paths(timeline, inside))
        present = [path for path in paths if path.pose(inside, inside) is not None]
        touches = tuple(self._crept(touch, path, t) for touch, path in zip(plain.touches, present, strict=True))
        places = [(stay, path.pose(t, inside), path.pose(inside, inside)) for path in paths for stay in stays(path)]
        kept = [(stay, now) for stay, now, then in places if self._stays(stay, then, inside)]
        return replace(
            plain,
            touches=touches,
            background=plain.background * (1 + (self.even.at(t) if self.even else 0.0)),
            residues=tuple(self._residue(stay, now, t) for stay, now in kept),
            gradient=self._gradient(t),
            spots=tuple(self._spots([stay for stay, _, _ in places], t, inside)),
        )

    def _crept(self, touch: Touch, path: TouchPath, t: float) -> Touch:
        if self.creep is None:
            return touch
        crept = max(stay.under(touch) * self.creep.added(t, stay.times, stay.drops) for stay in stays(path))
        return replace(touch, crept=max(0.0, crept))

    def _residue(self, stay: Stay, touch: Touch | None, t: float) -> Touch:
        """What a place keeps, but for what its own touch still covers."""
        assert self.creep is not None
        free = 1.0 if touch is None else 1 - stay.under(touch)
        return replace(stay.pose, drop=max(0.0, free * self.creep.added(t, stay.times, stay.drops)))

    def _stays(self, stay: Stay, touch: Touch | None, t: float) -> bool:
        return self.creep is not None and t > stay.times[0] and self._residue(stay, touch, t).drop > FAINT

    def _gradient(self, t: float) -> tuple[float, float]:
        steep = self.sloped.at(t) if self.sloped else 0.0
        return steep * self.slope[0], steep * self.slope[1]

    def _spots(self, places: list[Stay], t: float, inside: float) -> Iterator[WarmSpot]:
        if self.spot is not None:
            yield WarmSpot(*self.spot_place, self.spot.at(t))
        if self.hand is None:
            return
        for stay in places:
            begin, end = stay.times[0], stay.times[-1]
            if stay.warms and self.hand.while_on(inside, begin, end) > FAINT_WARMTH:
                warmth = self.hand.while_on(t, begin, end)
                yield WarmSpot(stay.pose.x, stay.pose.y, self.hand_radius * stay.pose.radius, warmth)


def _around(age: float) -> tuple[float, float]:
    """The piece that holds an age [s], as ages."""
    low, step = 0.0, FIRST_S
    while step < LONGEST_S:
        if age < low + step:
            return low, low + step
        low, step = low + step, step * GROWS
    low += math.floor((age - low) / LONGEST_S) * LONGEST_S
    return low, low + LONGEST_S


def _paths(timeline: Timeline, t: float) -> Iterator[TouchPath]:
    """The touches that are felt or remembered at t, in the order of a world's touches. Of a loop this round and the one
    before are remembered.
    """
    script, rounds = timeline.script, [timeline.start]
    if script.loop and t >= timeline.start:
        now = timeline.start + math.floor((t - timeline.start) / script.duration) * script.duration
        rounds = [now, now - script.duration] if now > timeline.start else [now]
    here = [_shifted(track, base) for base in rounds for track in script.tracks]
    for path in (*here, *timeline.presses):
        if path.times[0] <= t < path.times[-1] + REMEMBERED_S:
            yield path


def _shifted(path: TouchPath, by: float) -> TouchPath:
    return path if not by else replace(path, times=tuple(t + by for t in path.times))
