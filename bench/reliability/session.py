"""A skin in simulated time: stub board, line, link, clock and the services' stages. Each frame's contacts stand beside
the true touches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.reliability.scenes import SolvedSheet
from bench.tracking.host import Felt, Host
from firmware_stub.rig import Rig
from firmware_stub.timeline import Script, Timeline
from firmware_stub.world import World
from models.bundle import Bundle
from protocol.frames import ContactFrame, DeltaFrame
from services.pipeline import Pipeline
from services.runtime.config import Skin

FLOOR_N = 0.05  # no touch is shown from less on, whatever its radius: skin bench trust --floor
FAR_M = 0.015  # from every true touch: a contact is wrong


@dataclass(frozen=True)
class PointForce:
    x: float  # m
    y: float
    newtons: float | None


@dataclass(frozen=True)
class Moment:
    """One contact frame. truth: the touches that were there when its oldest value was measured, or at the middle of its
    scan (or newest part).
    """

    read_s: float
    middle_s: float
    valid: bool
    reasons: tuple[str, ...]
    electrodes: tuple[int, ...]  # ELECTRODE_STATES
    contacts: tuple[PointForce, ...]  # those that did not end
    truth: tuple[PointForce, ...]
    pressed: tuple[PointForce, ...]  # those of the truth that were there all the time until the middle

    @property
    def changing(self) -> bool:
        return "changing" in self.reasons

    def phantoms(self, far_m: float = FAR_M) -> tuple[PointForce, ...]:
        """Contacts of a valid frame that no true touch is near."""
        return tuple(c for c in self.contacts if _nearest(c, self.truth) > far_m) if self.valid else ()

    def unseen(self, far_m: float = FAR_M) -> tuple[PointForce, ...]:
        """Touches that press and have no contact near them; what presses by less than the skin's floor has ended."""
        pressing = (t for t in self.pressed if t.newtons is None or t.newtons > FLOOR_N)
        return tuple(t for t in pressing if _nearest(t, self.contacts) > far_m)


def _nearest(one: PointForce, others: tuple[PointForce, ...]) -> float:
    return min((float(np.hypot(one.x - o.x, one.y - o.y)) for o in others), default=np.inf)


def moment(read_s: float, middle_s: float, felt: Felt | None, delta: DeltaFrame, contact: ContactFrame) -> Moment:
    """felt None: nothing touches."""
    first = _touches(felt.first) if felt else ()
    middle = _touches(felt.world) if felt else ()
    return Moment(
        read_s,
        middle_s,
        contact.valid,
        tuple(contact.reasons),
        tuple(delta.electrodes.tolist()),
        tuple(PointForce(c.position[0], c.position[1], c.force_n) for c in contact.contacts if c.state != "end"),
        (*middle, *first),
        middle if first else (),
    )


def _touches(world: World) -> tuple[PointForce, ...]:
    return tuple(PointForce(t.x, t.y, t.force_n) for t in world.touches if t.drop > 0)


class Session:
    """One skin, from a board that was just plugged in and services that just started, without any kept state."""

    def __init__(
        self,
        sheet: SolvedSheet,
        script: Script,
        seed: int,
        pipeline: Pipeline | None = None,
        snr_db: float = 80.0,
    ) -> None:
        self.rig = Rig(sheet, snr_db=snr_db, seed=seed)
        self.rig.field.play(Timeline(script, 0.0, (), sheet.electrodes), 0.0)
        self.pipeline = pipeline or new_pipeline()
        self.pipeline.reset()
        self.problems: list[tuple[float, str]] = []  # what acquisition said of the board, and since when
        self.host = Host(self.rig, seed, self.pipeline.pre.config, self.pipeline.pre.bundle)

    def run(self, until_s: float) -> Iterator[Moment]:
        """The contact frames up to that time."""
        while self.host.now < until_s:
            frames = list(self.host.step())
            if self.host.problem != (self.problems[-1][1] if self.problems else ""):
                self.problems.append((self.host.now, self.host.problem))
            for raw, felt in frames:
                contact, delta = self.pipeline.step(raw), self.pipeline.delta
                if contact is not None and delta is not None:
                    yield moment(self.host.now, felt.middle, felt, delta, contact)

    def close(self) -> None:
        self.rig.close()


def new_pipeline(bundle: str = "square16", **settings: object) -> Pipeline:
    """Of whole scans, where `scan` is not among the settings."""
    loaded = Bundle.load(bundle)
    skin = Skin.model_validate({"port": "stub", "bundle": bundle, "frame_id": "palm", "scan": "full", **settings})
    return Pipeline(skin, name="palm", bundle=loaded)
