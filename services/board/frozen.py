"""A board is frozen where it sends the same scan again and again, with new numbers and times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol import link

FROZEN = 3  # identical scans in a row, the first one included, from which on they count as frozen
PROOF = 8  # scans in a row that show the noise


class FrozenScans:
    """FrozenScans tells a frozen board: FROZEN scans of one list in a row have the same values bit by bit.

    That tells something only of a board whose noise exceeds a step of its registers. Whether it does
    is learnt from the scans themselves. Noise goes up and down by turns: against the scan before, most measurements
    change in the other direction than last time. In PROOF scans in a row no touch, drift or contact does that; and a
    board with less noise than a step repeats values. Until then, and so for ever on a board without noise (a simulated
    one), nothing is frozen.
    """

    def __init__(self) -> None:
        self.noisy = False
        self.frozen = False  # of the last scan
        self._last: dict[tuple[int, int], NDArray[np.complex64]] = {}  # by configuration and part
        self._steps: dict[tuple[int, int], NDArray[np.float32]] = {}
        self._same: dict[tuple[int, int], int] = {}
        self._by_turns = 0

    def __call__(self, scan: link.ScanFrame) -> bool:
        """Whether this scan of a live board is one of FROZEN or more."""
        which = scan.config, scan.part
        last = self._last.get(which)
        self._last[which] = scan.z
        if last is None or len(last) != len(scan.z):
            self._steps.pop(which, None)
            self._same[which] = 1
            return False
        same = last.tobytes() == scan.z.tobytes()
        self._same[which] = self._same[which] + 1 if same else 1
        if not self.noisy:
            self._learn(scan, last)
        self.frozen = self.noisy and self._same[which] >= FROZEN
        return self.frozen

    def _learn(self, scan: link.ScanFrame, last: NDArray[np.complex64]) -> None:
        with np.errstate(all="ignore"):
            step = scan.z.real - last.real
            before = self._steps.get((scan.config, scan.part))
            self._steps[scan.config, scan.part] = step
            turned = before is not None and np.mean(np.sign(step) * np.sign(before) < 0) > 0.5
        self._by_turns = self._by_turns + 1 if turned else 0
        self.noisy = self._by_turns >= PROOF
