"""Noise of log |Z|: white, of each contact impedance, and what disturbs several measurements; learnt from what models
leave.

Of a contact impedance some noise is common to a scan (flicker), some is new with each measurement (jitter).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.covariance.lines import Lines, Order
from models.measurement.covariance.whitening import Whitening
from models.measurement.numbers import (
    FLICKER_FLOOR,
    JITTER_FLOOR,
    LEARNING,
    LEARNING_WHITE,
    OUTLIER,
    RESPONSE_FLOOR,
    WHITE,
)
from models.measurement.responses.tables import SkinTables

Array = NDArray[np.float64]

BURST_BLOCK = 12  # measurements that share one strength of a disturbance that comes and goes
MEDIAN_OF_SQUARES = 0.455  # of a standard normal variable
ROUNDS = 10  # of learning from the frames of a tare
STEADY_CONTACTS = 40  # measurements whose contacts are quiet enough to tell the white noise


@dataclass
class NoiseState:
    """All that changes. Variances are relative to |Z|, squared."""

    white: float
    flicker: Annotated[Array, "E"]  # of a contact impedance, common to a scan
    jitter: Annotated[Array, "E"]  # of a contact impedance, new with each measurement


class NoiseModel:
    """Of one skin."""

    def __init__(self, tables: SkinTables) -> None:
        self._contact = tables.contact
        self._squares = tables.contact**2
        self._weight = np.maximum((self._squares**2).sum(axis=0), 1e-12)
        e = tables.electrodes
        self.now = NoiseState(float(WHITE**2), np.full(e, FLICKER_FLOOR**2), np.zeros(e))
        self.lines = Lines(tables.measurements)

    def begin(self, residuals: Array, parts: tuple[int, ...]) -> None:
        """Learn from untouched frames (n, K) less their mean; parts (n,): with which each ended. Where one came late,
        those after it end with another: what disturbs them is learnt of those that end alike, the most.
        """
        part = max(set(parts), key=parts.count)
        alike = np.array(parts) == part
        steps = np.diff(residuals, axis=0)
        self.now.white = max(float(np.median(steps**2)) / 2 / MEDIAN_OF_SQUARES, float(RESPONSE_FLOOR**2))
        for n in range(ROUNDS):
            white = Whitening.of(self.covariance(part))
            weighted_residual = white.solve(residuals.T).T  # (n, K) S^-1 e
            self._follow_contacts(weighted_residual, white, 1 / 2)
            energy = float(np.median(weighted_residual**2 / white.conditional_precisions())) / MEDIAN_OF_SQUARES
            self.now.white *= min(max(energy, 0.5), 2.0)
            if n >= ROUNDS // 2:
                self.lines.hear_anew(self._left(weighted_residual[alike], part), part, self.now.white)

    def variances(self) -> Array:
        """(K,) of what is independent from measurement to measurement."""
        now = self.now
        return np.asarray(now.white + RESPONSE_FLOOR**2 + self._squares @ now.jitter)

    def disturbing(self, part: int) -> Array:
        """(K, n) columns of the lines of a scan that ends with this part."""
        return self.lines.columns(part)

    def alike(self, part: int) -> int:
        """The same number for all parts whose scans are disturbed alike: 0 where nothing disturbs them."""
        return part if self.disturbing(part).shape[1] else 0

    def covariance(self, part: int) -> Array:
        """(K, K) of a scan that ends with this part."""
        columns = np.column_stack([self._contact * np.sqrt(self.now.flicker), self.disturbing(part)])
        made: Array = columns @ columns.T
        made[np.diag_indices_from(made)] += self.variances()
        return made

    def learn(self, weighted_residual: Array, white: Whitening) -> None:
        """Follow the noise of one untouched frame that was explained: weighted_residual = S^-1 y (K,)."""
        self._follow_contacts(weighted_residual[None], white, LEARNING)
        excess = self._excess(weighted_residual, white.conditional_precisions())
        steady = self._squares @ self.now.jitter < 0.2 * self.now.white
        if steady.sum() >= STEADY_CONTACTS:
            change = LEARNING_WHITE * float(excess[steady].mean())
            self.now.white = float(np.clip(self.now.white + change, 0.8 * self.now.white, 1.25 * self.now.white))

    def learn_contacts(self, weighted_residual: Array, white: Whitening) -> None:
        """Follow the contacts' noise alone, as far as a touch that is there leaves it to be seen."""
        self._follow_contacts(weighted_residual[None], white, LEARNING)

    def hear(self, weighted_residual: Array, part: int, odd: bool, at_s: float, span_s: float) -> None:
        """Take note of what several measurements of a frame have in common beside drift and contacts: weighted_residual
        (K,) is S^-1 of its residual. odd: more than was known.
        """
        if self.lines.hear(self._left(weighted_residual, part), part, odd, at_s, span_s):
            self.lines.now.make(self.now.white)

    def _left(self, weighted_residual: Array, part: int) -> Array:
        """(..., K) the likeliest white noise and disturbance, of S^-1 y."""
        columns = self.disturbing(part)
        return np.asarray(self.variances() * weighted_residual + (weighted_residual @ columns) @ columns.T)

    def _follow_contacts(self, weighted_residual: Array, white: Whitening, share: float) -> None:
        """Unbiased moments: the generalised least squares estimate of a contact's change has variance v + 1 / n, with
        n its information.
        """
        columns = white(self._contact)
        information = np.maximum((columns**2).sum(axis=0), 1e-12)
        moved = (weighted_residual @ self._contact / information) ** 2
        flicker = np.minimum(moved, OUTLIER / information + OUTLIER * self.now.flicker).mean(axis=0) - 1 / information
        self.now.flicker = np.maximum(FLICKER_FLOOR**2, self.now.flicker + share * flicker)
        excess = self._excess(weighted_residual, white.conditional_precisions()).mean(axis=0)
        jitter = self.now.jitter + share * (self._squares * excess[:, None]).sum(axis=0) / self._weight
        self.now.jitter = np.where(jitter > JITTER_FLOOR**2, jitter, 0.0)

    def _excess(self, weighted_residual: Array, precision: Array) -> Array:
        """By how much each measurement's squared residual, given all others, exceeds its variance."""
        return np.asarray(np.minimum((weighted_residual / precision) ** 2, OUTLIER / precision) - 1 / precision)


def in_blocks(columns: Array, order: Order, times: float) -> Array:
    """(K, K) covariance of a disturbance that is `times` as strong and comes and goes within a scan: each block of
    measurements has its own.
    """
    block = order // BURST_BLOCK
    return np.asarray((columns @ columns.T) * (times**2 * (block[:, None] == block)))
