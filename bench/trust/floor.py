"""The skin's own floor: the smallest force by radius that is shown, and from which force on its sigma is small."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bench.trust import candidate, runs
from bench.trust.scene import BEGIN_S, TARE_S, TrustScene
from bench.trust.session import PlayedSession, SessionPlan
from firmware_stub import scene as scenes
from firmware_stub.timeline import Script, TouchPath
from firmware_stub.worlds import table
from models.bundle import Bundle
from protocol.frames import ContactFrame

RADII_M = (0.004, 0.006, 0.01, 0.017, 0.025)
FORCES_N = tuple(float(f) for f in np.geomspace(0.03, 4.0, 13))
PLACES_M = ((0.0, 0.0), (0.024, 0.0), (0.018, -0.02))
HELD_S, RAMP_S, PAUSE_S = 0.8, 0.05, 0.4
SETTLED_S = 0.15  # after which a touch is to be shown
SHOWN, SURE = 0.999, 0.25  # share of frames; of the force, its sigma
NEAR_M = 0.015


@dataclass(frozen=True)
class LadderStep:
    radius: float
    force: float
    x: float
    y: float
    begin: float  # from when on it presses fully and is to be shown [s]
    end: float


def ladder() -> tuple[TrustScene, list[LadderStep]]:
    """Every radius at every place under every force that it can bear, one after the other."""
    steps, tracks, t = list[LadderStep](), list[TouchPath](), BEGIN_S
    for radius in RADII_M:
        for x, y in PLACES_M:
            for force in FORCES_N:
                try:
                    touch = scenes.touch({"x": x, "y": y, "radius": radius, "force": force})
                except ValueError:  # more than this patch can bear
                    continue
                none, end = replace(touch, drop=0.0), t + HELD_S
                tracks.append(TouchPath((t, t + RAMP_S, end - RAMP_S, end), (none, touch, touch, none)))
                steps.append(LadderStep(radius, force, x, y, t + RAMP_S + SETTLED_S, end - RAMP_S - 0.03))
                t = end + PAUSE_S
    return TrustScene(t, Script("floor", tracks=tuple(tracks)), (), (TARE_S,)), steps


def measured(scan: str, seed: int, bundle: str = "square16") -> dict[float, dict[str, Any]]:
    """By radius [m]: `shown_n`, `sure_n`, the smallest forces from which on all are; None where none is."""
    what, steps = ladder()
    skin, loaded = runs.skin_of(scan, bundle), Bundle.load(bundle)
    plan = SessionPlan("plain", seed, what.seconds)
    session = PlayedSession(plan, table.sheet("plain", seed), skin, loaded, what)
    frames: dict[LadderStep, list[ContactFrame]] = defaultdict(list)
    at = 0
    for _, frame in session.contacts({"today": candidate.Today(skin, loaded)}):
        t = frame.stamps["sample"] * 1e-9
        while at < len(steps) and steps[at].end < t:
            at += 1
        if at < len(steps) and steps[at].begin <= t:
            frames[steps[at]].append(frame)
    session.rig.close()
    return floors(frames)


def floors(frames: Mapping[LadderStep, list[ContactFrame]]) -> dict[float, dict[str, Any]]:
    """By radius: from the frames of each step, those of all its places together."""
    found: dict[float, dict[str, Any]] = {}
    for radius in sorted({step.radius for step in frames}):
        shown: dict[float, list[bool]] = defaultdict(list)
        sure: dict[float, list[bool]] = defaultdict(list)
        for step, said in frames.items():
            if step.radius == radius:
                for frame in said:
                    one, small = _said(step, frame)
                    shown[step.force].append(one)
                    sure[step.force].append(small)
        found[radius] = {"shown_n": _from_where(shown, SHOWN), "sure_n": _from_where(sure, 0.5)}
    return found


def _said(step: LadderStep, frame: ContactFrame) -> tuple[bool, bool]:
    """Whether a valid frame shows the touch, and whether its force is surer than a quarter."""
    near = [
        c
        for c in frame.contacts
        if c.state != "end" and np.hypot(c.on_sheet[0] - step.x, c.on_sheet[1] - step.y) <= NEAR_M
    ]
    if not frame.valid or not near:
        return False, False
    force, sigma = near[0].force_n, near[0].force_sigma_n
    return True, force is not None and sigma is not None and sigma < SURE * force


def _from_where(share: Mapping[float, list[bool]], least: float) -> float | None:
    """The smallest force from which on at least so large a share of the frames does."""
    found = None
    for force in sorted(share, reverse=True):
        if np.mean(share[force]) < least:
            break
        found = force
    return found
