"""Availability: the share of valid frames without a fault, and with one electrode that failed for good."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.reliability.counts import Counts
from bench.reliability.random_scene import SCAN_S, TARE_S, RandomScene, TimedPress, random_scene
from bench.reliability.scenes import RAMP_S, SolvedSheet
from bench.reliability.session import Moment, Session
from firmware_stub.timeline import Cue, PiecewiseLinear
from services.pipeline import Pipeline

FAILS_S = TARE_S + 0.5
NAMED_S = 1.0  # after it failed, from when on frames count
FRAMES = 2500  # of one session
DEAD = 1000.0  # times its contact impedance
DRIFTS, DRIFT_S = 3.0, 40.0  # rises to so many times its contact impedance and falls again, once in so long
WINDOW_S = 0.5  # after a begin or an end, in which `changing` is its
STATES = ("ok", "electrode open", "electrode dead", "electrode drifting")


@dataclass
class AvailabilityScore(Counts):
    frames: int = 0
    valid: int = 0
    named: int = 0  # frames that name the electrode
    wrong: int = 0  # valid frames with a contact more than 15 mm from every touch
    touches: int = 0
    reported: int = 0  # touches that most of their frames show, as valid
    changing: list[int] = field(default_factory=list)  # frames that say so, for each begin and each end

    def row(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "valid_%": 100 * self.valid / max(self.frames, 1),
            "named_%": 100 * self.named / max(self.frames, 1),
            "wrong": self.wrong,
            "touches": self.touches,
            "reported_%": 100 * self.reported / max(self.touches, 1),
            "changing_mean": float(np.mean(self.changing)) if self.changing else None,
            "changing_most": max(self.changing, default=None),
            "changing_over_2": sum(n > 2 for n in self.changing),
        }


def session(sheet: SolvedSheet, pipeline: Pipeline, state: str, frames: int, seed: int) -> AvailabilityScore:
    electrode = int(np.random.default_rng([seed, 32]).integers(16))
    seconds = frames * SCAN_S
    scene = SCENES[state](seconds, seed, electrode)
    running = Session(sheet, scene.script, seed, pipeline)
    moments = list(running.run(seconds))
    running.close()
    return scored(moments, scene, None if state == "ok" else electrode)


def scored(moments: Sequence[Moment], scene: RandomScene, electrode: int | None) -> AvailabilityScore:
    since = FAILS_S + NAMED_S if electrode is not None else TARE_S
    counted = [m for m in moments if m.middle_s >= since]
    held = [p for p in scene.presses if p.begin > since]
    score = AvailabilityScore(
        frames=len(counted),
        valid=sum(m.valid for m in counted),
        named=sum(electrode is not None and m.electrodes[electrode] != 0 for m in counted),
        wrong=sum(bool(m.phantoms()) for m in counted),
        touches=len(held),
        reported=sum(_reported(p, counted) for p in held),
    )
    changing = np.array([m.middle_s for m in counted if m.changing])
    for at in sorted({t for p in held for t in (p.begin, p.end - RAMP_S)}):
        score.changing.append(int(((changing >= at) & (changing < at + WINDOW_S)).sum()))
    return score


def _reported(press: TimedPress, moments: Sequence[Moment]) -> bool:
    """Whether most frames of the time in which it presses fully are valid and have all that touches."""
    there = [m for m in moments if press.begin + RAMP_S <= m.middle_s <= press.end - RAMP_S]
    return sum(m.valid and not m.unseen() for m in there) > len(there) / 2


def _ok(seconds: float, seed: int, electrode: int) -> RandomScene:
    return random_scene(seconds, seed, faults=False)


def _open(seconds: float, seed: int, electrode: int) -> RandomScene:
    cue = Cue(FAILS_S, "electrode_open", {"electrode": electrode}, seconds)
    return random_scene(seconds, seed, faults=False, cues=(cue,))


def _dead(seconds: float, seed: int, electrode: int) -> RandomScene:
    curve = PiecewiseLinear((0.0, FAILS_S - 1e-3, FAILS_S), (1.0, 1.0, DEAD))
    return random_scene(seconds, seed, faults=False, contact=((electrode, curve),))


def _drifting(seconds: float, seed: int, electrode: int) -> RandomScene:
    turns = np.arange(FAILS_S, seconds + DRIFT_S, DRIFT_S / 2)
    values = [DRIFTS if k % 2 else 1.0 for k in range(len(turns))]
    curve = PiecewiseLinear((0.0, *map(float, turns)), (1.0, *values))
    return random_scene(seconds, seed, faults=False, contact=((electrode, curve),))


SCENES: dict[str, Callable[[float, int, int], RandomScene]] = dict(
    zip(STATES, (_ok, _open, _dead, _drifting), strict=True)
)
