"""What sessions are of. Each plan has rows; a session of a row is drawn from its seed and number.

worlds     minutes of touches and faults on what real skins do, a row for each world
faults     every fault of the board while nothing touches, a touch is held, slides, begins
starts     stages that begin under a touch: cold, without what they kept, with a baseline that has aged
drift      a skin that drifts for minutes untouched, then three presses
tracking   the stub's scene of ten minutes: presses, slides, crossings, failing electrodes
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.trust.scene import BEGIN_S, TARE_S, SceneDrawer, Trouble, TrustScene
from bench.trust.session import SessionPlan
from firmware_stub import scene as scenes
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import TouchPath
from firmware_stub.world import Touch
from firmware_stub.worlds.table import WORLDS
from simulation.faults import ROWS, FaultRow, row_of
from simulation.scenes import RAMP_S, ContactCurves, disc, path_of, ramp, script, spread, step

TARED = ((TARE_S, "tare"),)
PLACES = 64  # after so many sessions the places come again

# faults: each situation has STRIDE_S, in it a touch presses from 0 on, and the fault lasts FAULT_S from FAULT_AT_S on
SITUATIONS = ("untouched", "held", "sliding", "begins")
STRIDE_S, FAULT_AT_S, FAULT_S, BEGINS_S, RELEASE_S = 8.0, 1.0, 1.5, 1.7, 5.5
SLIDE_M = 0.03

# starts
PRESSES = ((1.0, 0.005), (1.0, 0.01), (3.0, 0.005), (3.0, 0.01), (5.0, 0.005), (5.0, 0.01), (0.5, 0.01))  # N, m
IMPEDANCES = 0.3  # contact impedances differ by so much from what the bundle assumes
AGED_SCALE, AGED_CONTACT = 0.005, 0.02  # at most, since then: a room that warmed, electrodes that settled
STARTS_S, LIFTED_S, FREE_S = 5.0, 10.0, 4.2  # the touch is there, is lifted; all is well so long after that, at most

# drift
DRIFT_S = 150.0  # the fastest that skin.toml allows for
FORCES_N, PRESSED_S = (1.0, 3.0, 5.0), 2.0


@dataclass(frozen=True)
class Drifts:
    """What happened to the skin since its tare. scale: of the conductivity; contacts: how many impedances rose by a
    tenth.
    """

    name: str
    scale: float = 0.0
    contacts: int = 0


DRIFTS = (
    Drifts("none"),
    *(Drifts(f"conductivity {100 * s:+.0f} %", scale=s) for s in (-0.03, -0.01, 0.01, 0.03)),
    Drifts("all contacts +10 %", contacts=16),
    *(Drifts(f"{n} contact{'s' if n > 1 else ''} +10 %", contacts=n) for n in (1, 2, 3, 4)),
)


@dataclass(frozen=True)
class TrustPlan:
    """rows: their names. seconds: of a session. minutes: of each row, where none are asked for."""

    rows: tuple[str, ...]
    seconds: float
    minutes: float
    scene: Callable[[SessionPlan, Sheet], TrustScene]


def world_scene(plan: SessionPlan, sheet: Sheet) -> TrustScene:
    return SceneDrawer(sheet, plan.seed, plan.seconds, plan.apart_m).draw()


def fault_scene(plan: SessionPlan, sheet: Sheet) -> TrustScene:
    """One fault at one place, in each situation."""
    row, rng = row_of(plan.row), np.random.default_rng(plan.seed)
    cases = [
        fault_case(row, row.draw(rng), situation, _place(plan), BEGIN_S + n * STRIDE_S)
        for n, situation in enumerate(SITUATIONS)
    ]
    what = script(
        *(track for case in cases for track in case.script.tracks),
        cues=[cue for case in cases for cue in case.script.cues],
        contact=tuple(curve for case in cases for curve in case.script.contact),
    )
    return TrustScene(plan.seconds, what, tuple(trouble for case in cases for trouble in case.troubles), TARED)


def fault_case(row: FaultRow, args: dict[str, Any], situation: str, touch: Touch, base: float) -> TrustScene:
    """In one situation, from `base` on."""
    at, lasts = base + FAULT_AT_S, FAULT_S if row.fault != "power_cycle" else 0.1
    tracks, cues, contact = _pressing(situation, touch, base), row.cues(args, at, lasts), row.contact(args, at, lasts)
    trouble = Trouble(row.title, situation, at, at + lasts, row.names, FAULT_S, row.board, row.recovery_s)
    return TrustScene(base + STRIDE_S, script(*tracks, cues=cues, contact=contact), (trouble,), TARED)


def start_scene(plan: SessionPlan, sheet: Sheet) -> TrustScene:
    rng = np.random.default_rng([plan.seed, 3])
    place, (newtons, radius) = _place(plan), PRESSES[plan.number % len(PRESSES)]
    touch = disc(place.x, place.y, newtons, radius)
    factors = rng.uniform(1 - IMPEDANCES, 1 + IMPEDANCES, sheet.electrodes).tolist()
    contact: ContactCurves = tuple((k, ramp((0.0, v), (1.0, v))) for k, v in enumerate(factors))
    background, begins, since, acts = None, STARTS_S, STARTS_S, tuple[tuple[float, str], ...]()
    if plan.row == "cold":
        begins = since = 0.0
    elif plan.row == "lost":
        begins, acts = STARTS_S - 1.0, ((STARTS_S, "lose"),)
    else:
        scale = float(1 + rng.uniform(-AGED_SCALE, AGED_SCALE))
        background, acts = ramp((STARTS_S - 1e-3, 1.0), (STARTS_S, scale)), ((STARTS_S, "age"),)
        aged = rng.uniform(1 - AGED_CONTACT, 1 + AGED_CONTACT, sheet.electrodes).tolist()
        contact += tuple(step(k, v, STARTS_S) for k, v in enumerate(aged))
    what = script(path_of(touch, begins, LIFTED_S, 0.0), contact=contact, background=background)
    trouble = Trouble("start", plan.row, since, LIFTED_S, recovers_s=FREE_S)
    return TrustScene(plan.seconds, what, (trouble,), acts, since)


def drift_scene(plan: SessionPlan, sheet: Sheet) -> TrustScene:
    drift = next(each for each in DRIFTS if each.name == plan.row)
    electrodes = np.random.default_rng([plan.seed, 22]).permutation(sheet.electrodes).tolist()[: drift.contacts]
    end, place = BEGIN_S + DRIFT_S, _place(plan)
    contact = tuple((k, ramp((BEGIN_S, 1.0), (end, 1.1))) for k in electrodes)
    tracks = []
    for n, newtons in enumerate(FORCES_N):
        begin = end + 1.0 + n * (PRESSED_S + 1.0)
        tracks.append(path_of(disc(place.x, place.y, newtons), begin, begin + PRESSED_S))
    what = script(*tracks, contact=contact, background=ramp((BEGIN_S, 1.0), (end, 1.0 + drift.scale)))
    return TrustScene(plan.seconds, what, (), TARED)


def tracking_scene(plan: SessionPlan, sheet: Sheet) -> TrustScene:
    """The same each time; its seed is the noise's."""
    what = scenes.load(plan.row)
    known = {row.fault: row for row in reversed(ROWS)}
    troubles = tuple(
        Trouble(cue.name, "scene", cue.t, cue.t + cue.seconds, row.names, cue.seconds, row.board)
        for cue in what.cues
        if (row := known.get(cue.name)) is not None
    )
    return TrustScene(plan.seconds, replace(what, loop=False), troubles)


PLANS: Mapping[str, TrustPlan] = {
    "worlds": TrustPlan(tuple(WORLDS), 60.0, 10.0, world_scene),
    "faults": TrustPlan(tuple(row.title for row in ROWS), BEGIN_S + 4 * STRIDE_S, 1.0, fault_scene),
    "starts": TrustPlan(("cold", "lost", "aged"), LIFTED_S + 2 * FREE_S, 3.0, start_scene),
    "drift": TrustPlan(tuple(each.name for each in DRIFTS), BEGIN_S + DRIFT_S + 10.0, 5.5, drift_scene),
    "tracking": TrustPlan(("ten_minutes",), 600.0, 10.0, tracking_scene),
}


def _place(plan: SessionPlan) -> Touch:
    return spread(PLACES, 5)[plan.number % PLACES]


def _pressing(situation: str, touch: Touch, base: float) -> list[TouchPath]:
    """What touches: not, all the time, on its way, or from the middle of the fault on."""
    if situation == "untouched":
        return []
    if situation == "begins":
        return [path_of(touch, base + BEGINS_S, base + RELEASE_S, RAMP_S)]
    away = math.copysign(SLIDE_M, -touch.x if touch.x else 1.0)
    to = (touch.x + away, touch.y) if situation == "sliding" else None
    return [path_of(touch, base, base + RELEASE_S, RAMP_S, to)]
