"""Touches on a skin that drifted since its tare: rows alone (`skin reconstruct`), and with the drift's history.

Rows alone: 64 untouched frames, then single touched ones with nothing in between; the stages know no more than that
some minutes have passed. With history: the skin drifts over DRIFT_S while nothing touches, then it is touched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.reliability.direct import SNR_DB, DirectSkin
from bench.reliability.scenes import METRES, SolvedSheet, circle
from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from firmware_stub.world import Touch, World
from models import limits
from models.bundle import Bundle
from models.fisher import mean_floor
from models.prereconstruction import Drift
from models.pressure import FOAM, disc
from services.pipeline import Pipeline
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin

DROPS = (0.1, 0.3, 0.5)  # S/m, what 1, 3 and 5 N make with a tip of 10 mm radius, whatever the radius
RADII = (0.1, 0.2, 0.3)
TARE_ROWS, UNTOUCHED_ROWS = 64, 16  # before the drift; untouched ones after it
NEAR_M = 0.003  # 3 % of the side: found
FAR_M = 0.015  # a contact further from the touch is none of it
# Of a history: how long it drifts, which is the fastest that skin.toml allows for; full scans before, and of the touch.
DRIFT_S, SETTLE, LOOK = 150.0, 110, 8
STEPS = 8  # solved worlds of a drift, linear in between


@dataclass(frozen=True)
class Change:
    """What happened to the skin since its tare. scale: of the conductivity; contacts: how many impedances rose."""

    name: str
    scale: float = 0.0
    contact: float = 0.0
    contacts: int = 0

    @property
    def size(self) -> float:
        """The argument of `skin limits --drift`."""
        return max(abs(self.scale), self.contact)

    def world(self, touches: Sequence[Touch], electrodes: Sequence[int], share: float = 1.0) -> World:
        """electrodes: those that change where not all do, the first `contacts` of them."""
        factors = [1.0] * 16
        for electrode in electrodes[: self.contacts]:
            factors[electrode] += share * self.contact
        return World(tuple(touches), 1.0 + share * self.scale, tuple(factors) if self.contacts else ())


CHANGES = (
    Change("none"),
    *(Change(f"conductivity {100 * s:+.0f} %", scale=s) for s in (-0.03, -0.01, 0.01, 0.03)),
    Change("all contacts +10 %", contact=0.1, contacts=16),
    *(Change(f"{n} contact{'s' if n > 1 else ''} +10 %", contact=0.1, contacts=n) for n in (1, 2, 3, 4)),
)


@dataclass(frozen=True)
class TouchAnswer:
    """What was said of one touch; of a valid frame or row. error: relative, of the force; -1 where it has none."""

    newtons: float
    radius: float  # model units
    valid: bool
    found: bool  # a contact within NEAR_M
    error: float
    extra: int  # contacts further than FAR_M


def answer_of(touch: Touch, valid: bool, contacts: Sequence[tuple[float, float, float]]) -> TouchAnswer:
    """contacts: x, y [m], force [N] of each; none of them counts where the row is not valid."""
    off = [math.hypot(x - touch.x, y - touch.y) for x, y, _ in contacts] if valid else []
    nearest = int(np.argmin(off)) if off else -1
    newtons, near = touch.force_n, nearest >= 0 and off[nearest] <= FAR_M
    error = contacts[nearest][2] / newtons - 1 if near and math.isfinite(contacts[nearest][2]) else -1.0
    return TouchAnswer(
        newtons,
        touch.radius / METRES,
        valid,
        nearest >= 0 and off[nearest] <= NEAR_M,
        error,
        sum(o > FAR_M for o in off),
    )


def rows_alone(
    sheet: SolvedSheet,
    bundle: Bundle,
    change: Change,
    places: Sequence[tuple[float, float]],
    seed: int,
    radius: float,
    indenter: bool,
) -> tuple[list[TouchAnswer], int]:
    """Answers to touches of this radius, and how many untouched rows had a valid contact."""
    rng = np.random.default_rng([seed, 21])
    touches = [circle(*place, _newtons(drop, radius), radius) for place in places for drop in DROPS]
    worlds = [change.world([touch], rng.permutation(16).tolist()) for touch in touches]
    worlds += [change.world([], rng.permutation(16).tolist()) for _ in range(0 if indenter else UNTOUCHED_ROWS)]
    pattern = np.asarray(bundle.pattern, np.int64)
    analog = Analog(BoardNoise.of_db(SNR_DB), Faults(), rng)
    settings: dict[str, Any] = {"indenter": {"radius_m": radius * METRES}} if indenter else {}
    skin = Skin.model_validate({"port": "stub", "bundle": str(bundle.path), "frame_id": "palm", **settings})

    def measured(world: World) -> np.ndarray:
        transfer = sheet.transfer(world)
        return np.abs(analog.measure((transfer, transfer), pattern, skin.setting, skin.rtia_ohm, 0.0)[0])

    untouched = np.array([measured(World()) for _ in range(TARE_ROWS)], float)
    rows = np.array([measured(world) for world in worlds], float)
    out = reconstruct(Input(rows, untouched, None), skin, bundle)
    found = []
    for k, touch in enumerate(touches):
        count = int(out["count"][k])
        seen = [(*out["position"][k, n], out["force"][k, n]) for n in range(min(count, out["position"].shape[1]))]
        found.append(answer_of(touch, bool(out["valid"][k]), seen))
    alarms = (out["count"] > 0) & out["valid"]
    return found, int(alarms[len(touches) :].sum())


def with_history(
    sheet: SolvedSheet, pipeline: Pipeline, change: Change, touch: Touch, seed: int
) -> tuple[TouchAnswer, int]:
    """The answer of the touch's last frame, and how many valid frames before it had a contact."""
    electrodes = np.random.default_rng([seed, 22]).permutation(16).tolist()
    skin = DirectSkin(sheet, pipeline, seed)
    moments = skin.rest(World(), SETTLE)
    drifting = round(DRIFT_S / 0.0436)
    solved = [sheet.transfer(change.world([], electrodes, k / STEPS)) for k in range(STEPS + 1)]
    for k in range(drifting):
        at = (k + 1) / drifting * STEPS
        low = min(int(at), STEPS - 1)
        moments += skin.see(solved[low] + (at - low) * (solved[low + 1] - solved[low]))
    moments += skin.rest(change.world([], electrodes), 2)
    last = skin.rest(change.world([touch], electrodes), LOOK)[-1]
    seen = [(c.x, c.y, math.nan if c.newtons is None else c.newtons) for c in last.contacts]
    return answer_of(touch, last.valid, seen), sum(m.valid and bool(m.contacts) for m in moments)


def row(answers: Sequence[TouchAnswer], alarms: int, floor_percent: float | None = None) -> dict[str, Any]:
    """Figures of a change. floor_percent: of the peak drop, root mean square over the same touches."""
    error = 100 * np.abs([a.error for a in answers])
    middle = [e for e, a in zip(error, answers, strict=True) if a.radius > 0.15]
    known = np.array([e for e, a in zip(error, answers, strict=True) if a.error > -1])
    rms = float(np.sqrt((known**2).mean())) if len(known) else None
    return {
        "touches": len(answers),
        "found_%": 100 * float(np.mean([a.found for a in answers])),
        "force_%": float(np.median(error)),
        "force_large_%": float(np.median(middle)) if middle else None,
        "force_rms_%": rms,
        "floor_%": floor_percent,
        "of_floor": rms / floor_percent if rms is not None and floor_percent else None,
        "extra": sum(a.extra for a in answers),
        "alarms": alarms,
        "invalid_%": 100 * (1 - float(np.mean([a.valid for a in answers]))),
    }


def floor_percent(change: Change, per_side: int, radii: Sequence[float] = RADII) -> float:
    """What `skin limits --snr 80 --drift SIZE --radius R` prints as the Bayesian floor of the force, root mean square
    over the touches of the table.
    """
    size = change.size
    case = limits.Case("square16", None, limits.MeasurementNoise(SNR_DB), drift=Drift(size, size))
    floors = [
        mean_floor(limits.map_floors(case, radius, drop, per_side)[1]["bayes"]).force
        for radius in radii
        for drop in DROPS
    ]
    return 100 * float(np.sqrt(np.mean(np.square(floors))))


def _newtons(drop: float, radius: float) -> float:
    """Force of a disc of this drop [S/m]; radius in model units."""
    return FOAM.force("circle", drop, disc(radius * METRES))
