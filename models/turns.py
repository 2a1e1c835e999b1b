"""The eight symmetries of a square image, and of the points on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

Pixel = TypeVar("Pixel", bound=np.generic)


@dataclass(frozen=True)
class Turn:
    """x and y exchanged (if so), then y and x turned round (if so)."""

    transpose: bool
    flip_y: bool
    flip_x: bool

    def image(self, images: npt.NDArray[Pixel]) -> npt.NDArray[Pixel]:
        """Images (..., n, n), [iy, ix], as a view."""
        if self.transpose:
            images = np.swapaxes(images, -1, -2)
        if self.flip_y:
            images = images[..., ::-1, :]
        return images[..., ::-1] if self.flip_x else images

    def points(self, xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Points (n, 2) about the middle of the image."""
        moved = xy[:, ::-1] if self.transpose else xy
        return moved * [-1 if self.flip_x else 1, -1 if self.flip_y else 1]

    @property
    def back(self) -> Turn:
        """The turn that undoes this one."""
        first, second = (self.flip_x, self.flip_y) if self.transpose else (self.flip_y, self.flip_x)
        return Turn(self.transpose, first, second)


TURNS = tuple(Turn(bool(code & 4), bool(code & 2), bool(code & 1)) for code in range(8))
"""The first of them leaves everything where it is."""
