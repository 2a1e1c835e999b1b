"""A held touch's image made surer by the skin's symmetries: a square seen in a mirror is the same square.

The network does not know that. So what it makes of the turned and mirrored input, turned back, is as good an answer of
its own, and their mean better than each. One of them is computed for each spare frame while a touch is held; when all
are there, the mean takes the image's place. No frame waits for it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.turns import Turn
from protocol.frames import DeltaFrame
from services.networks import Network, Pictures


class SymmetryMean:
    """Of one frame at a time."""

    def __init__(self, network: Network, turns: tuple[Turn, ...]) -> None:
        self._network, self._turns = network, turns
        self.forget()

    def forget(self) -> None:
        self._frame: DeltaFrame | None = None
        self._made: list[Pictures] = []

    def begin(self, frame: DeltaFrame, pictures: Pictures) -> None:
        """A frame and what the network made of it. Where electrodes are missing, the skin has no symmetry."""
        self.forget()
        if self._turns and np.isfinite(frame.sigma).all():
            self._frame, self._made = frame, [pictures]

    def step(self) -> Pictures | None:
        """Compute one more; the mean of all when it was the last."""
        if self._frame is None:
            return None
        turn = self._turns[len(self._made) - 1]
        frame = replace(self._frame, stack=np.ascontiguousarray(turn.image(self._frame.stack)))
        drop, sigma, classes = (turn.back.image(each) for each in self._network.run(frame))
        self._made.append((drop, sigma, classes))
        if len(self._made) <= len(self._turns):
            return None
        images, sigmas, shares = (
            np.asarray(np.mean(each, axis=0), np.float32) for each in zip(*self._made, strict=True)
        )
        self.forget()
        return images, sigmas, shares

    @property
    def busy(self) -> bool:
        return self._frame is not None
