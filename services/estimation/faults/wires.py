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

from models.measurement.numbers import TYPICAL_DROP
from models.measurement.response import DiscGrid
from models.measurement.whitening import Whitening
from services.estimation.faults.impedance import MOST_LOG
from services.estimation.values import numbers as n

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

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
        self._exchanged = np.array([self._of_exchanged(first, second, couple) for couple in couples])
        self._joined = np.array([self._place[couple] for couple in couples])
        between = [self._terms(first, second, np.full_like(first, a), np.full_like(second, b)) for a, b in couples]
        self._between = np.array(between)
        stuck = list[WireFault]()
        for side, bit, value in product(SIDES, range((electrodes - 1).bit_length()), (0, 1)):
            missed = tuple(e for e in range(electrodes) if (e >> bit & 1) != value)
            stuck.append(WireFault(WireKind.STUCK, missed, side, bit, value))
        self._routed = np.array([self._of_stuck(first, second, fault) for fault in stuck])
        self.faults = [WireFault(WireKind.EXCHANGED, couple) for couple in couples]
        self.faults += [WireFault(WireKind.SHORT, couple) for couple in couples]
        self.faults += stuck
        self.at = {fault: k for k, fault in enumerate(self.faults)}

    def every(self, z0: Array) -> Array:
        """(N, K) |Z| through each of the N faults, of a skin that has z0 (K,) without them."""
        values = np.append(z0, 0.0)
        passed = _combined(values, self._between)
        short = z0 - passed**2 / (z0[self._joined, None] + n.SHORT_OHM)
        return np.concatenate([values[self._exchanged], short, np.abs(_combined(values, self._routed))])

    def order(self, fault: WireFault) -> Indices:
        """(K,) which measurement shows, while two wires are exchanged, what each would show if they were not."""
        return np.asarray(self._exchanged[self.at[fault]])

    def one(self, fault: WireFault, z0: Array) -> WireMap:
        """Raises KeyError for a fault that this pattern cannot tell."""
        k, couples = self.at[fault], len(self._joined)
        if k < couples:
            values, slopes = z0[self._exchanged[k]], np.eye(len(z0))[self._exchanged[k]]
        elif k < 2 * couples:
            values, slopes = self._short(k - couples, z0)
        else:
            terms = self._routed[k - 2 * couples]
            signed = _combined(np.append(z0, 0.0), terms)
            values, slopes = np.abs(signed), _slopes(terms) * np.sign(signed)[:, None]
        blind = blinded(values[None], z0)[0]
        relative = slopes * z0 / np.where(blind, 1.0, values)[:, None]
        relative[blind] = 0.0
        return WireMap(values, relative, blind)

    def _short(self, k: int, z0: Array) -> tuple[Array, Array]:
        passed = _combined(np.append(z0, 0.0), self._between[k])
        joined = self._joined[k]
        ohm = z0[joined] + n.SHORT_OHM
        slopes = np.eye(len(z0)) - 2 * (passed / ohm)[:, None] * _slopes(self._between[k])
        slopes[:, joined] += (passed / ohm) ** 2
        return z0 - passed**2 / ohm, slopes

    def _of_exchanged(self, first: Indices, second: Indices, couple: tuple[int, int]) -> Indices:
        wires = np.arange(int(second.max()) + 1)
        wires[list(couple)] = couple[::-1]
        return self._place[wires[first], wires[second]]

    def _of_stuck(self, first: Indices, second: Indices, fault: WireFault) -> Indices:
        """The pair is driven, and sensed, as it is meant, by one of them from another electrode."""
        column, mask, electrodes = SIDES.index(fault.side), 1 << fault.bit, len(self._place) - 1
        driven = [first, second]
        reached = driven[column] | mask if fault.value else driven[column] & ~mask
        driven[column] = np.minimum(reached, electrodes)  # beyond the last one nothing is connected
        terms = self._terms(first, second, *driven)
        terms[driven[column] == electrodes] = len(first)
        return terms

    def _terms(self, p: Indices, q: Indices, r: Indices, s: Indices) -> Indices:
        """(K, 4) places of z_ps, z_qr, z_pr and z_qs."""
        place = self._place
        return np.stack([place[p, s], place[q, r], place[p, r], place[q, s]], axis=1)

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
            prior = float(np.where(after, log_prior[which], log_prior[before]).sum()) + _log_prior(before, which)
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
    """(..., K) of values (K + 1,) at terms (..., K, 4)."""
    return np.asarray(values[terms] @ SIGNS)


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
    """Electrodes by which most failed measurements are explained, chosen from the one that explains most on. failed
    (K,); member (K, E): the measurement uses the electrode.
    """
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


def _log_prior(before: int, after: int) -> float:
    """Log prior of a change of state, 0 being sound wires."""
    return n.LOG_PRIOR_WIRE * ((before > 0) + (after > 0)) if before != after else 0.0
