"""Exchanged wires and stuck multiplexers, recognised from one frame of a pattern of electrode pairs.

Each pair drives and senses itself, so a frame is the sheet's whole impedance matrix up to what pressing changed. Every
single exchange of two wires, and every address bit that may stick, predicts another frame from
the untouched one: the fault is named where its prediction fits and "nothing is wrong" does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

SIDES = ("+", "-")  # by reciprocity a drive multiplexer does to |Z| what the sense multiplexer of its side does
BETTER = 0.5  # a fault is named where it fits the frame this much better than no fault does
CLEARLY = 0.8  # and than the next best exchange
NO_PRESS = 0.05  # relative: what pressing makes fall, noise and contacts included, with the wires put right
SWAP_FALLS = 0.02  # share of measurements that may fall by more, with the wires put right


@dataclass(frozen=True)
class Exchanged:
    """Two electrodes, 0-based, whose wires changed places."""

    first: int
    second: int

    @property
    def electrodes(self) -> list[int]:
        return [self.first, self.second]


@dataclass(frozen=True)
class StuckBit:
    """One address bit that stays as it is, of the drive or the sense multiplexer of a side; `electrodes`, 0-based, are
    never reached by it.
    """

    side: str
    bit: int
    value: int
    electrodes: list[int]


class Wiring:
    """Wiring knows a pattern (K, 4) of all pairs of its electrodes; `knows` is false for others, and nothing is
    recognised.
    """

    def __init__(self, pattern: NDArray[np.integer]) -> None:
        self.electrodes = n = int(pattern.max()) + 1
        selfsensing = (pattern[:, 0] == pattern[:, 2]).all() and (pattern[:, 1] == pattern[:, 3]).all()
        place = {frozenset(row[:2]): k for k, row in enumerate(pattern.tolist())}
        self.knows = bool(selfsensing) and len(place) == len(pattern) == n * (n - 1) // 2
        if not self.knows:
            return
        self._pattern = pattern.astype(np.int64)
        self._swaps = [Exchanged(i, j) for i, j in combinations(range(n), 2)]
        self._orders = np.array([_order(pattern, place, swap) for swap in self._swaps])  # (S, K)
        self._stuck = [
            StuckBit(name, bit, value, [e for e in range(n) if (e >> bit & 1) != value])
            for name in SIDES
            for bit in range((n - 1).bit_length())
            for value in (0, 1)
        ]
        self._routes = np.array([_routed(self._pattern, s) for s in self._stuck])  # (B, K, 4)

    def __call__(self, amplitude: Array, reference: Array) -> Exchanged | StuckBit | None:
        """Returns the one fault that explains (K,) |Z|, NaN where it failed, against (K,) of the untouched skin; or
        None.
        """
        if not self.knows:
            return None
        known = np.isfinite(amplitude)
        righted = amplitude[self._orders]
        there = np.isfinite(righted)
        change = np.where(there, righted - reference, 0.0) / reference
        falls = (change < -NO_PRESS).sum(axis=1) / np.maximum(1, there.sum(axis=1))
        swaps = np.where(falls <= SWAP_FALLS, _pressed(change, there), np.inf)
        best = int(swaps.argmin())
        if swaps[best] < BETTER * float(_pressed(np.where(known, amplitude / reference - 1, 0.0), known)):
            if swaps[best] < CLEARLY * np.delete(swaps, best).min():
                return self._swaps[best]
            return None
        misfits = _off(amplitude - self._predicted(reference), reference, known)
        best = int(misfits.argmin())
        if misfits[best] < BETTER * float(_off(amplitude - reference, reference, known)):
            return self._stuck[best]
        return None

    def order(self, fault: Exchanged) -> NDArray[np.intp]:
        """Returns (K,) which measurement of a frame holds the value that each would have with the wires put right."""
        return np.asarray(self._orders[self._swaps.index(fault)])

    def _predicted(self, reference: Array) -> Array:
        """Returns (B, K) |Z| of the untouched skin through each stuck multiplexer."""
        n = self.electrodes
        between = np.zeros((n, n))
        i, j = self._pattern[:, 0], self._pattern[:, 1]
        between[i, j] = between[j, i] = reference
        t = 0.5 * (between[:, -1:] + between[-1:, :] - between)  # transfer impedances to the last electrode
        reached = np.minimum(self._routes, n - 1)
        dp, dm, sp, sm = np.moveaxis(reached, -1, 0)
        return np.asarray(np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm]))


def _pressed(change: Array, known: NDArray[np.bool_]) -> Array:
    """Returns the mean over the measurements of the relative change, a fall tenfold: pressing raises, and lowers
    nothing.
    """
    cost = np.minimum(np.where(change < 0, -10 * change, change), 1.0)
    return np.asarray(cost.sum(axis=-1) / np.maximum(1, known.sum(axis=-1)))


def _off(change: Array, reference: Array, known: NDArray[np.bool_]) -> Array:
    """Returns the mean over the measurements of the relative misfit; one far off counts like one that is off by all of
    it.
    """
    relative = np.minimum(np.abs(np.where(known, change, 0.0)) / reference, 1.0)
    return np.asarray(relative.sum(axis=-1) / np.maximum(1, known.sum(axis=-1)))


def _order(pattern: NDArray[np.integer], place: dict[frozenset[int], int], swap: Exchanged) -> list[int]:
    other = {swap.first: swap.second, swap.second: swap.first}
    return [place[frozenset(other.get(e, e) for e in row[:2])] for row in pattern.tolist()]


def _routed(pattern: NDArray[np.int64], stuck: StuckBit) -> NDArray[np.int64]:
    rows, column, mask = pattern.copy(), SIDES.index(stuck.side), 1 << stuck.bit
    rows[:, column] = rows[:, column] | mask if stuck.value else rows[:, column] & ~mask
    return rows
