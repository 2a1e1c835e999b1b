"""A gain that jumps and stays: false contacts, and how soon frames are valid and right again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.reliability.counts import Counts
from bench.reliability.direct import DirectSkin
from bench.reliability.scenes import SolvedSheet, circle, touches_at_random
from bench.reliability.session import Moment
from firmware_stub.world import Touch, World
from services.pipeline import Pipeline

STEPS = (0.001, 0.002, 0.005, 0.006, 0.01, 0.02, 0.05)
GAINS = tuple(sign * step for step in STEPS for sign in (1, -1))
SITUATIONS = ("untouched", "held")
REST, HELD = 110, 25  # full scans before the step; those that the touch is held before it
LASTS, AFTER = 230, 60  # 10 s of the gain, and what follows
AGAIN_S = 2.0
WELL_FRAMES = 5


def places(count: int, seed: int) -> list[Touch]:
    """The first is one whose image a small gain splits most."""
    return [circle(0.01, 0.01, 3.0, 0.2), *touches_at_random(count - 1, seed)]


@dataclass
class GainStepScore(Counts):
    steps: int = 0
    frames: int = 0  # while the gain lasts
    valid: int = 0
    false: int = 0  # valid frames with a contact where nothing touches
    unseen: int = 0  # valid frames without the touch that is held
    again_s: list[float] = field(default_factory=list)
    late: int = 0  # beginnings and ends of a step after which frames were not right within AGAIN_S
    ended_false: int = 0  # false ones after its end
    ended_s: list[float] = field(default_factory=list)

    def row(self) -> dict[str, Any]:
        return {
            "steps": self.steps,
            "false": self.false,
            "ended_false": self.ended_false,
            "unseen": self.unseen,
            "again_median_s": float(np.median(self.again_s)) if self.again_s else None,
            "again_most_s": max(self.again_s, default=None),
            "late": self.late,
            "ended_most_s": max(self.ended_s, default=None),
            "invalid_%": 100 * (1 - self.valid / max(self.frames, 1)),
        }


def step(sheet: SolvedSheet, pipeline: Pipeline, gain: float, situation: str, touch: Touch, seed: int) -> GainStepScore:
    """gain: relative change."""
    free = World()
    world = World((touch,)) if situation == "held" else free
    skin = DirectSkin(sheet, pipeline, seed)
    skin.rest(free, REST)
    skin.rest(world, HELD)
    skin.faults.inject("gain", {"factor": 1 + gain}, skin.now_s, 1e9)
    began_s = skin.now_s
    during = skin.rest(world, LASTS)
    skin.faults.clear("gain")
    ended_s = skin.now_s
    after = skin.rest(world, AFTER)
    again, ended = right_again(during, began_s), right_again(after, ended_s)
    return GainStepScore(
        steps=1,
        frames=len(during),
        valid=sum(m.valid for m in during),
        false=sum(bool(m.phantoms()) for m in during),
        unseen=sum(m.valid and bool(m.unseen()) for m in during),
        again_s=[again],
        late=int(again > AGAIN_S) + int(ended > AGAIN_S),
        ended_false=sum(bool(m.phantoms()) for m in after),
        ended_s=[ended],
    )


def right_again(moments: Sequence[Moment], since_s: float) -> float:
    """Seconds until the first of WELL_FRAMES in a row that are valid and say what touches and nothing else."""
    run: list[float] = []
    for m in moments:
        run = [*run, m.read_s] if m.valid and not m.phantoms() and not m.unseen() else []
        if len(run) == WELL_FRAMES:
            return run[0] - since_s
    return float("inf")
