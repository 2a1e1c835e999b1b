"""The stages in one process, without sockets: what `skin reconstruct`, the benchmarks and tests run."""

from __future__ import annotations

import time
from typing import NamedTuple

from models.bundle import Bundle
from protocol.frames import ContactFrame, DeltaFrame, Frame, ImageFrame, RawFrame
from services.estimation.values.estimate import Judgement
from services.inference import Inference
from services.preprocessing import Preprocessing
from services.publisher import Publishing
from services.runtime.config import Skin
from services.runtime.stage import Stage

ALL = frozenset({"delta", "part", "image", "contact"})


class Result(NamedTuple):
    delta: DeltaFrame
    image: ImageFrame
    contact: ContactFrame
    judgements: tuple[Judgement, ...] = ()


def build_stages(name: str, skin: Skin, bundle: Bundle | None = None) -> tuple[Preprocessing, Inference, Publishing]:
    """The three stages of one skin. Raises models.bundle.BundleError."""
    bundle = bundle or Bundle.load(skin.bundle)
    return Preprocessing(name, skin, bundle), Inference(name, skin, bundle), Publishing(name, skin, bundle)


class Pipeline:
    """raw -> delta -> image -> contact, one frame at a time, by the very objects that the processes run."""

    def __init__(
        self,
        skin: Skin | str,
        name: str = "skin",
        bundle: Bundle | None = None,
        always_reconstruct: bool = False,
        each_alone: bool = False,
    ):
        """skin: a configured one, or the name or path of a bundle. always_reconstruct: an image of
        untouched frames too. each_alone: frames do not follow each other.
        """
        if isinstance(skin, str):
            skin = Skin(port="stub", bundle=skin, frame_id=name)
        self.name = name
        self.delta: DeltaFrame | None = None  # the newest one; parts of scans come between two of them
        self.image: ImageFrame | None = None  # the newest one
        self.pre, self.inference, self.publishing = build_stages(name, skin, bundle)
        self.pre.always_reconstruct = always_reconstruct
        self.pre.each_alone = self.publishing.each_alone = each_alone

    def run(self, raw: RawFrame) -> Result:
        """What the processes would publish for one raw frame, which is a whole scan; stamps are filled in."""
        self.delta = self.image = None
        contact = self.step(raw)
        assert contact and self.delta and self.image, "a part of a scan: only `step` takes those"
        return Result(self.delta, self.image, contact, self.pre.judgements)

    def step(self, raw: RawFrame) -> ContactFrame | None:
        """The contacts alone; None for a part of a scan that only preprocessing takes note of."""
        made = self._passed(self.pre, raw)
        if not made:
            return None
        frame = made[0]
        if isinstance(frame, DeltaFrame):
            self.delta = frame
            (frame,) = self._passed(self.inference, frame)
            assert isinstance(frame, ImageFrame)
            self.image = frame
        (contact,) = self._passed(self.publishing, frame)
        assert isinstance(contact, ContactFrame)
        return contact

    @staticmethod
    def _passed(stage: Stage, frame: Frame) -> list[Frame]:
        """What a stage makes of a frame, stamped."""
        made = stage.everything(frame, ALL)
        for out in made:
            out.stamps[stage.stamp] = time.monotonic_ns()
        return made

    def prepare(self) -> None:
        """Do the work that the processes do while no frame waits."""
        for stage in (self.pre, self.inference, self.publishing):
            stage.between_frames()
            stage.prepare()

    def reset(self) -> None:
        """Forget baseline, touches and tracks."""
        for stage in (self.pre, self.inference, self.publishing):
            stage.reset()
