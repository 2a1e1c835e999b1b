"""The untouched skin over time: the sheet's slow field with its rates, contact impedances, what foam remembers of
touches, and each measurement's own remainder. A Kalman filter of log |Z|; touches are no part of it.

    y = H x + r + e,    x = (field, its rates, contact impedances, memories),    r: each measurement's own walk
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from scipy.linalg import block_diag

from models.measurement.arrays import Array, Indices
from models.measurement.fit import FoundTouches
from models.measurement.tables import FIELD_DEGREES, SkinTables
from models.measurement.whitening import Whitening
from services.estimation.values import numbers as n

MODES = len(FIELD_DEGREES)
FIELD, RATES = slice(0, MODES), slice(MODES, 2 * MODES)
FADES_S: Array = np.array(n.MEMORY_FADES_S, float)
STATES_OF_MEMORY = len(FADES_S)


@dataclass(frozen=True)
class Memory:
    """What a touch left: one column, with a state for each time constant."""

    column: Annotated[Array, "K"]  # of unit action
    action: float  # when it went
    at_s: float
    x: float
    y: float
    log_radius: float
    mixed: bool = False  # of whatever pressed while nothing explained the scans: it has no place

    def most(self, at_s: float) -> float:
        """Action that foam may remember at most at an instant."""
        faded = float(np.exp(-max(0.0, at_s - self.at_s) / FADES_S).mean())
        return float(n.MEMORY_MOST * self.action * faded)

    def at_place_of(self, other: Memory) -> bool:
        if self.mixed or other.mixed:
            return self is other
        apart = np.hypot(self.x - other.x, self.y - other.y)
        return bool(apart < n.MEMORY_APART * np.exp(max(self.log_radius, other.log_radius)))


@dataclass
class FilterState:
    """All that changes."""

    at_s: float
    x: Annotated[Array, "N"]
    p: Annotated[Array, "N", "N"]
    remainder: Annotated[Array, "K"]
    remainder_variance: Annotated[Array, "K"]
    memories: list[Memory] = field(default_factory=list)
    process_noise_scale: float = 1.0  # times the faster drift's variance: grows while nothing explains the skin


@dataclass(frozen=True)
class Prediction:
    """The untouched skin at one instant."""

    at_s: float
    x: Array
    p: Array
    remainder_variance: Array  # (K,)
    cross_covariance: Array  # (N, K) P H^T
    shift: Array  # (K,) log |Z| over the baseline
    covariance: Array  # (K, K) of it


class SkinFilter:
    """The Kalman filter of an untouched skin's log |Z|."""

    def __init__(self, tables: SkinTables) -> None:
        self._tables = tables
        self.contacts = slice(2 * MODES, 2 * MODES + tables.electrodes)
        self._fixed = self.contacts.stop
        self._lasting = np.hstack([tables.field, tables.contact])  # columns of all states but memories
        self._lasting_seen = np.r_[0:MODES, 2 * MODES : self._fixed]
        self._value_walk = _by_degree(n.FIELD_WALK, n.SLOPE_WALK)
        self._rate_walk = _by_degree(n.FIELD_RATE_WALK, n.SLOPE_RATE_WALK)
        self._faster = _by_degree(n.FIELD_FASTER, n.SLOPE_FASTER)
        self.begin(0.0, np.full(tables.electrodes, n.CONTACT_START**2))

    def begin(self, at_s: float, contact_variance: Array, age_s: float = 0.0) -> None:
        """A baseline was taken; contact_variance (E,): what its frames leave open of each contact impedance. age_s: for
        which nobody will have watched when it is used. What warms or dries unevenly evens out meanwhile: its rate is a
        mean over that time (Ornstein and Uhlenbeck).
        """
        ages = max(age_s / float(n.SLOPE_LASTS_S), 1e-6)
        lasting = float(np.sqrt(2 * (ages + np.expm1(-ages))) / ages)
        rates = _by_degree(n.FIELD_RATE, n.SLOPE_RATE * lasting)
        variance = np.concatenate([np.full(MODES, n.FIELD_START**2), rates, contact_variance])
        remainder = np.zeros(self._tables.measurements)
        start = remainder + n.REMAINDER_START**2
        self.now = FilterState(at_s, np.zeros(self._fixed), np.diag(variance), remainder, start)

    def succeed(self, before: SkinFilter) -> None:
        """Go on from other tables' filter: what they explain otherwise becomes remainder, so predictions stay."""
        self.now = before.now
        then = before.shift(self.now.at_s)
        self.now.remainder = self.now.remainder + then - self.shift(self.now.at_s)

    def predict(self, at_s: float, flicker: Array) -> Prediction:
        """flicker (E,): variances of the contact impedances' noise, of which a share is slow."""
        passed_s = self._passed_s(at_s)
        x, p = self._moved(passed_s, flicker)
        columns, seen = self._columns()
        reach = p[:, seen] @ columns.T
        covariance = columns @ reach[seen]
        remainder_variance = self.now.remainder_variance + n.REMAINDER_WALK**2 * passed_s
        covariance[np.diag_indices_from(covariance)] += remainder_variance
        shift = columns @ x[seen] + self.now.remainder
        return Prediction(at_s, x, p, remainder_variance, reach, shift, covariance)

    def shift(self, at_s: float) -> Array:
        """(K,) log |Z| over the baseline, predicted: `predict` without its covariance."""
        columns, seen = self._columns()
        return np.asarray(columns @ self._moved_mean(self._passed_s(at_s))[seen] + self.now.remainder)

    def common_mode_variance(self, at_s: float) -> float:
        """Of what all measurements share, but for contacts."""
        p, passed_s = self.now.p, self._passed_s(at_s)
        return float(p[0, 0] + 2 * passed_s * p[0, MODES] + passed_s**2 * p[MODES, MODES])

    def inflated_process_noise(self, times: float) -> Array:
        """(K, K) covariance of drift faster than the filter's own; times: that variance, beyond 1 contacts move too."""
        columns = self._tables.field
        contact = self._tables.contact * n.CONTACT_FASTER
        return np.asarray(times * (columns * self._faster) @ columns.T + (times - 1) * contact @ contact.T)

    def widen(self, times: float) -> None:
        """It drifts faster than it did: by what `faster` says, of which a share stays."""
        p, modes = self.now.p, np.arange(MODES)
        p[modes, modes] += n.FASTER_STAYS * times * self._faster
        p[modes + MODES, modes + MODES] += n.FASTER_STAYS * self._faster
        contacts = np.r_[self.contacts]
        p[contacts, contacts] += n.FASTER_STAYS * (times - 1) * n.CONTACT_FASTER**2

    def update(self, predicted: Prediction, y: Array, white: Whitening) -> Array:
        """Learn from an untouched frame: y (K,) over the prediction, white: of its covariance. Returns S^-1 y (K,)."""
        weighted_residual, gathered = white.solve(y), white(predicted.cross_covariance.T)
        posterior = predicted.p - gathered.T @ gathered
        self._learn(predicted, weighted_residual, posterior, white.conditional_precisions())
        self._forget_the_faint()
        return weighted_residual

    def update_beside_touches(self, predicted: Prediction, fit: FoundTouches, grown: Array) -> None:
        """Learn from a touched frame what its touches, which may be any near those that were found, leave open. grown
        (K,): times what the skin changes by, as the fit's values show it.

        The state's posterior given a fit's own, with S = W^-1 W^-T, D its whitened design and C what it leaves open:
        P - P H^T W^T (1 - D C D^T) W H P.
        """
        gathered = fit.white((predicted.cross_covariance * grown).T)  # (K, N)
        beside, design = fit.design.T @ gathered, fit.design.T @ fit.white.w
        posterior = predicted.p - gathered.T @ gathered + beside.T @ (fit.solved @ beside)
        precision = fit.white.conditional_precisions() - np.sum(design * (fit.solved @ design), axis=0)
        self._learn(predicted, fit.weighted_residual, posterior, np.maximum(precision, 0.0), grown)

    def _learn(
        self, predicted: Prediction, weighted_residual: Array, p: Array, precision: Array, grown: Array | float = 1.0
    ) -> None:
        """p (N, N): posterior covariance of the states; precision (K,): of each measurement, all others given."""
        now, variance = self.now, predicted.remainder_variance
        now.x, now.p, now.at_s = predicted.x + predicted.cross_covariance * grown @ weighted_residual, p, predicted.at_s
        now.remainder = now.remainder + variance * grown * weighted_residual
        now.remainder_variance = variance * (1 - variance * grown**2 * precision)

    def more_memory(self) -> Array | None:
        """(K, K) covariance of memories that are as large as foam's may be; None where there is none."""
        memories = self.now.memories
        if not memories:
            return None
        columns = np.array([memory.most(self.now.at_s) * memory.column for memory in memories]).T
        return np.asarray(columns @ columns.T)

    def may_remember(self, weighted_residual: Array) -> bool:
        """Whether foam may remember as much as a residual says; weighted_residual (K,): S^-1 of it, S with
        `more_memory`. What one place remembers of several touches is no more than it may of the strongest.
        """
        memories = self.now.memories
        most = np.array([n.MEMORY_MOST * memory.action for memory in memories])
        states = self.now.x[self._fixed :].reshape(len(memories), STATES_OF_MEMORY)
        own = [self._own(place) for place in range(len(memories))]
        variance = np.array([float(self.now.p[each, each].sum()) for each in own]) + most**2
        share = states.sum(axis=1) + variance * (np.array([memory.column for memory in memories]) @ weighted_residual)
        return all(
            sum(share[k] for k in places) <= max(most[k] for k in places)
            for places in ([k for k, m in enumerate(memories) if m.at_place_of(memory)] for memory in memories)
        )

    def widen_memories(self) -> None:
        """They were larger than was expected."""
        now = self.now
        for place, memory in enumerate(now.memories):
            states = np.r_[self._own(place)]
            now.p[states, states] += (n.MEMORY_SD * memory.action) ** 2

    def remembers(self, at_s: float) -> bool:
        """Whether a touch went so lately that what it left may be one still."""
        return any(at_s - memory.at_s <= n.MEMORY_DOUBT_S for memory in self.now.memories)

    def remember(self, memory: Memory) -> None:
        """A touch went, or moved away."""
        now = self.now
        grown = np.exp(np.minimum(self._passed_s(memory.at_s) / FADES_S, 20.0))  # the filter stands before that
        now.x = np.concatenate([now.x, memory.action * n.MEMORY_SHARE * grown])
        now.p = block_diag(now.p, np.diag((memory.action * n.MEMORY_SD * grown) ** 2))
        now.memories.append(memory)

    def beyond_memory(self, predicted: Prediction, weighted_residual: Array, white: Whitening) -> Memory | None:
        """The memory that would have to be more than any foam's; weighted_residual (K,): S^-1 y."""
        for place, memory in enumerate(self.now.memories):
            age_s = predicted.at_s - memory.at_s
            if age_s > n.MEMORY_DOUBT_S or memory.mixed:
                continue
            own = self._own(place)
            reach = predicted.cross_covariance[own].sum(axis=0)
            remembered = float(predicted.x[own].sum() + reach @ weighted_residual)
            whitened = white(reach)
            variance = float(predicted.p[own, own].sum() - whitened @ whitened)
            if remembered > memory.most(predicted.at_s) + n.SIGMAS * np.sqrt(max(variance, 0.0)):
                return memory
        return None

    def _passed_s(self, at_s: float) -> float:
        return max(0.0, at_s - self.now.at_s)

    def _own(self, place: int) -> slice:
        first = self._fixed + STATES_OF_MEMORY * place
        return slice(first, first + STATES_OF_MEMORY)

    def _moved_mean(self, passed_s: float) -> Array:
        """(N,) of the states, after so many seconds."""
        x = self.now.x.copy()
        x[FIELD] += passed_s * x[RATES]
        x[self._fixed :] *= np.tile(np.exp(-passed_s / FADES_S), len(self.now.memories))
        return x

    def _moved(self, passed_s: float, flicker: Array) -> tuple[Array, Array]:
        x, p = self._moved_mean(passed_s), self.now.p.copy()
        p[FIELD] += passed_s * p[RATES]
        p[:, FIELD] += passed_s * p[:, RATES]
        modes = np.arange(MODES)
        p[modes, modes + MODES] += self._rate_walk * passed_s**2 / 2
        p[modes + MODES, modes] += self._rate_walk * passed_s**2 / 2
        grown = np.zeros(len(x))
        grown[FIELD] = self._value_walk * passed_s + self._rate_walk * passed_s**3 / 3
        grown[RATES] = self._rate_walk * passed_s
        grown[self.contacts] = (n.CONTACT_WALK**2 + n.CONTACT_FOLLOWS * flicker) * passed_s
        memories, fades_s = slice(self._fixed, None), np.tile(FADES_S, len(self.now.memories))
        fade = np.exp(-passed_s / fades_s)
        p[memories] *= fade[:, None]
        p[:, memories] *= fade
        grown[memories] = (n.MEMORY_WALK * x[memories]) ** 2 * passed_s / fades_s
        p[np.diag_indices_from(p)] += grown
        return x, p

    def _columns(self) -> tuple[Array, Indices]:
        """(K, S) of the states that are seen, and (S,) their places."""
        if not self.now.memories:
            return self._lasting, self._lasting_seen
        memories = [memory.column for memory in self.now.memories for _ in range(STATES_OF_MEMORY)]
        seen = np.r_[self._lasting_seen, self._fixed : len(self.now.x)]
        return np.hstack([self._lasting, np.array(memories).T]), seen

    def _forget_the_faint(self) -> None:
        """Memories that no scan shows any more, and the oldest of too many, become each measurement's own remainder."""
        now = self.now
        for place in reversed(range(len(now.memories))):
            memory, own = now.memories[place], self._own(place)
            share, variance = float(now.x[own].sum()), max(0.0, float(now.p[own, own].sum()))
            size = float(np.linalg.norm(memory.column)) / n.WHITE * np.sqrt(max(share**2, variance))
            if size >= n.MEMORY_FAINT and place >= len(now.memories) - n.MEMORIES:
                continue
            now.remainder = now.remainder + memory.column * share
            now.remainder_variance = now.remainder_variance + memory.column**2 * variance
            others = np.r_[0 : own.start, own.stop : len(now.x)]
            now.x, now.p = now.x[others], now.p[np.ix_(others, others)]
            del now.memories[place]


def _by_degree(even: float, sloped: float) -> Array:
    """(M,) variances of the field's modes: a mode of degree d has a d-th of what a slope has."""
    return np.array([even if not degree else sloped / degree for degree in FIELD_DEGREES]) ** 2
