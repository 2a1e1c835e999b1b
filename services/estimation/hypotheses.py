"""What else than drift and touches a frame can show: each hypothesis with its log evidence, in nats.

    contact e changed    d gains the columns of e's contact, its series part and its rest, with a wide prior
    e open               nothing is known of e's pairs but that they are far up
    e, f shorted         the frame that the untouched skin would give with e and f joined
    e, f swapped         the frame with the wires put right is judged again, touched or untouched
    bit of a multiplexer the frame that the untouched skin gives through the wrong addresses
    gain                 the scale has moved by more than drift can
    frozen               the frame is the one before to the last bit

A predicted frame is wrong by a share of its own size, like a touch's; and a fault's frame may be touched as well, which
that share covers. Patterns of pairs alone let a frame be read as the whole impedance matrix: others have neither shorts
nor exchanges nor addresses here (`named` says what a pattern can tell).
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from services.estimation.evidence import TouchEvidence, Whitened
from services.estimation.physics import SkinPhysics
from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.float64]
Name = tuple[str | int, ...]  # ("short", 3, 7)

FAR = 10.0  # sd of d of a pair without contact
SIDES = ("+", "-")


class Hypotheses:
    """For one skin. Frames come as |Z| (K,) beside the untouched skin's (K,), both in ohm or any one unit."""

    def __init__(self, evidence: TouchEvidence, tuning: Tuning = TUNING) -> None:
        self.evidence, self.tuning = evidence, tuning
        self.physics: SkinPhysics = evidence.physics
        self._members = self.physics.members()
        pattern, n = self.physics.pattern, self.physics.electrodes
        pairs = {frozenset(row[:2]): k for k, row in enumerate(pattern.tolist())}
        own = bool((pattern[:, :2] == pattern[:, 2:]).all())
        self._whole = own and len(pairs) == len(pattern) == n * (n - 1) // 2
        self._swaps: list[tuple[int, int]] = list(combinations(range(n), 2)) if self._whole else []
        self._orders = [_exchanged(pattern.tolist(), pairs, *pair) for pair in self._swaps]
        bits = range((n - 1).bit_length()) if self._whole else range(0)
        self._stuck = [(side, bit, value) for side in (0, 1) for bit in bits for value in (0, 1)]

    @property
    def named(self) -> tuple[str, ...]:
        """The kinds that this pattern can tell."""
        always = ("untouched", "touched", "gain", "frozen", "contact", "open")
        return always + (("short", "swapped", "multiplexer") if self._whole else ())

    def __call__(
        self,
        z: Array,
        z0: Array,
        sigma: Array,
        prior: Array,
        before: Array | None = None,
        live: NDArray[np.bool_] | None = None,
    ) -> dict[Name, float]:
        """Log evidence of every hypothesis for a frame z. sigma (K,): relative noise; prior (1 + E, 1 + E): of the
        drift; before: the frame before.
        """
        live = np.ones(len(z), dtype=bool) if live is None else live
        live = live & np.isfinite(z) & (z0 > 0)
        d = np.where(live, z / np.where(live, z0, 1.0) - 1.0, 0.0)
        error = np.diag(sigma**2 + self.tuning.absolute**2)
        b = self.physics.columns(np.minimum(d, 1.0))
        base = (error + b @ prior @ b.T)[np.ix_(live, live)]
        found = self._judged(d, error, prior, live)
        found |= self._predicted(d[live], base, live, z0)
        found |= self._columns(d[live], base, live)
        for swap, order in zip(self._swaps, self._orders, strict=True):
            if live.all() and self._could_be_right(z[order] / z0 - 1.0):
                righted = self._judged(z[order] / z0 - 1.0, error, prior, live)
                found[("swapped", *swap)] = max(righted.values())
        if before is not None:
            found[("frozen",)] = float("inf") if np.array_equal(z[live], before[live]) else -float("inf")
        return found

    def _judged(self, d: Array, error: Array, prior: Array, live: NDArray[np.bool_]) -> dict[Name, float]:
        explained = self.evidence(d, error, self.physics.columns(d), prior, live)
        return {("untouched",): explained.untouched, ("touched",): explained.touched}

    def _could_be_right(self, d: Array) -> bool:
        """No touch lowers an impedance: cheap, and excludes nearly every exchange that is none."""
        return float(d.min()) > -2 * self.tuning.contact_sd * float(np.abs(self.physics.contact).max())

    def _columns(self, d: Array, base: Array, live: NDArray[np.bool_]) -> dict[Name, float]:
        """Hypotheses that add a subspace."""
        found: dict[Name, float] = {}
        wide = np.column_stack([1.0 + np.minimum(d, 1.0)]) * self.tuning.scale_sd * FAR
        found[("gain",)] = _density(d, base + wide @ wide.T)
        layer, rest = self.physics.layer[live], (self.physics.contact - self.physics.layer)[live]
        for e in range(self.physics.electrodes):
            own = np.column_stack([layer[:, e], rest[:, e]]) * self.tuning.lifted_sd
            found[("contact", e)] = _density(d, base + own @ own.T)
            mine = self._members[live, e]
            found[("open", e)] = _density(d, base + np.diag(np.where(mine, FAR**2, 0.0)))
        return found

    def _predicted(self, d: Array, base: Array, live: NDArray[np.bool_], z0: Array) -> dict[Name, float]:
        """Hypotheses that predict the frame."""
        if not self._whole:
            return {}
        t = _transfer(self.physics.pattern, z0, self.physics.electrodes)
        frames: dict[Name, Array] = {}
        for e, f in combinations(range(self.physics.electrodes), 2):
            joined = t[:, e] - t[:, f]
            across = max(float(joined[e] - joined[f]), 1e-12)
            frames[("short", e, f)] = _read(t - np.outer(joined, joined) / across, self.physics.pattern)
        for side, bit, value in self._stuck:
            routed = _routed(self.physics.pattern, side, bit, value)
            if routed.max() < self.physics.electrodes:
                frames[("multiplexer", SIDES[side], bit, value)] = _read(t, routed)
        found = {}
        for name, frame in frames.items():
            mean = (frame / z0 - 1.0)[live]
            spread = (self.tuning.fault_misfit * mean) ** 2 + (self.tuning.fault_misfit**2) * float((mean**2).mean())
            found[name] = _density(d - mean, base + np.diag(spread))
        return found


def _density(d: Array, covariance: Array) -> float:
    white = Whitened.of(covariance)
    return white.density(white(d))


def _transfer(pattern: NDArray[np.int64], z0: Array, n: int) -> Array:
    """(n, n) transfer impedances to the last electrode, of all pairs' own impedances."""
    between = np.zeros((n, n))
    i, j = pattern[:, 0], pattern[:, 1]
    between[i, j] = between[j, i] = z0
    return np.asarray(0.5 * (between[:, -1:] + between[-1:, :] - between))


def _read(t: Array, pattern: NDArray[np.int64]) -> Array:
    dp, dm, sp, sm = pattern.T
    return np.asarray(np.abs(t[sp, dp] - t[sp, dm] - t[sm, dp] + t[sm, dm]))


def _routed(pattern: NDArray[np.int64], side: int, bit: int, value: int) -> NDArray[np.int64]:
    rows, mask = pattern.copy(), 1 << bit
    rows[:, side] = rows[:, side] | mask if value else rows[:, side] & ~mask
    return rows


def _exchanged(rows: list[list[int]], pairs: dict[frozenset[int], int], e: int, f: int) -> NDArray[np.intp]:
    """(K,) which measurement of a frame with e and f exchanged holds the value of each."""
    other = {e: f, f: e}
    return np.array([pairs[frozenset(other.get(k, k) for k in row[:2])] for row in rows])
