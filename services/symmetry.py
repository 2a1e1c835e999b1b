"""A held touch's image made surer by the skin's symmetries: a square seen in a mirror is the same square.

The network does not know that. So what it makes of the turned and mirrored input, turned back, is as good an answer of
its own, and their mean better than each. One of them is computed for each spare frame while a touch is held; when all
are there, the mean takes the image's place. No frame waits for it.
"""

from __future__ import annotations

import numpy as np

from models.turns import Turn
from services.networks import Network, Pictures, Stack


class SymmetryMean:
    """Of one frame at a time."""

    def __init__(self, network: Network, turns: tuple[Turn, ...]) -> None:
        self._network, self._turns = network, turns
        self.forget()

    def forget(self) -> None:
        self._stack: Stack | None = None
        self._made: list[Pictures] = []

    def begin(self, stack: Stack, pictures: Pictures) -> None:
        """What the network read of a frame, and what it made of it."""
        self.forget()
        if self._turns:
            self._stack, self._made = stack, [pictures]

    def step(self) -> Pictures | None:
        """Compute one more; the mean of all when it was the last."""
        if self._stack is None:
            return None
        turn = self._turns[len(self._made) - 1]
        turned = self._stack._replace(images=np.ascontiguousarray(turn.image(self._stack.images)))
        drop, sigma, classes = (turn.back.image(each) for each in self._network.run(turned))
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
        return self._stack is not None
