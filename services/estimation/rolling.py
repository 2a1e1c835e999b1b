"""Scans in parts at run time: their order for a bundle, and which of their messages hold a whole scan of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models import rolling
from models.bundle import Bundle
from services.estimation.by_bundle import ByBundle

KEPT = 64  # orders, of a kilobyte each


def parts_of(bundle: Bundle) -> int:
    """Into how many parts this bundle's scan is cut."""
    return rolling.most_parts(len(bundle.pattern), int(bundle.pattern.max()) + 1)


def _order_of(bundle: Bundle) -> NDArray[np.integer]:
    return rolling.order(bundle.matrices, bundle.pattern, parts_of(bundle), bundle.half_width)


rolling_order = ByBundle(_order_of, KEPT)
"""(K,) the order of a bundle's scan in parts: the same in every process."""


def measured_at(bundle: Bundle, part: int) -> NDArray[np.float64]:
    """(K,) when each value of a message was measured, from 0, the oldest, to 1, the newest. part: the one measured
    last, from 1 on; 0: a whole scan in the pattern's order.
    """
    count = len(bundle.pattern)
    if not part:
        return np.linspace(0.0, 1.0, count)
    order = np.roll(rolling_order(bundle), -part * (count // parts_of(bundle)))
    at = np.empty(count)
    at[order] = np.linspace(0.0, 1.0, count)
    return at


class WholeScans:
    """Which messages of a scan in parts are taken as a whole scan: those that share no value with the one before."""

    def __init__(self) -> None:
        self.last = -1  # scan of the message last taken; -1: none

    def due(self, scan: int, parts: int) -> bool:
        """Whether a message is to be taken. A board that counts from 0 again begins anew."""
        if self.last < 0 or scan < self.last or scan - self.last >= parts:
            self.last = scan
            return True
        return False
