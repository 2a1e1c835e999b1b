"""Random presses and random faults, one after the other, as a script of the stub."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.reliability.matrix import CONTACT_RISES, ROWS, Row
from bench.reliability.scenes import PLACE_M, RAMP_S, circle, press, script
from firmware_stub.faults import FAULTS
from firmware_stub.timeline import Cue, PiecewiseLinear, Script, TouchPath
from firmware_stub.world import Touch

SCAN_S = 0.0436  # a full scan of the board
TARE_S = 5.0  # nothing touches and nothing fails before
PAUSE_S = 2.0  # mean between two presses
PRESS_S = (0.6, 4.0)
SLIDES, PAIRS = 0.2, 0.15  # shares of presses that slide; that are two at once
LIBRARY, SLIDE_LIBRARY = 1000, 100  # touches that press, touches that slide
APART_M = 0.035
FAULT_PAUSE_S = 8.0  # mean between two faults
FAULT_S = (0.05, 3.0)
JUMP_S = 1e-3


@dataclass(frozen=True)
class TimedPress:
    """One touch, from begin to end [s], ramps included."""

    begin: float
    end: float
    slides: bool


@dataclass(frozen=True)
class RandomScene:
    script: Script
    presses: tuple[TimedPress, ...]
    faults: tuple[tuple[float, str], ...]  # when, what


def random_scene(
    seconds: float,
    seed: int,
    faults: bool = True,
    contact: tuple[tuple[int | None, PiecewiseLinear], ...] = (),
    cues: tuple[Cue, ...] = (),
) -> RandomScene:
    """contact, cues: what else happens to the skin and the board."""
    rng = np.random.default_rng([seed, 31])
    tracks, presses = _presses(rng, seconds)
    found: list[tuple[float, str]] = []
    made, jumps = list(cues), list(contact)
    t = TARE_S + float(rng.exponential(FAULT_PAUSE_S))
    while faults and t < seconds:
        row, last = ROWS[rng.integers(len(ROWS))], float(rng.uniform(*FAULT_S))
        args = row.draw(rng)
        found.append((t, f"{row.title} {args or ''}".strip()))
        made += _cues(row, args, t, last)
        jumps += _jumps(row, args, t, last)
        t += last + float(rng.exponential(FAULT_PAUSE_S))
    return RandomScene(script(tuple(tracks), tuple(made), tuple(jumps)), tuple(presses), tuple(found))


def still(n: int) -> Touch:
    """The n-th touch of the library: each has exact forward solves, which are kept and met again."""
    rng = np.random.default_rng([33, n])
    x, y = (float(v) for v in rng.uniform(-PLACE_M, PLACE_M, 2))
    return circle(x, y, float(rng.uniform(1, 5)), float(rng.uniform(0.1, 0.3)))


def slide(n: int) -> tuple[Touch, tuple[float, float], float]:
    """The n-th slide of the library: where it begins, where to, how many seconds it takes."""
    rng = np.random.default_rng([34, n])
    x, y = (float(v) for v in rng.uniform(-PLACE_M, PLACE_M, 2))
    return still(n), (x, y), float(rng.uniform(1.0, PRESS_S[1]))


def _presses(rng: np.random.Generator, seconds: float) -> tuple[list[TouchPath], list[TimedPress]]:
    tracks: list[TouchPath] = []
    presses: list[TimedPress] = []
    t = TARE_S + 0.5
    while True:
        t += float(rng.exponential(PAUSE_S)) + 2 * RAMP_S
        if slides := bool(rng.random() < SLIDES):
            touch, to, lasts = slide(int(rng.integers(SLIDE_LIBRARY)))
            made = [press(touch, t, t + lasts, to)]
        else:
            touch, lasts = still(int(rng.integers(LIBRARY))), float(rng.uniform(*PRESS_S))
            made = [press(touch, t, t + lasts)]
            other = still(int(rng.integers(LIBRARY)))
            if rng.random() < PAIRS and np.hypot(other.x - touch.x, other.y - touch.y) > APART_M:
                made.append(press(other, t, t + lasts))
        if t + lasts > seconds - 1:
            return tracks, presses
        tracks += made
        presses += [TimedPress(t, t + lasts, slides) for _ in made]
        t += lasts


def _cues(row: Row, args: dict[str, Any], at: float, seconds: float) -> list[Cue]:
    if row.fault == CONTACT_RISES:
        return []
    ends = [Cue(at + seconds, "power_cycle", {}, 0.1)] if FAULTS[row.fault].sticky else []
    return [Cue(at, row.fault, args, seconds), *ends]


def _jumps(row: Row, args: dict[str, Any], at: float, seconds: float) -> list[tuple[int | None, PiecewiseLinear]]:
    if row.fault != CONTACT_RISES:
        return []
    times = (0.0, at - JUMP_S, at, at + seconds - JUMP_S, at + seconds)
    return [(args["electrode"], PiecewiseLinear(times, (1.0, 1.0, args["times"], args["times"], 1.0)))]
