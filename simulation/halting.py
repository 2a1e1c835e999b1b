"""Stages of which one may stand still, as where its process is stopped."""

from __future__ import annotations

from models.bundle import Bundle
from protocol.frames import ContactFrame, DeltaFrame, Frame, ImageFrame, PartFrame, RawFrame
from services.pipeline import ALL, Pipeline
from services.runtime.config import Skin
from services.runtime.stage import Stage

STAGES = "Preprocessing", "Inference", "Publishing"


class HaltingPipeline(Pipeline):
    """`still`: the name of the stage that stands still, if any. As in protocol/sockets.py:StageReader the frame is read
    later whose stack or image a newer one holds, and no part of an image that was not.
    """

    def __init__(self, skin: Skin, name: str = "palm", bundle: Bundle | None = None) -> None:
        super().__init__(skin, name, bundle)
        self.still = ""
        self.names: dict[Stage, str] = dict(zip((self.pre, self.inference, self.publishing), STAGES, strict=True))
        self._seen = -1  # scan of the image that publisher read last
        self._holder: dict[str, DeltaFrame | ImageFrame] = {}  # that came last, by the stage that did not read it

    def run_all(self, raw: RawFrame) -> list[ContactFrame]:
        frames: list[Frame] = [raw]
        for stage in (self.pre, self.inference, self.publishing):
            frames = [made for frame in frames for made in self._made(stage, frame)]
        return [frame for frame in frames if isinstance(frame, ContactFrame)]

    def _made(self, stage: Stage, frame: Frame) -> list[Frame]:
        if stage is self.inference and isinstance(frame, PartFrame):
            return [frame]
        if isinstance(frame, PartFrame) and frame.after != self._seen:
            return []
        if self.names[stage] == self.still:
            if isinstance(frame, DeltaFrame | ImageFrame) and not frame.held:
                self._holder[self.names[stage]] = frame
            return []
        if isinstance(frame, ImageFrame):
            self._seen = frame.scan
        made = [*self._held(stage, frame), *stage.everything(frame, ALL)]
        if self.publishing.lacks:
            self.inference.joined("image")
        return made

    def _held(self, stage: Stage, frame: Frame) -> list[Frame]:
        """What the stage makes of the frame before that this one stands on, where that was not read."""
        waited = self._holder.pop(self.names[stage], None)
        if waited is None or not isinstance(frame, DeltaFrame | ImageFrame) or not frame.held:
            return []
        return stage.everything(waited, ALL) if waited.reconstructed == frame.reconstructed else []
