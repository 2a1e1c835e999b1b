"""Arrays of a saved state, checked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def shaped(values: Any, shape: tuple[int, ...], finite: bool = True) -> NDArray[np.float64]:
    """The array of a saved state, checked. Raises ValueError."""
    found = np.array(values, dtype=np.float64)
    if found.shape != shape or (finite and not np.isfinite(found).all()):
        raise ValueError(f"found an array of shape {found.shape}, expected {shape}, finite")
    return found
