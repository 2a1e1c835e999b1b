"""What scans held that nothing explained. Something may have pressed then, and foam remembers it as it remembers a
touch that was followed: by linear viscoelasticity, as the mean of all that pressed, weighted by how lately it did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from services.estimation.filter import Memory
from services.estimation.values import numbers as n

Array = NDArray[np.float64]


@dataclass
class RefusedState:
    """All that changes."""

    column: Annotated[Array, "K"]  # change of |Z|, relative
    seconds: float = 0.0


class UnexplainedLoad:
    """Of one skin."""

    def __init__(self, measurements: int) -> None:
        self.now = RefusedState(np.zeros(measurements))

    def refuse(self, y: Array, seconds: float) -> None:
        """A whole scan that nothing explains; y (K,): log |Z| over what is predicted of the untouched skin."""
        change = np.clip(np.expm1(y), -n.REFUSED_MOST, n.REFUSED_MOST)
        self.now.column += (1 - np.exp(-seconds / n.MEMORY_FADES_S[0])) * (change - self.now.column)
        self.now.seconds += seconds

    def explained(self, at_s: float) -> list[Memory]:
        """Scans are explained from at_s on: what whatever pressed before may have left. What was short was followed."""
        column, seconds = self.now.column, self.now.seconds
        if not seconds:
            return []
        self.now = RefusedState(np.zeros(len(column)))
        return [Memory(column, 1.0, at_s, 0.0, 0.0, 0.0, mixed=True)] if seconds > n.CHANGING_S else []
