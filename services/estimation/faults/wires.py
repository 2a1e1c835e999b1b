"""Wires and multiplexers: what each fault makes of a frame, predicted from the untouched pairs themselves.

Pairs of electrodes that drive and sense themselves tell the whole impedance matrix between them: with z_ii = 0,

    V(p) - V(q) while current goes from r to s  =  1/2 (z_ps + z_qr - z_pr - z_qs)

so what exchanged wires, a stuck address bit or a short show is a closed form of the K values, with K x K slopes.
Touches and drift go through the slopes, so that they are found under the fault as well.

Which of them is there, if any, is told by its log evidence in closed form. A fault may begin within the scan:
measurements before its onset are as they were. Touches that nobody knows yet go into the covariance, as any touches
anywhere, so that a fault is told under a touch that begins with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from models.measurement.arrays import Array, Indices, Mask
from models.measurement.numbers import TYPICAL_DROP
from models.measurement.response import DiscGrid
from models.measurement.whitening import Whitening
from services.estimation.faults.impedance import MOST_LOG
from services.estimation.values import numbers as n

CANDIDATES = 5  # changes that are looked at exactly
SIDES = ("+", "-")  # by reciprocity a drive multiplexer does to |Z| what the sense multiplexer of its side does


class WireKind(Enum):
    """What a fault of the wires may be."""

    EXCHANGED = "exchanged"
    STUCK = "stuck"
    SHORT = "short"


@dataclass(frozen=True)
class WireFault:
    """One of them. electrodes: 0-based, those exchanged, joined, or never reached."""

    kind: WireKind
    electrodes: tuple[int, ...]
    side: str = ""  # of a stuck multiplexer
    bit: int = 0
    value: int = 0


@dataclass(frozen=True)
class WireMap:
    """A frame through a fault, about one untouched frame."""

    values: Array  # (K,) |Z| of the untouched skin
    slopes: Array  # (K, K) of log |Z| through the fault to log |Z| without it; rows of 0: they see nothing
    blind: Mask  # (K,) measurements that the fault leaves next to nothing of


class WireMaps:
    """All faults that one pattern (K, 4) can tell; none where not every pair of electrodes drives and senses itself."""

    def __init__(self, pattern: NDArray[np.integer]) -> None:
        self.faults: list[WireFault] = []
        self.at: dict[WireFault, int] = {}  # place of each in `faults`
        self.knows = all_pairs(pattern)
        if not self.knows:
            return
        first, second = (pattern[:, column].astype(np.intp) for column in (0, 1))
        electrodes = int(pattern.max()) + 1
        self._place = np.full((electrodes + 1, electrodes + 1), len(pattern), np.intp)  # K: no value, 0 ohm
        self._place[first, second] = self._place[second, first] = np.arange(len(pattern))
        couples = list(combinations(range(electrodes), 2))
        self.faults = [WireFault(kind, couple) for kind in (WireKind.EXCHANGED, WireKind.SHORT) for couple in couples]
        for side, bit, value in product(SIDES, range((electrodes - 1).bit_length()), (0, 1)):
            missed = tuple(e for e in range(electrodes) if (e >> bit & 1) != value)
            self.faults.append(WireFault(WireKind.STUCK, missed, side, bit, value))
        self.at = {fault: k for k, fault in enumerate(self.faults)}
        self._terms = np.array([self._terms_of(first, second, fault) for fault in self.faults])  # (N, K, 4)
        self._shorts = slice(len(couples), 2 * len(couples))
        self._joined = self._place[tuple(np.transpose(couples))]

    def every(self, z0: Array) -> Array:
        """(N, K) |Z| through each of the N faults, of a skin that has z0 (K,) without them."""
        passed = _combined(z0, self._terms)
        values, shorts = np.abs(passed), self._shorts
        values[shorts] = z0 - passed[shorts] ** 2 / (z0[self._joined, None] + n.SHORT_OHM)
        return np.asarray(values)

    def order(self, fault: WireFault) -> Indices:
        """(K,) which measurement shows, while two wires are exchanged, what each would show if they were not."""
        return np.asarray(self._terms[self.at[fault], :, 0])

    def one(self, fault: WireFault, z0: Array) -> WireMap:
        """Raises KeyError for a fault that this pattern cannot tell."""
        terms = self._terms[self.at[fault]]
        passed, slopes = _combined(z0, terms), _slopes(terms)
        if fault.kind is WireKind.SHORT:
            joined = self._place[fault.electrodes]
            ohm = z0[joined] + n.SHORT_OHM
            values, slopes = z0 - passed**2 / ohm, np.eye(len(z0)) - 2 * (passed / ohm)[:, None] * slopes
            slopes[:, joined] += (passed / ohm) ** 2
        else:
            values, slopes = np.abs(passed), slopes * np.sign(passed)[:, None]
        blind = blinded(values[None], z0)[0]
        relative = slopes * z0 / np.where(blind, 1.0, values)[:, None]
        relative[blind] = 0.0
        return WireMap(values, relative, blind)

    def _terms_of(self, first: Indices, second: Indices, fault: WireFault) -> Indices:
        """(K, 4) places of z_ps, z_qr, z_pr and z_qs, with which pair p, q a fault senses and with which r, s it drives
        where first, second is meant; of a short what the pair makes between the two that are joined.
        """
        sensed = driven = [first, second]
        electrodes, cut_off = len(self._place) - 1, np.zeros(len(first), bool)
        if fault.kind is WireKind.EXCHANGED:
            wires = np.arange(electrodes)
            wires[list(fault.electrodes)] = fault.electrodes[::-1]
            sensed = driven = [wires[first], wires[second]]
        elif fault.kind is WireKind.SHORT:
            driven = [np.full_like(first, joined) for joined in fault.electrodes]
        else:  # one of the two is driven from another electrode, and beyond the last one nothing is connected
            column, mask = SIDES.index(fault.side), 1 << fault.bit
            reached = driven[column] | mask if fault.value else driven[column] & ~mask
            cut_off = reached >= electrodes
            driven = [*driven[:column], np.minimum(reached, electrodes), *driven[column + 1 :]]
        (p, q), (r, s), place = sensed, driven, self._place
        terms = np.stack([place[p, s], place[q, r], place[p, r], place[q, s]], axis=1)
        terms[cut_off] = len(first)
        return terms

    def suspicious(self, scan: BoardScan, standing: WireFault | None) -> bool:
        """Whether measurements fell, or failed, as no touch makes them."""
        if not self.knows:
            return False
        fell = scan.known & ~scan.failed & (scan.log_z - scan.predicted < -n.FALLS)
        return standing is not None or int((fell | scan.failed).sum()) > 1

    def guesses(self, scan: BoardScan, standing: WireFault | None, skin: Array, own: Array) -> list[WireGuess]:
        """The likeliest states of the wires, the best first; the one that stands is among them. skin (K, K): covariance
        of log |Z| with sound wires, any touches included; own (K, K): of what the measurements add themselves.
        """
        z0 = np.exp(scan.predicted)
        values = np.vstack([z0, self.every(z0)])
        blind = blinded(values, z0)
        blind[0] = False
        left = np.where(scan.failed | blind | ~scan.known, 0.0, scan.log_z - np.log(np.maximum(values, n.TINY)))
        left = np.clip(left, -MOST_LOG, MOST_LOG)
        log_prior = np.where(scan.failed & blind, n.LOG_PRIOR_EXPECTED_FAILURE, 0.0)
        log_prior += np.where(scan.failed ^ blind, n.LOG_PRIOR_FAILURE, 0.0)
        log_prior[:, ~scan.known] = 0.0
        before = 0 if standing is None else 1 + self.at[standing]
        found = list[WireGuess]()
        slopes_before = self._slopes_of(before, z0)
        for which, onset_s in self._candidates(scan, left, log_prior, before):
            after = scan.times_s >= onset_s
            slopes = np.where(after[:, None], self._slopes_of(which, z0), slopes_before)
            white = Whitening.of(own + slopes @ skin @ slopes.T)
            residual = np.where(after, left[which], left[before])
            prior = float(np.where(after, log_prior[which], log_prior[before]).sum())
            if which != before:
                prior += n.LOG_PRIOR_WIRE * ((before > 0) + (which > 0))
            fault = self.faults[which - 1] if which else None
            found.append(WireGuess(fault, onset_s, white.log_likelihood(residual) + prior))
        return sorted(found, key=lambda guess: -guess.score)

    def _slopes_of(self, which: int, z0: Array) -> Array:
        return np.eye(len(z0)) if not which else self.one(self.faults[which - 1], z0).slopes

    @staticmethod
    def _candidates(scan: BoardScan, left: Array, log_prior: Array, before: int) -> list[tuple[int, float]]:
        """The likeliest changes of state by the misfit of each measurement for itself, and no change."""
        cost = np.minimum(np.abs(left) / n.FALLS, n.MISFIT_MOST) - log_prior
        order = np.argsort(scan.times_s)
        gained = (cost - cost[before])[:, order]
        since = np.cumsum(gained[:, ::-1], axis=1)[:, ::-1]  # if it began with that measurement
        since[before] = np.inf
        first = since.argmin(axis=1)
        likeliest = np.argsort(since[np.arange(len(first)), first])[:CANDIDATES]
        onsets_s = np.where(first == 0, -np.inf, scan.times_s[order[first]])
        return [(before, -np.inf), *((int(which), float(onsets_s[which])) for which in likeliest)]


SIGNS: Array = np.array([0.5, 0.5, -0.5, -0.5])


def _combined(values: Array, terms: Indices) -> Array:
    """(..., K) of values (K,) at terms (..., K, 4)."""
    return np.asarray(np.append(values, 0.0)[terms] @ SIGNS)


def _slopes(terms: Indices) -> Array:
    """(K, K) of `_combined` to the values, at terms (K, 4)."""
    count = len(terms)
    slopes = np.zeros((count, count + 1))
    for column, sign in enumerate(SIGNS):
        np.add.at(slopes, (np.arange(count), terms[:, column]), sign)
    return slopes[:, :count]


def blinded(values: Array, z0: Array) -> Mask:
    """(N, K) measurements that faults leave next to nothing of; values (N, K)."""
    return np.asarray(values < n.NEXT_TO_NOTHING * np.median(z0))


def open_electrodes(failed: Mask, member: Mask) -> tuple[int, ...]:
    """Those that explain most of the failed measurements (K,), the worst chosen first; member (K, E): which it uses."""
    left, gone, found = failed.copy(), np.zeros_like(failed), list[int]()
    while left.any():
        share = (member & left[:, None]).sum(axis=0)
        whole = (member & ~gone[:, None]).sum(axis=0)
        worst = int(share.argmax())
        if share[worst] < max(2, n.OPEN_SHARE * whole[worst]):
            break
        found.append(worst)
        gone |= member[:, worst]
        left &= ~gone
    return tuple(sorted(found))


def members(pattern: NDArray[np.integer]) -> Mask:
    """(K, E) whether a measurement uses an electrode."""
    electrodes = np.arange(int(pattern.max()) + 1)
    return np.asarray((pattern[:, :, None] == electrodes).any(axis=1))


def all_pairs(pattern: NDArray[np.integer]) -> bool:
    """Whether every pair of electrodes of a pattern (K, 4) drives and senses itself, once."""
    electrodes = int(pattern.max()) + 1
    themselves = bool((pattern[:, 0] == pattern[:, 2]).all() and (pattern[:, 1] == pattern[:, 3]).all())
    pairs = {frozenset(row) for row in pattern[:, :2].tolist()}
    return themselves and len(pairs) == len(pattern) == electrodes * (electrodes - 1) // 2


@dataclass(frozen=True)
class BoardScan:
    """One scan as the board's wires are asked about it."""

    log_z: Array  # (K,) as measured; 0 where it failed
    predicted: Array  # (K,) log |Z| with sound wires, touches that stand included
    failed: Mask  # (K,) no value, or one that is none
    known: Mask  # (K,) the baseline has it: the others tell nothing
    times_s: Array  # (K,) from the middle of the scan


@dataclass(frozen=True)
class WireGuess:
    """fault: None where the wires are sound."""

    fault: WireFault | None
    since_s: float
    score: float  # log evidence and prior


def any_touches(grid: DiscGrid) -> Array:
    """(K, K) covariance of log |Z| over touches that may be anywhere."""
    areas = np.pi * np.exp(2 * grid.discs[:, 2])
    double = grid.responses.astype(float)  # a map's slopes make what rounding leaves 1000 times larger
    weighted = double * (TYPICAL_DROP * areas)[:, None]
    return np.asarray(weighted.T @ weighted * (n.MOST_TOUCHES / len(areas)))
