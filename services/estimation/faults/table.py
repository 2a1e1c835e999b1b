"""Closed-form log evidence of the state of the board's wires: sound, or any fault that the pattern can tell.

A fault may begin within the scan: measurements before its onset are as they were. Touches that nobody knows yet go into
the covariance, as any touches anywhere, so that a fault is told under a touch that begins with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.whitening import Whitening
from models.measurement.numbers import TYPICAL_DROP
from models.measurement.responses.response import DiscGrid
from models.measurement.touch import area_of
from services.estimation.faults.impedance import MOST_LOG
from services.estimation.faults.wires import WireFault, WireMaps, blinded
from services.estimation.values import numbers as n

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CANDIDATES = 5  # changes that are looked at exactly


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
    areas = np.array([area_of(log_radius) for log_radius in grid.discs[:, 2]])
    double = grid.responses.astype(float)  # a map's slopes make what rounding leaves 1000 times larger
    weighted = double * (TYPICAL_DROP * areas)[:, None]
    return np.asarray(weighted.T @ weighted * (n.MOST_TOUCHES / len(areas)))


class WireTable:
    """Of one pattern."""

    def __init__(self, maps: WireMaps) -> None:
        self._maps = maps

    def suspicious(self, scan: BoardScan, standing: WireFault | None) -> bool:
        """Whether measurements fell, or failed, as no touch makes them."""
        if not self._maps.knows:
            return False
        fell = scan.known & ~scan.failed & (scan.log_z - scan.predicted < -n.FALLS)
        return standing is not None or int((fell | scan.failed).sum()) > 1

    def guesses(self, scan: BoardScan, standing: WireFault | None, skin: Array, own: Array) -> list[WireGuess]:
        """The likeliest states of the wires, the best first; the one that stands is among them. skin (K, K): covariance
        of log |Z| with sound wires, any touches included; own (K, K): of what the measurements add themselves.
        """
        z0 = np.exp(scan.predicted)
        values = np.vstack([z0, self._maps.every(z0)])
        blind = blinded(values, z0)
        blind[0] = False
        left = np.where(scan.failed | blind | ~scan.known, 0.0, scan.log_z - np.log(np.maximum(values, n.TINY)))
        left = np.clip(left, -MOST_LOG, MOST_LOG)
        log_prior = np.where(scan.failed & blind, n.LOG_PRIOR_EXPECTED_FAILURE, 0.0)
        log_prior += np.where(scan.failed ^ blind, n.LOG_PRIOR_FAILURE, 0.0)
        log_prior[:, ~scan.known] = 0.0
        before = 0 if standing is None else 1 + self._maps.at[standing]
        found = list[WireGuess]()
        slopes_before = self._slopes(before, z0)
        for which, onset_s in self._candidates(scan, left, log_prior, before):
            after = scan.times_s >= onset_s
            slopes = np.where(after[:, None], self._slopes(which, z0), slopes_before)
            white = Whitening.of(own + slopes @ skin @ slopes.T)
            residual = np.where(after, left[which], left[before])
            prior = float(np.where(after, log_prior[which], log_prior[before]).sum()) + _log_prior(before, which)
            fault = self._maps.faults[which - 1] if which else None
            found.append(WireGuess(fault, onset_s, white.log_likelihood(residual) + prior))
        return sorted(found, key=lambda guess: -guess.score)

    def _slopes(self, which: int, z0: Array) -> Array:
        return np.eye(len(z0)) if not which else self._maps.one(self._maps.faults[which - 1], z0).slopes

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


def _log_prior(before: int, after: int) -> float:
    """Log prior of a change of state, 0 being sound wires."""
    return n.LOG_PRIOR_WIRE * ((before > 0) + (after > 0)) if before != after else 0.0
