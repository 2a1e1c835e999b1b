"""One frame by itself shows electrodes that are open, shorted, exchanged, or not reached by a multiplexer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA
from services.estimation.advice import NO_ANSWER, OK, OPEN, SHORT, STUCK, SWAPPED, stuck_bit
from services.estimation.contact_drift import Reference
from services.estimation.wiring import Exchanged, StuckBit, Wiring

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

FAR = 10.0  # |Z| beyond this multiple of the baseline, or below its inverse, is no touch
MOSTLY = 0.8  # fraction of an electrode's measurements that must have failed for the electrode to be named
NOTHING_ANSWERS = 0.7  # fraction of all measurements that failed where it is not the electrodes
UNDONE = 3.0  # of the untouched |Z|, beyond which a measurement that clips is of an electrode off the skin
FALLS = 0.03  # relative fall that no touch, warmth or noise makes: the wiring is looked at
FALLS_UNTARED = 0.06  # against the bundle's prediction, contacts unknown
TROUBLE = STATUS_OPEN | STATUS_RTIA | STATUS_FIFO | STATUS_CLIPPED


@dataclass
class FrameFindings:
    """What one frame shows; measurements in `order` (None: as they came)."""

    states: NDArray[np.uint8]  # (E,) ELECTRODE_STATES
    amplitude: Array  # (K,)
    failed: Mask  # (K,)
    order: NDArray[np.intp] | None = None
    fault: str = ""  # of the board as a whole
    suspect: int | None = None  # an electrode whose contact changed, if nobody presses right on it


class FrameCheck:
    """FrameCheck looks at the frames of one bundle: K measurements between E electrodes."""

    def __init__(self, bundle: Bundle) -> None:
        pattern = np.asarray(bundle.pattern)
        self.electrodes = int(pattern.max()) + 1
        self.member = np.zeros((self.electrodes, len(pattern)), dtype=bool)  # (E, K) measurement uses electrode
        for column in range(pattern.shape[1]):
            self.member[pattern[:, column], np.arange(len(pattern))] = True
        # A measurement between the two electrodes that it drives sees nothing but a short between them.
        self.self_sensing = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
        self._pattern = pattern
        self._predicted = np.asarray(bundle.z0, dtype=float) if bundle.matrices.normalisation == "model" else None
        self._wiring = Wiring(pattern)

    def __call__(self, amplitude: Array, status: NDArray[np.uint8], untouched: Reference | None) -> FrameFindings:
        """Looks at a frame: (K,) |Z| and status bits."""
        failed = ~np.isfinite(amplitude) | (amplitude <= 0) | ((status & TROUBLE) != 0)
        reference = self._reference(amplitude, failed, untouched)
        states = np.zeros(self.electrodes, dtype=np.uint8)
        no_current = ((status & STATUS_OPEN) != 0) | (failed & (status == 0))
        low = np.zeros_like(failed)
        if reference is not None:
            known = ~failed & (reference > 0)
            low = known & (amplitude < reference / FAR)
            no_current |= known & (amplitude > FAR * reference)
            clipped = (status & STATUS_CLIPPED) != 0
            no_current |= clipped & np.isfinite(amplitude) & (amplitude > UNDONE * reference) & (reference > 0)
        failed = failed | low | no_current
        seen = FrameFindings(states, amplitude, failed)
        if (low | no_current).mean() > NOTHING_ANSWERS:
            states[:] = STUCK
            seen.fault = NO_ANSWER
            return seen
        shorted = self._short(low & self.self_sensing)
        if reference is not None and self._predicted is not None and not shorted:
            fault = self._miswired(amplitude, failed, low, reference, untouched)
            if isinstance(fault, StuckBit):
                states[fault.electrodes] = STUCK
                seen.fault = stuck_bit(fault)
                return seen
            if isinstance(fault, Exchanged):
                states[fault.electrodes] = SWAPPED
                if untouched is None:  # nothing tells whether putting them right is right
                    return seen
                order = seen.order = self._wiring.order(fault)
                seen.amplitude, seen.failed = amplitude[order], failed[order]
                low, no_current = low[order], no_current[order]
        states[shorted] = SHORT
        self._open(seen.failed & (low | no_current), seen.failed, states)
        return seen

    def _short(self, low: Mask) -> list[int]:
        """Returns electrodes all joined to each other, by their pairs that measure next to nothing."""
        if not low.any():
            return []
        joined = sorted(set(self._pattern[low, :2].ravel().tolist()))
        if low.sum() < len(joined) * (len(joined) - 1) / 2:
            return []  # not each of them with each other: that is no short
        return joined

    def _miswired(
        self, amplitude: Array, failed: Mask, low: Mask, reference: Array, untouched: Reference | None
    ) -> Exchanged | StuckBit | None:
        """Looks for wires exchanged or a multiplexer stuck, where something fell as no touch lets it fall."""
        known = ~failed & (reference > 0)
        noise = 6 * untouched.sigma if untouched else np.zeros(len(amplitude))
        limit = FALLS if untouched else FALLS_UNTARED
        fell = known & (amplitude < (1 - limit) * reference - np.where(known, noise, 0.0) * reference)
        if fell.sum() < 2 and low.sum() < 2:
            return None
        return self._wiring(np.where(failed & ~low, np.nan, amplitude), reference)

    def _open(self, left: Mask, failed: Mask, states: NDArray[np.uint8]) -> None:
        """Sets `states`: the electrode that explains most failures first; its measurements do not count against the
        others.
        """
        gone = self.member[states != OK].any(axis=0)
        left = left & ~gone
        while left.any():
            whole = (self.member & (left | ~failed) & ~gone).sum(axis=1)
            share = (self.member & left).sum(axis=1) / np.maximum(1, whole)
            worst = int(share.argmax())
            if share[worst] < MOSTLY or (self.member[worst] & left).sum() < 2:
                return
            states[worst] = OPEN
            gone |= self.member[worst]
            left &= ~gone

    def _reference(self, amplitude: Array, failed: Mask, untouched: Reference | None) -> Array | None:
        """Returns |Z| of a well, untouched skin: its baseline, else the bundle's prediction times the frame's gain."""
        if self._predicted is None:
            return None if untouched is None else untouched.z0
        if untouched is not None:
            lost = ~(untouched.z0 > 0)
            gain = untouched.normaliser / self._predicted
            return np.where(lost, self._predicted * np.where(np.isfinite(gain), gain, 1.0), untouched.z0)
        if failed.all():
            return self._predicted
        return np.asarray(self._predicted * np.median(amplitude[~failed] / self._predicted[~failed]))
