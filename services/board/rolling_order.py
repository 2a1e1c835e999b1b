"""Scans in parts at run time: their order for a bundle."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from models import rolling
from models.bundle import Bundle


def parts_of(bundle: Bundle) -> int:
    """Into how many parts this bundle's scan is cut."""
    return rolling.most_parts(len(bundle.pattern), int(bundle.pattern.max()) + 1)


@lru_cache(maxsize=8)
def rolling_order(bundle: Bundle) -> NDArray[np.integer]:
    """(K,) the order of a bundle's scan in parts: the same in every process."""
    return rolling.order(bundle.matrices, bundle.pattern, parts_of(bundle), bundle.half_width)
