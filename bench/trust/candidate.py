"""What can be judged: raw frames in, contact frames out. The service's own stages are one such thing."""

from __future__ import annotations

import os
import time
from typing import Protocol

from models.bundle import Bundle
from protocol.frames import ContactFrame, RawFrame
from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.stage import Refused

FIT_S = 300.0  # a fit of the mounting takes seconds


class Candidate(Protocol):
    """Made with a configured skin and its bundle; used for one session after the other."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None: ...

    def reset(self) -> None:
        """A session begins: nothing is known."""

    def step(self, raw: RawFrame) -> ContactFrame | None:
        """What the service would publish of it; None: nothing."""

    def tare(self) -> None:
        """A person says that nothing touches, whether that is so or not; a fit that this begins is waited for."""

    @property
    def refused(self) -> bool:
        """Whether the image on which the last contact frame stands is not valid; False where it stands on none."""


class Today:
    """The stages that the services run."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        self._skin, self._bundle = skin, bundle
        self.reset()

    def reset(self) -> None:
        self.stages = Pipeline(self._skin, f"palm-{os.getpid()}", self._bundle)  # others keep what theirs found
        self.stages.pre.warm_up()
        self._said: ContactFrame | None = None

    def step(self, raw: RawFrame) -> ContactFrame | None:
        self.stages.prepare()
        self._said = self.stages.step(raw)
        return self._said

    def tare(self) -> None:
        try:
            self.stages.pre.command("tare", {})
        except Refused:  # something touches, or too few frames agree
            return
        waited = time.monotonic() + FIT_S
        while self.stages.pre.linearisation.busy and time.monotonic() < waited:
            self.stages.prepare()
            time.sleep(0.02)

    @property
    def refused(self) -> bool:
        image, said = self.stages.image, self._said
        return image is not None and said is not None and image.scan == said.scan and not image.valid
