"""Scripts for tests and benchmarks: presses, slides, contacts that change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware_stub.timeline import Cue, PiecewiseLinear, Script, TouchPath
from firmware_stub.world import Touch, pressed

JUMP_S = 1e-3
RAMP_S = 0.1  # a finger's
SIDE_M = 0.04  # how far from the centre `spread` presses, along each axis
ContactCurves = tuple[tuple[int | None, PiecewiseLinear], ...]


@dataclass(frozen=True)
class DiscPress:
    """A disc of so many newtons from one time to another [s], whose force grows and falls over `ramp` seconds within
    them; between the ramps it slides to the point `to`.
    """

    x: float
    y: float
    start: float
    end: float
    force: float = 3.0
    ramp: float = 0.0
    radius: float = 0.01
    to: tuple[float, float] | None = None

    def path(self) -> TouchPath:
        return path_of(disc(self.x, self.y, self.force, self.radius), self.start, self.end, self.ramp, self.to)


def disc(x: float, y: float, force: float, radius: float = 0.01) -> Touch:
    """Metres and newtons."""
    return pressed("circle", x, y, radius, force)


def path_of(
    touch: Touch, start: float, end: float, ramp: float = RAMP_S, to: tuple[float, float] | None = None
) -> TouchPath:
    """A touch from start to end, its ramps included; without them it is there at once."""
    there = touch if to is None else replace(touch, x=to[0], y=to[1])
    if not ramp:
        return TouchPath((start, end), (touch, there))
    poses = replace(touch, drop=0.0), touch, there, replace(there, drop=0.0)
    return TouchPath((start, start + ramp, end - ramp, end), poses)


def script(
    *presses: DiscPress | TouchPath,
    cues: Sequence[Cue] = (),
    contact: ContactCurves = (),
    background: PiecewiseLinear | None = None,
) -> Script:
    tracks = tuple(each.path() if isinstance(each, DiscPress) else each for each in presses)
    return Script("simulated", tracks=tracks, cues=tuple(cues), contact=contact, background=background)


def step(electrode: int | None, times: float, at: float, until: float = math.inf) -> tuple[int | None, PiecewiseLinear]:
    """A contact impedance (None: each) that jumps by a factor, and back."""
    keys = [(0.0, 1.0), (at - JUMP_S, 1.0), (at, times)]
    if math.isfinite(until):
        keys += [(until - JUMP_S, times), (until, 1.0)]
    return electrode, PiecewiseLinear(tuple(t for t, _ in keys), tuple(value for _, value in keys))


def ramp(*keys: tuple[float, float]) -> PiecewiseLinear:
    """(when, value), and straight lines between them."""
    return PiecewiseLinear(tuple(t for t, _ in keys), tuple(value for _, value in keys))


def spread(count: int, seed: int) -> list[Touch]:
    """Discs of 1 to 5 N and radius 5 to 15 mm, spread over the skin."""
    rng, made = np.random.default_rng([seed, 12]), []
    for k in range(count):
        x, y = (SIDE_M * (2 * _halton(k + 1, base) - 1) for base in (2, 3))
        made.append(disc(x, y, float(rng.uniform(1, 5)), float(rng.uniform(0.005, 0.015))))
    return made


def _halton(k: int, base: int) -> float:
    """The k-th of a sequence that fills 0 to 1 evenly."""
    value, share = 0.0, 1.0 / base
    while k:
        value, k, share = value + share * (k % base), k // base, share / base
    return value
