"""Scans in parts at run time: their order for a bundle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models import rolling
from models.bundle import Bundle
from models.measurement.tables import ByBundle

KEPT = 64  # orders, of a kilobyte each


def parts_of(bundle: Bundle) -> int:
    """Into how many parts this bundle's scan is cut."""
    return rolling.most_parts(len(bundle.pattern), int(bundle.pattern.max()) + 1)


def _order_of(bundle: Bundle) -> NDArray[np.integer]:
    return rolling.order(bundle.matrices, bundle.pattern, parts_of(bundle), bundle.half_width)


rolling_order = ByBundle(_order_of, KEPT)
"""(K,) the order of a bundle's scan in parts: the same in every process."""
