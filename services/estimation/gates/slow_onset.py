"""What came so slowly that the filter took it for drift: the skin by now, held against the skin of a while ago.

A finger that presses within twenty seconds changes each scan by less than contact impedances do. What they, the sheet's
field and what foam remembers cannot have become since then is a touch, and the filter goes back to what it knew.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field

from services.estimation.filter import FilterState, SkinFilter
from services.estimation.values import numbers as n


@dataclass
class SlowState:
    """All that changes."""

    kept: list[FilterState] = field(default_factory=list)  # oldest first
    looked_s: float = 0.0  # when it was asked last


class SlowOnsetTest:
    """Of one skin, while nothing touches: holds scans against the filter as it was some seconds ago, a fixed lag."""

    def __init__(self, drift: SkinFilter) -> None:
        self._drift = drift
        self.now = SlowState()

    def forget(self) -> None:
        """Something touches: what was before tells nothing of what drifts."""
        self.now = SlowState()

    def keep(self) -> None:
        """The filter has learnt from an untouched scan."""
        kept, filtered = self.now.kept, self._drift.now
        if kept and 0 <= filtered.at_s - kept[-1].at_s < n.SLOW_S / 2:
            return
        kept.append(deepcopy(filtered))
        while len(kept) > 1 and filtered.at_s - kept[1].at_s >= n.SLOW_S:
            del kept[0]

    def due(self, at_s: float) -> SkinFilter | None:
        """The filter as it was, when it is time to look."""
        now = self.now
        if not now.kept or at_s - now.kept[0].at_s < n.SLOW_S or 0 <= at_s - now.looked_s < n.SLOW_EVERY_S:
            return None
        now.looked_s = at_s
        return self._drift.as_it_was(now.kept[0])
