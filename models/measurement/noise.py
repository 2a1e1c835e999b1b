"""Noise of log |Z|: white, of each contact impedance, and what disturbs several measurements; learnt from what models
leave.

Of a contact impedance some noise is common to a scan (flicker), some is new with each measurement (jitter).

Lines: what disturbs several measurements of a scan at once, and goes on into the next one.

A line has any phase, so of a scan it is two fixed columns, whatever its frequency and however strongly each electrode
picks it up: the strongest eigenvectors of the residuals' covariance, beyond what chance makes of white noise
(V. Marchenko and L. Pastur, 1967). What stays from scan to scan is no line: it is a touch that comes slowly, or drift
that nothing has taken in.

They are learnt of scans that end with one part. Scans that end with another are made of two of those, one after the
other: some measurements of the older, the rest of the newer. How a line's share of one scan follows from that of the
scan before (`turn`: for a steady frequency a rotation) is learnt too, and tells the columns of all the others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from models.measurement import numbers as n
from models.measurement.arrays import Array, Indices
from models.measurement.tables import SkinTables
from models.measurement.whitening import Whitening

Order = Indices

BURST_BLOCK = int(n.BURST_BLOCK)
ROUNDS = 10  # of learning from the frames of a tare
FIRST_LINES = (16, 32, 64)  # scans after which lines are made for the first times
FOLLOWS = 1.5  # scans: one that comes no later than that after another follows it


@dataclass
class LineState:
    """All that changes."""

    part: int  # scans that end with it are learnt from
    scatter: Annotated[Array, "K", "K"]  # mean square of residuals
    alternates: Annotated[Array, "K", "K"]  # half the mean square of their steps from one scan to the next
    follows: Annotated[Array, "K", "K"]  # mean product of a scan's residuals with those of the scan before
    columns: Annotated[Array, "K", "n"]
    turn: Annotated[Array, "n", "n"]  # correlation of the columns' amplitudes with those of the scan before
    scans: int = 0  # that it has learnt from
    followed: int = 0  # of them, that came right after another
    elsewhere: int = 0  # scans that ended with other parts, since
    due: bool = False  # the columns are to be made anew
    before: Annotated[Array | None, "K"] = None  # residual of a scan that its step is to be taken from
    before_odd: Annotated[Array | None, "K"] = None  # the same of one that was disturbed by more than was known
    before_s: float = -np.inf
    before_odd_s: float = -np.inf
    orders: dict[int, Annotated[Order, "K"]] = field(default_factory=dict)  # rank in time, by the part measured last

    @classmethod
    def of(cls, measurements: int, part: int = 0) -> LineState:
        nothing = np.zeros((measurements, measurements))
        return cls(part, nothing, nothing.copy(), nothing.copy(), np.zeros((measurements, 0)), np.zeros((0, 0)))

    def take(self, left: Array, odd: bool, at_s: float, span_s: float) -> bool:
        """A residual (K,). Two of scans that were explained alike make a step: whether this one did."""
        _blend(self.scatter, max(1 / (self.scans + 1), float(n.LEARNING_LINES)), left, left)
        self.scans += 1
        self.due = self.due or odd or self.scans in FIRST_LINES or self.scans % n.LINE_SCANS == 0
        before, before_s = (self.before_odd, self.before_odd_s) if odd else (self.before, self.before_s)
        if before is not None:
            step = left - before
            share = min(1.0, max(2 / self.scans, 2 * float(n.LEARNING_LINES)))
            _blend(self.alternates, share, step / 2, step)
            if 0 < at_s - before_s < FOLLOWS * span_s:
                self.followed += 1
                _blend(self.follows, max(1 / self.followed, 2 * float(n.LEARNING_LINES)), left, before)
        kept = None if before is not None else left
        if odd:
            self.before_odd, self.before_odd_s = kept, at_s
        else:
            self.before, self.before_s = kept, at_s
        return before is not None

    def make(self, white: float) -> None:
        """The columns anew; white: variance of what disturbs one measurement alone."""
        self.due, self.before, self.before_odd = False, None, None  # with other columns residuals are others
        k = len(self.scatter)
        values, vectors = np.linalg.eigh(self.scatter)
        chance = white * n.LINE * (1 + np.sqrt(k / min(self.scans, 1 / n.LEARNING_LINES))) ** 2
        strong = values > chance
        strong[: -int(n.LINES)] = False
        columns, beyond = vectors[:, strong], values[strong] - white
        alternates = np.einsum("kn,kl,ln->n", columns, self.alternates, columns) - white
        self.columns = columns * np.sqrt(np.minimum(beyond, n.ALTERNATES * np.maximum(alternates, 0.0)))
        scale = np.sqrt(beyond)
        u, s, v = np.linalg.svd(columns.T @ self.follows @ columns / scale[:, None] / scale)
        self.turn = (u * np.minimum(s, 1.0)) @ v


def _blend(mean: Array, share: float, a: Array, b: Array) -> None:
    """Take a product of vectors (K,) into its mean (K, K)."""
    mean *= 1 - share
    mean += np.outer(share * a, b)


class Lines:
    """Of one skin."""

    def __init__(self, measurements: int) -> None:
        self.now = LineState.of(measurements)
        self._made: dict[int, tuple[Array, Order, Order, Array]] = {}  # by part: of which columns and orders, and what

    def ordered(self, part: int, order: Order) -> None:
        """In which order (K,) the measurements of a scan were taken that ends with this part."""
        known = self.now.orders.get(part)
        if known is None or not np.array_equal(known, order):
            self.now.orders[part] = order

    def columns(self, part: int) -> Array:
        """(K, n) of scans that end with this part; n = 0 where nothing is known of them."""
        known = self.now.columns
        if part == self.now.part or not known.shape[1]:
            return known
        own, order = self.now.orders.get(part), self.now.orders.get(self.now.part)
        if own is None or order is None:
            return known[:, :0]
        made = self._made.get(part)
        if made is None or made[0] is not known or made[1] is not own or made[2] is not order:
            made = self._made[part] = known, own, order, self._of_two(own, order)
        return made[3]

    def _of_two(self, own: Order, order: Order) -> Array:
        """(K, n) of scans of this order, each of which is the end of one that is learnt from and the begin of the next;
        n = 0 where it is not: parts were lost. order: of those that are learnt from.
        """
        columns = self.now.columns
        if len(set(((own - order) % len(own)).tolist())) > 1:
            return columns[:, :0]
        newer = (own > order)[:, None]
        u, s, _ = np.linalg.svd(self.now.turn)
        after = np.where(newer, columns, 0.0)
        beyond = u * np.sqrt(np.maximum(1 - s**2, 0.0))  # what the older one does not tell of the newer
        return np.column_stack([np.where(newer, 0.0, columns) + after @ self.now.turn, after @ beyond])

    def update(self, left: Array, part: int, odd: bool, at_s: float, span_s: float) -> bool:
        """Take note of the residual (K,) of an untouched scan. odd: it was disturbed by more than was known. Returns
        whether the columns are to be made anew.
        """
        if part != self.now.part:
            self.now.elsewhere += 1
            if self.now.scans and self.now.elsewhere < n.ELSEWHERE:
                return False
            columns, orders = self.columns(part), self.now.orders
            self.now = LineState.of(len(columns), part)  # until it tells lines, what is known of such scans holds
            self.now.columns, self.now.turn, self.now.orders = columns, np.zeros((columns.shape[1],) * 2), orders
        self.now.elsewhere = 0
        return self.now.take(left, odd, at_s, span_s) and self.now.due

    def restart(self, rows: Array, part: int, white: float) -> None:
        """The same of untouched scans (n, K) that follow each other: what was known before is forgotten."""
        self.now.scans = self.now.followed = 0  # the first of them replaces all
        for at, row in enumerate(rows):
            self.update(row, part, False, float(at), 1.0)
        self.now.make(white)


@dataclass
class NoiseState:
    """All that changes. Variances are relative to |Z|, squared."""

    white: float
    flicker: Annotated[Array, "E"]  # of a contact impedance, common to a scan
    jitter: Annotated[Array, "E"]  # of a contact impedance, new with each measurement
    jumps: Annotated[Array, "E"]  # of a contact impedance that jumps: its flicker at least


class NoiseModel:
    """Of one skin."""

    def __init__(self, tables: SkinTables) -> None:
        self._contact = tables.contact
        self._squares = tables.contact**2
        self._weight = np.maximum((self._squares**2).sum(axis=0), n.TINY)
        e = tables.electrodes
        self.now = NoiseState(float(n.WHITE**2), np.full(e, n.FLICKER_FLOOR**2), np.zeros(e), np.zeros(e))
        self.lines = Lines(tables.measurements)

    def begin(self, residuals: Array, parts: tuple[int, ...]) -> None:
        """Learn from untouched frames (n, K) less their mean; parts (n,): with which each ended. Where one came late,
        those after it end with another: what disturbs them is learnt of those that end alike, the most.
        """
        part = max(set(parts), key=parts.count)
        alike = np.array(parts) == part
        steps = np.diff(residuals, axis=0)
        self.now.white = max(float(np.median(steps**2)) / 2 / n.MEDIAN_OF_SQUARES, float(n.RESPONSE_FLOOR**2))
        for round_ in range(ROUNDS):
            white = Whitening.of(self.covariance(part))
            weighted_residual = white.solve(residuals.T).T  # (n, K) S^-1 e
            self.learn_contacts(weighted_residual, white, 0.5)
            energy = float(np.median(weighted_residual**2 / white.conditional_precisions())) / n.MEDIAN_OF_SQUARES
            self.now.white *= min(max(energy, 0.5), 2.0)
            if round_ >= ROUNDS // 2:
                self.lines.restart(self._left(weighted_residual[alike], part), part, self.now.white)

    def variances(self) -> Array:
        """(K,) of what is independent from measurement to measurement."""
        now = self.now
        return np.asarray(now.white + n.RESPONSE_FLOOR**2 + self._squares @ now.jitter)

    def alike(self, part: int) -> int:
        """The same number for all parts whose scans are disturbed alike: 0 where nothing disturbs them."""
        return part if self.lines.columns(part).shape[1] else 0

    def covariance(self, part: int) -> Array:
        """(K, K) of a scan that ends with this part."""
        columns = np.column_stack([self._contact * np.sqrt(self.now.flicker), self.lines.columns(part)])
        made: Array = columns @ columns.T
        made[np.diag_indices_from(made)] += self.variances()
        return made

    def learn(self, weighted_residual: Array, white: Whitening) -> None:
        """Follow the noise of one untouched frame that was explained: weighted_residual = S^-1 y (K,)."""
        self.learn_contacts(weighted_residual, white)
        excess = self._excess(weighted_residual, white.conditional_precisions())
        steady = self._squares @ self.now.jitter < 0.2 * self.now.white
        if steady.any():
            level = self.now.white
            followed = level + n.LEARNING_WHITE * float(excess[steady].mean())
            self.now.white = float(np.clip(followed, n.WHITE_FALLS * level, level / n.WHITE_FALLS))

    def update(self, weighted_residual: Array, part: int, odd: bool, at_s: float, span_s: float) -> None:
        """Take note of what several measurements of a frame have in common beside drift and contacts: weighted_residual
        (K,) is S^-1 of its residual. odd: more than was known.
        """
        if self.lines.update(self._left(weighted_residual, part), part, odd, at_s, span_s):
            self.lines.now.make(self.now.white)

    def _left(self, weighted_residual: Array, part: int) -> Array:
        """(..., K) the likeliest white noise and disturbance, of S^-1 y."""
        columns = self.lines.columns(part)
        return np.asarray(self.variances() * weighted_residual + (weighted_residual @ columns) @ columns.T)

    def learn_contacts(self, weighted_residual: Array, white: Whitening, share: float = n.LEARNING) -> None:
        """Follow the contacts' noise alone, as far as a touch that is there leaves it to be seen; weighted_residual
        (K,) or (n, K). Unbiased moments: the generalised least squares estimate of a contact's change has variance
        v + 1 / n, with n its information.
        """
        weighted_residual, columns = np.atleast_2d(weighted_residual), white(self._contact)
        information = np.maximum((columns**2).sum(axis=0), n.TINY)
        moved = (weighted_residual @ self._contact / information) ** 2
        moved = np.minimum(moved, n.OUTLIER / information + n.OUTLIER * self.now.flicker).mean(axis=0)
        least = np.maximum(n.FLICKER_FLOOR**2, self.now.jumps)
        self.now.flicker = np.maximum(least, self.now.flicker + share * (moved - 1 / information))
        excess = self._excess(weighted_residual, white.conditional_precisions()).mean(axis=0)
        jitter = self.now.jitter + share * (self._squares * excess[:, None]).sum(axis=0) / self._weight
        self.now.jitter = np.where(jitter > n.JITTER_FLOOR**2, jitter, 0.0)

    def _excess(self, weighted_residual: Array, precision: Array) -> Array:
        """By how much each measurement's squared residual, given all others, exceeds its variance."""
        return np.asarray(np.minimum((weighted_residual / precision) ** 2, n.OUTLIER / precision) - 1 / precision)


def in_blocks(columns: Array, order: Order, times: float) -> Array:
    """(K, K) covariance of a disturbance that is `times` as strong and comes and goes within a scan: each block of
    measurements has its own.
    """
    block = order // BURST_BLOCK
    return np.asarray((columns @ columns.T) * (times**2 * (block[:, None] == block)))
