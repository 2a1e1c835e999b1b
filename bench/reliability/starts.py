"""Starts under a touch: what the service says while it stays, and how soon all is well once it is lifted.

Three ways to start: cold (nothing is kept), lost (preprocessing begins anew without what it kept, the other processes
go on), aged (a baseline of the free skin was kept AGE_S ago, and the skin has drifted since).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.reliability.counts import Counts
from bench.reliability.direct import DirectSkin
from bench.reliability.scenes import SolvedSheet, circle, contacts_at_random
from firmware_stub.world import World
from services.pipeline import Pipeline

STATES = ("cold", "lost", "aged")
PRESSES = ((1.0, 0.1), (1.0, 0.2), (3.0, 0.1), (3.0, 0.2), (5.0, 0.1), (5.0, 0.2), (0.5, 0.2))  # N, model units
IMPEDANCES = 0.3  # contact impedances differ by so much from what the bundle assumes
AGE_S = 3000.0
AGED_SCALE, AGED_CONTACT = 0.005, 0.02  # at most, since then: a room that warmed, electrodes that settled
REST, TOUCHED = 80, 110  # full scans: more than a tare needs
FREE_WITHIN, FREE_FOR = 96, 10  # valid and empty within so many, and for so many in a row
FREE = FREE_WITHIN + 2 * FREE_FOR


@dataclass
class StartScore(Counts):
    """The score of one start, or of several (`add`)."""

    starts: int = 0
    touched: int = 0  # frames while the touch stays
    touched_valid: int = 0
    without: int = 0  # valid ones without the contact
    phantoms: int = 0  # valid ones with a contact where nothing touches
    started_wrong: int = 0  # starts with one or the other
    late: int = 0  # starts that were not free in time
    free_scans: list[float] = field(default_factory=list)
    free_phantoms: int = 0  # valid frames with a contact after the touch was lifted
    reasons: Counter[str] = field(default_factory=Counter)

    def row(self) -> dict[str, Any]:
        return {
            "starts": self.starts,
            "without": self.without,
            "phantoms": self.phantoms + self.free_phantoms,
            "started_wrong": self.started_wrong,
            "invalid_%": 100 * (1 - self.touched_valid / max(self.touched, 1)),
            "late": self.late,
            "free_median": float(np.median(self.free_scans)) if self.free_scans else None,
            "free_most": max(self.free_scans, default=None),
            "reasons": dict(self.reasons.most_common(3)),
        }


def start(
    sheet: SolvedSheet,
    pipeline: Pipeline,
    state: str,
    place: tuple[float, float],
    newtons: float,
    radius: float,
    seed: int,
) -> StartScore:
    rng = np.random.default_rng([seed, 3])
    contact = contacts_at_random(rng, IMPEDANCES)
    touch = circle(*place, newtons, radius)
    free, pressed = World((), 1.0, contact), World((touch,), 1.0, contact)
    skin = DirectSkin(sheet, pipeline, seed)
    if state == "lost":
        skin.rest(free, REST)
        skin.rest(pressed, 20)
        pipeline.pre.reset()
    elif state == "aged":
        skin.rest(free, REST)
        saved = pipeline.pre.saved()
        pipeline.reset()
        if saved is not None:
            pipeline.pre.restore(saved, AGE_S)
        background = float(1 + rng.uniform(-AGED_SCALE, AGED_SCALE))
        contact = tuple(c * float(1 + rng.uniform(-AGED_CONTACT, AGED_CONTACT)) for c in contact)
        free, pressed = World((), background, contact), World((touch,), background, contact)
    touched, after = skin.rest(pressed, TOUCHED), skin.rest(free, FREE)
    scans = _free_after([m.valid and not m.contacts for m in after])
    without = sum(m.valid and bool(m.unseen()) for m in touched)
    phantoms = sum(bool(m.phantoms()) for m in touched)
    return StartScore(
        starts=1,
        touched=len(touched),
        touched_valid=sum(m.valid for m in touched),
        without=without,
        phantoms=phantoms,
        started_wrong=int(without + phantoms > 0),
        late=int(scans > FREE_WITHIN),
        free_scans=[scans],
        free_phantoms=sum(bool(m.phantoms()) for m in after),
        reasons=Counter(reason for m in touched if not m.valid for reason in m.reasons),
    )


def _free_after(free: list[bool]) -> float:
    """Scans until the first of FREE_FOR in a row; infinite where there are none."""
    run = 0
    for k, one in enumerate(free):
        run = run + 1 if one else 0
        if run == FREE_FOR:
            return k + 2 - FREE_FOR
    return float("inf")
