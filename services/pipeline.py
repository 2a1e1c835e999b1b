"""The stages in one process, without sockets: what `skin reconstruct`, the benchmarks and tests run."""

from __future__ import annotations

import time
from typing import NamedTuple

from models.bundle import Bundle
from protocol.frames import ContactFrame, DeltaFrame, ImageFrame, RawFrame
from services.inference import Inference
from services.preprocessing import Preprocessing
from services.publishing import Publishing
from services.runtime.config import Skin

ALL = frozenset({"delta", "image", "contact"})


class Result(NamedTuple):
    delta: DeltaFrame
    image: ImageFrame
    contact: ContactFrame


def build_stages(name: str, skin: Skin, bundle: Bundle | None = None) -> tuple[Preprocessing, Inference, Publishing]:
    """The three stages of one skin. Raises models.bundle.BundleError."""
    bundle = bundle or Bundle.load(skin.bundle)
    return Preprocessing(name, skin, bundle), Inference(name, skin, bundle), Publishing(name, skin, bundle)


class Pipeline:
    """raw -> delta -> image -> contact, one frame at a time, by the very objects that the processes run."""

    def __init__(
        self, skin: Skin | str, name: str = "skin", bundle: Bundle | None = None, always_reconstruct: bool = False
    ):
        """skin: a configured one, or the name or path of a bundle. always_reconstruct: each frame by itself, an
        image of untouched ones too.
        """
        if isinstance(skin, str):
            skin = Skin(port="stub", bundle=skin, frame_id=name)
        self.name = name
        self.pre, self.inference, self.publishing = build_stages(name, skin, bundle)
        self.pre.always_reconstruct = self.inference.each_alone = self.publishing.each_alone = always_reconstruct

    def run(self, raw: RawFrame) -> Result:
        """What the processes would publish for one raw frame, which is a whole scan; stamps are filled in."""
        result = self.step(raw)
        assert result is not None, "a part of a scan: only `step` takes those"
        return result

    def step(self, raw: RawFrame) -> Result | None:
        """The same; None for a part of a scan that only preprocessing takes note of."""
        made = self.pre.process(raw, ALL)
        if not made:
            return None
        delta = made[0]
        delta.stamps[self.pre.stamp] = time.monotonic_ns()
        image = self.inference.process(delta, ALL)[0]
        image.stamps[self.inference.stamp] = time.monotonic_ns()
        contact = self.publishing.process(image, ALL)[0]
        contact.stamps[self.publishing.stamp] = time.monotonic_ns()
        assert isinstance(delta, DeltaFrame) and isinstance(image, ImageFrame) and isinstance(contact, ContactFrame)
        return Result(delta, image, contact)

    def prepare(self) -> None:
        """Do the work that the processes do while no frame waits."""
        for stage in (self.pre, self.inference, self.publishing):
            stage.between_frames()
            stage.prepare()

    def reset(self) -> None:
        """Forget baseline, touches and tracks."""
        for stage in (self.pre, self.inference, self.publishing):
            stage.reset()
