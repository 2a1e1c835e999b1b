"""What any response of touches offers: the physical one of a disc, or a map that was measured."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class TouchModel(Protocol):
    """Relative change of |Z| by a touch of unit action."""

    def __call__(self, x: float, y: float, log_radius: float) -> Array:
        """(K,)"""
        ...

    def with_slopes(self, x: float, y: float, log_radius: float) -> Array:
        """(4, K): response, and its slopes to x, y and log radius."""
        ...

    def directions(self, x: float, y: float, log_radius: float) -> Array:
        """(9, K): in which a touch differs from the mean one, see models/measurement/touch.py."""
        ...

    @property
    def discs(self) -> Array:
        """(A, 3) x, y, log radius: where something may touch."""
        ...
