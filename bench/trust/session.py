"""One session played: the board's bytes through acquisition's own source, in simulated time, to some candidates."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from bench.tracking.host import Host
from bench.trust.candidate import Candidate
from bench.trust.judge import Judge
from bench.trust.scene import APART_M, SceneDrawer, TrustScene
from bench.trust.score import TrustScore
from bench.trust.truth import SceneTruth
from firmware_stub.board import MeasuredScan
from firmware_stub.rig import Rig
from firmware_stub.sheet import Sheet
from firmware_stub.truth import truth_frame
from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame, pack, unpack
from services.recordings import settings
from services.recordings.recording import RecordingWriter
from services.runtime.config import Skin


@dataclass(frozen=True)
class SessionPlan:
    """Everything that a session is drawn from."""

    world: str
    seed: int
    seconds: float
    apart_m: float = APART_M

    @property
    def name(self) -> str:
        return f"{self.world} {self.seed}"


class PlayedSession:
    """A scene on a skin of a world, with candidates that get the same raw frames."""

    def __init__(
        self, plan: SessionPlan, sheet: Sheet, skin: Skin, bundle: Bundle, scene: TrustScene | None = None
    ) -> None:
        """scene: what happens; None: what is drawn from the plan."""
        self.plan, self.sheet, self.skin = plan, sheet, skin
        self.rig = Rig(sheet, seed=plan.seed, world=plan.world)
        self.scene = scene or SceneDrawer(sheet, plan.seed, plan.seconds, plan.apart_m).draw()
        self.rig.field.play(self.rig.timeline(self.scene.script, 0.0), 0.0)
        self.host = Host(self.rig, plan.seed, skin, bundle)
        self.messages: list[tuple[str, float, bytes]] = []  # topic, when, what: all that a recording needs

    def raws(self) -> Iterator[RawFrame]:
        while self.host.now < self.plan.seconds:
            for raw, felt in self.host.step():
                packed = pack(raw)
                self._keep("raw/palm", packed)
                stamps = {"sample": round(felt.middle * 1e9), "publish": raw.stamps["read"]}
                scan = MeasuredScan(raw.scan, felt.start, felt.middle)
                self._keep("truth/palm", pack(truth_frame("palm", self.sheet, scan, felt.world, stamps)))
                yield raw

    def judged(self, candidates: Mapping[str, Candidate]) -> dict[str, TrustScore]:
        """The score of each."""
        truth, began = SceneTruth(self.scene, self.sheet), time.process_time()
        judges = {name: Judge(truth, self.plan.name) for name in candidates}
        for name, contact in self.contacts(candidates):
            judges[name].look(self.host.now, contact, candidates[name].refused)
        scores = {name: judge.finish() for name, judge in judges.items()}
        for score in scores.values():
            score.cpu_s = time.process_time() - began
        self.rig.close()
        return scores

    def contacts(self, candidates: Mapping[str, Candidate]) -> Iterator[tuple[str, ContactFrame]]:
        """What each says, frame by frame; `host.now` is when."""
        for candidate in candidates.values():
            candidate.reset()
        tares = list(self.scene.tares)
        for raw in self.raws():
            tared = bool(tares) and self.host.now >= tares[0]
            if tared:
                tares.pop(0)
            for name, candidate in candidates.items():
                if tared:
                    candidate.tare()
                contact = candidate.step(raw if len(candidates) == 1 else _copy(raw))
                if contact is not None:
                    yield name, contact

    def record(self, path: Path) -> None:
        """Keep the raw frames and the truth as a recording that replays."""
        path.parent.mkdir(parents=True, exist_ok=True)
        about = {settings.KEY: settings.text_of({"palm": self.skin})}
        with RecordingWriter(path, about, overwrite=True) as writer:
            for topic, at, packed in self.messages:
                writer.write(topic, packed.partition(b"\0")[2], round(at * 1e9))

    def _keep(self, topic: str, packed: bytes) -> None:
        self.messages.append((topic, self.host.now, packed))


def _copy(raw: RawFrame) -> RawFrame:
    """As it would reach another process."""
    frame = unpack(pack(raw))
    assert isinstance(frame, RawFrame)
    return frame
