"""Electrode health from one frame: which measurements count, which electrodes are open or shorted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA

OK, OPEN, SHORT = 0, 1, 2
FAR = 10.0  # |Z| beyond this multiple of the baseline, or below its inverse, is no touch
MOSTLY = 0.8  # fraction of an electrode's measurements that must have failed for the electrode to be named


class ElectrodeHealth:
    """For one drive pattern (K, 4)."""

    def __init__(self, pattern: NDArray[np.integer]) -> None:
        self.electrodes = int(pattern.max()) + 1
        self.member = np.zeros((self.electrodes, len(pattern)), dtype=bool)  # (E, K) measurement uses electrode
        for column in range(pattern.shape[1]):
            self.member[pattern[:, column], np.arange(len(pattern))] = True
        # A measurement between the two electrodes that it drives sees nothing but a short between them.
        self.self_sensing = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
        self._pattern = pattern
        self._all_well = np.zeros(self.electrodes, dtype=np.uint8)

    def __call__(
        self, amplitude: NDArray[np.floating], status: NDArray[np.uint8], z0: NDArray[np.floating] | None
    ) -> tuple[NDArray[np.bool_], NDArray[np.uint8], list[str]]:
        """(K,) |Z|, (K,) status bits, (K,) baseline -> (K,) measurement counts, (E,) electrode states, reasons."""
        bad = ~np.isfinite(amplitude) | ((status & (STATUS_OPEN | STATUS_RTIA | STATUS_FIFO | STATUS_CLIPPED)) != 0)
        bad |= amplitude <= 0
        if z0 is not None:
            known = z0 > 0
            bad |= known & ((amplitude > FAR * z0) | (amplitude < z0 / FAR))
        if not bad.any():
            return ~bad, self._all_well, []
        reasons = ["saturated"] if (status & STATUS_CLIPPED).any() else []
        states = self._all_well.copy()
        if z0 is not None:
            for k in np.flatnonzero(self.self_sensing & (z0 > 0) & (amplitude < z0 / FAR)):
                states[self._pattern[k, :2]] = SHORT
            bad |= self.member[states == SHORT].any(axis=0)
        left = bad & ~self.member[states == SHORT].any(axis=0)
        while (
            left.any()
        ):  # the electrode that explains most failures first: its measurements do not count against the others
            failed = (self.member & left).sum(axis=1) / np.maximum(1, (self.member & (left | ~bad)).sum(axis=1))
            worst = int(failed.argmax())
            if failed[worst] < MOSTLY or (self.member[worst] & left).sum() < 2:
                break
            states[worst] = OPEN
            left &= ~self.member[worst]
            bad |= self.member[worst]
        if (states == SHORT).any():
            reasons.append("electrode_short")
        if (states == OPEN).any():
            reasons.append("electrode_open")
        return ~bad, states, reasons
