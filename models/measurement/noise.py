"""Noise of log |Z|: white, of each contact impedance, and what disturbs several measurements; learnt from what models
leave.

Of a contact impedance some noise is common to a scan (flicker), some is new with each measurement (jitter). A line that
disturbs has any phase, so of a scan it is two fixed columns, whatever its frequency and however strongly each electrode
picks it up: the strongest eigenvectors of the residuals' covariance, beyond what chance makes of white noise
(V. Marchenko and L. Pastur, 1967). What stays from scan to scan is no line: it is a touch that comes slowly, or drift
that nothing has taken in. After each part of a scan the columns are others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from models.measurement.numbers import (
    ALTERNATES,
    FLICKER_FLOOR,
    JITTER_FLOOR,
    LEARNING,
    LEARNING_LINES,
    LEARNING_WHITE,
    LINE,
    LINES,
    OUTLIER,
    RESPONSE_FLOOR,
    WHITE,
)
from models.measurement.tables import SkinTables
from models.measurement.whitening import Whitening

Array = NDArray[np.float64]
Order = NDArray[np.intp]

BURST_BLOCK = 12  # measurements that share one strength of a disturbance that comes and goes
MEDIAN_OF_SQUARES = 0.455  # of a standard normal variable
ROUNDS = 10  # of learning from the frames of a tare
FIRST_LINES = (16, 32, 64)  # scans heard, at which lines are made for the first times
LINE_SCANS = 100  # untouched scans after which they are made anew: half of those that are learnt from
STEADY_CONTACTS = 40  # measurements whose contacts are quiet enough to tell the white noise


@dataclass
class LineState:
    """Of scans that end with one part."""

    scatter: Annotated[Array, "K", "K"]  # mean square of residuals
    alternates: Annotated[Array, "K", "K"]  # half the mean square of their steps from one scan to the next
    columns: Annotated[Array, "K", "n"]
    heard: int = 0  # scans
    due: bool = False  # the lines are to be made anew
    before: Annotated[Array | None, "K"] = None  # residual of a scan that its step is to be taken from
    before_odd: Annotated[Array | None, "K"] = None  # the same of one that was disturbed by more than was known

    @classmethod
    def of(cls, measurements: int) -> LineState:
        nothing = np.zeros((measurements, measurements))
        return cls(nothing, nothing.copy(), np.zeros((measurements, 0)))

    def take_step(self, left: Array, odd: bool) -> bool:
        """Residuals of two scans that were explained alike make a step: whether this one (K,) did."""
        before = self.before_odd if odd else self.before
        if before is not None:
            step = left - before
            share = min(1.0, max(2 / self.heard, 2 * float(LEARNING_LINES)))
            self.alternates *= 1 - share
            self.alternates += np.outer(share / 2 * step, step)
        kept = None if before is not None else left
        if odd:
            self.before_odd = kept
        else:
            self.before = kept
        return before is not None


@dataclass
class NoiseState:
    """All that changes. Variances are relative to |Z|, squared."""

    white: float
    flicker: Annotated[Array, "E"]  # of a contact impedance, common to a scan
    jitter: Annotated[Array, "E"]  # of a contact impedance, new with each measurement
    lines: dict[int, LineState] = field(default_factory=dict)  # by the part measured last, 0: whole scans


class NoiseModel:
    """Of one skin."""

    def __init__(self, tables: SkinTables) -> None:
        self._contact = tables.contact
        self._squares = tables.contact**2
        self._weight = np.maximum((self._squares**2).sum(axis=0), 1e-12)
        e = tables.electrodes
        self.now = NoiseState(float(WHITE**2), np.full(e, FLICKER_FLOOR**2), np.zeros(e))

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
            pulled = white.solve(residuals.T).T  # (n, K) S^-1 e
            self._follow_contacts(pulled, white, 1 / 2)
            energy = float(np.median(pulled**2 / white.conditional_precisions())) / MEDIAN_OF_SQUARES
            self.now.white *= min(max(energy, 0.5), 2.0)
            if n >= ROUNDS // 2:
                self._hear_anew(pulled[alike], part)

    def variances(self) -> Array:
        """(K,) of what is independent from measurement to measurement."""
        now = self.now
        return np.asarray(now.white + RESPONSE_FLOOR**2 + self._squares @ now.jitter)

    def disturbing(self, part: int) -> Array:
        """(K, n) columns of the lines."""
        known = self.now.lines.get(part)
        return np.zeros((len(self._contact), 0)) if known is None else known.columns

    def alike(self, part: int) -> int:
        """The same number for all parts whose scans are disturbed alike: 0 where nothing disturbs them."""
        return part if self.disturbing(part).shape[1] else 0

    def covariance(self, part: int) -> Array:
        """(K, K) of a scan that ends with this part."""
        columns = np.column_stack([self._contact * np.sqrt(self.now.flicker), self.disturbing(part)])
        made: Array = columns @ columns.T
        made[np.diag_indices_from(made)] += self.variances()
        return made

    def learn(self, pulled: Array, white: Whitening) -> None:
        """Follow the noise of one untouched frame that was explained: pulled = S^-1 y (K,)."""
        self._follow_contacts(pulled[None], white, LEARNING)
        excess = self._excess(pulled, white.conditional_precisions())
        steady = self._squares @ self.now.jitter < 0.2 * self.now.white
        if steady.sum() >= STEADY_CONTACTS:
            change = LEARNING_WHITE * float(excess[steady].mean())
            self.now.white = float(np.clip(self.now.white + change, 0.8 * self.now.white, 1.25 * self.now.white))

    def learn_contacts(self, pulled: Array, white: Whitening) -> None:
        """Follow the contacts' noise alone, as far as a touch that is there leaves it to be seen."""
        self._follow_contacts(pulled[None], white, LEARNING)

    def hear(self, pulled: Array, part: int, odd: bool = False) -> None:
        """Take note of what several measurements of a frame have in common beside drift and contacts: pulled (K,) is
        S^-1 of its residual, so this is the likeliest white noise and disturbance. odd: more than was known.
        """
        if self._note(pulled, part, odd):
            self.find_lines(part)

    def _note(self, pulled: Array, part: int, odd: bool) -> bool:
        """Whether lines are to be made anew."""
        known = self.now.lines.setdefault(part, LineState.of(len(pulled)))
        left = self.variances() * pulled + known.columns @ (known.columns.T @ pulled)
        share = max(1 / (known.heard + 1), float(LEARNING_LINES))
        known.scatter *= 1 - share
        known.scatter += np.outer(share * left, left)
        known.heard += 1
        known.due = known.due or odd or known.heard in FIRST_LINES or known.heard % LINE_SCANS == 0
        return known.take_step(left, odd) and known.due

    def _hear_anew(self, pulled: Array, part: int) -> None:
        if part in self.now.lines:
            self.now.lines[part].heard = 0  # the first that is heard replaces all
        for row in pulled:
            self._note(row, part, odd=False)
        self.find_lines(part)

    def find_lines(self, part: int) -> None:
        """Make the lines of such scans anew."""
        known = self.now.lines.get(part)
        if known is None or not known.heard:
            return
        known.due, known.before, known.before_odd = False, None, None  # with other lines residuals are others
        k = len(known.scatter)
        values, vectors = np.linalg.eigh(known.scatter)
        scans = min(known.heard, 1 / LEARNING_LINES)
        chance = self.now.white * LINE * (1 + np.sqrt(k / scans)) ** 2
        strong = values > chance
        strong[: -int(LINES)] = False
        columns = vectors[:, strong]
        alternates = np.einsum("kn,kl,ln->n", columns, known.alternates, columns) - self.now.white
        strength = np.minimum(values[strong] - self.now.white, ALTERNATES * np.maximum(alternates, 0.0))
        known.columns = columns * np.sqrt(strength)

    def _follow_contacts(self, pulled: Array, white: Whitening, share: float) -> None:
        """Unbiased moments: the generalised least squares estimate of a contact's change has variance v + 1 / n, with
        n its information.
        """
        columns = white(self._contact)
        information = np.maximum((columns**2).sum(axis=0), 1e-12)
        moved = (pulled @ self._contact / information) ** 2
        flicker = np.minimum(moved, OUTLIER / information + OUTLIER * self.now.flicker).mean(axis=0) - 1 / information
        self.now.flicker = np.maximum(FLICKER_FLOOR**2, self.now.flicker + share * flicker)
        excess = self._excess(pulled, white.conditional_precisions()).mean(axis=0)
        jitter = self.now.jitter + share * (self._squares * excess[:, None]).sum(axis=0) / self._weight
        self.now.jitter = np.where(jitter > JITTER_FLOOR**2, jitter, 0.0)

    def _excess(self, pulled: Array, precision: Array) -> Array:
        """By how much each measurement's squared residual, given all others, exceeds its variance."""
        return np.asarray(np.minimum((pulled / precision) ** 2, OUTLIER / precision) - 1 / precision)


def in_blocks(columns: Array, order: Order, times: float) -> Array:
    """(K, K) covariance of a disturbance that is `times` as strong and comes and goes within a scan: each block of
    measurements has its own.
    """
    block = order // BURST_BLOCK
    return np.asarray((columns @ columns.T) * (times**2 * (block[:, None] == block)))
