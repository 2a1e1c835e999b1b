"""One session played: the board's bytes through acquisition's own source, in simulated time, to what is judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from bench.trust.judge import Judge
from bench.trust.scene import APART_M, TrustScene
from bench.trust.score import TrustScore
from bench.trust.stages import Judged
from firmware_stub.board import MeasuredScan
from firmware_stub.sheet import Sheet
from firmware_stub.truth import truth_frame
from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame, pack
from services.recordings import settings
from services.recordings.recording import RecordingWriter
from services.runtime.config import Skin
from simulation.host import LATE_S, Felt, SimulatedHost, as_received


@dataclass(frozen=True)
class SessionPlan:
    """Everything that a session is drawn from. plan, row: of bench/trust/plans.py; number: of the row's sessions."""

    world: str
    seed: int
    seconds: float
    apart_m: float = APART_M
    plan: str = "worlds"
    row: str = ""
    number: int = 0

    @property
    def name(self) -> str:
        return f"{self.row or self.world} {self.seed}"


class PlayedSession:
    """A scene on a skin of a world, to stages that get the same raw frames."""

    def __init__(
        self, plan: SessionPlan, scene: TrustScene, sheet: Sheet, skin: Skin, bundle: Bundle, keep: bool = False
    ) -> None:
        """keep: what `record` needs."""
        self.plan, self.scene, self.sheet, self.skin = plan, scene, sheet, skin
        self.host = SimulatedHost(
            snr_db=80.0,
            seed=plan.seed,
            sheet=sheet,
            world=plan.world,
            script=scene.script,
            skin=skin,
            bundle=bundle,
            late_s=LATE_S,
        )
        self._keep = keep
        self._messages: list[tuple[str, float, bytes]] = []  # topic, when, what

    def judged(self, stages: Mapping[str, Judged]) -> dict[str, TrustScore]:
        """The score of each."""
        judges = {name: Judge(self.scene, self.sheet, self.plan.name) for name in stages}
        for name, contact in self.contacts(stages):
            judges[name].look(self.host.now, contact, stages[name].refused)
        for name, judge in judges.items():
            for at, problem in self.host.problems:
                judge.heard(at, problem)
            judge.score.cpu_s = stages[name].cpu_s
        self.host.close()
        return {name: judge.finish() for name, judge in judges.items()}

    def contacts(self, stages: Mapping[str, Judged]) -> Iterator[tuple[str, ContactFrame]]:
        """What each says, frame by frame; `host.now` is when."""
        for each in stages.values():
            each.reset()
        acts = list(self.scene.acts)
        while self.host.now < self.plan.seconds:
            for raw, felt in self.host.acquired():
                self._note(raw, felt)
                while acts and self.host.now >= acts[0][0]:
                    _, act = acts.pop(0)
                    for each in stages.values():
                        each.act(act)
                for name, each in stages.items():
                    contact = each.step(raw if len(stages) == 1 else as_received(raw))
                    if contact is not None:
                        yield name, contact

    def record(self, path: Path) -> None:
        """Keep the raw frames and the truth as a recording that replays."""
        path.parent.mkdir(parents=True, exist_ok=True)
        about = {settings.KEY: settings.text_of({"palm": self.skin})}
        with RecordingWriter(path, about, overwrite=True) as writer:
            for topic, at, packed in self._messages:
                writer.write(topic, packed.partition(b"\0")[2], round(at * 1e9))

    def _note(self, raw: RawFrame, felt: Felt) -> None:
        if not self._keep:
            return
        stamps = {"sample": round(felt.middle * 1e9), "publish": raw.stamps["read"]}
        truth = truth_frame("palm", self.sheet, MeasuredScan(raw.scan, felt.start, felt.middle), felt.world, stamps)
        self._messages += [("raw/palm", self.host.now, pack(raw)), ("truth/palm", self.host.now, pack(truth))]
