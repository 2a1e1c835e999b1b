"""Contact impedances that change by more than the filter follows, and the board's gain.

An electrode's contact is a resistance along its width. Of its change by a share `a` the part in series with the sheet
grows by a; the rest, by which the electrode shunts the sheet, by b = a / (1 + a / SHORT_WAY), give or take. While a
scan is measured the change may grow. With U and N the columns of the two (K, E), u from -1 to 1 over the scan:

    log z = log z0 + log(1 + touches + U a + N (b + e) + u U s)

The likeliest (a, e, s) of a few electrodes and their log evidence come from some Gauss-Newton steps, all of them at
once: those that explain most where the law is a straight line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from models.measurement.arrays import Array, Indices, Mask
from models.measurement.fit import LEAST_MEAN
from models.measurement.numbers import SUDDEN_SD
from models.measurement.tables import SkinTables
from models.measurement.whitening import Whitening
from services.estimation.values import numbers as n

STEPS = 3
MOST_LOG = float(np.log(n.FAR))  # of an impedance over its prediction: beyond, nothing is told any more
SIZE, SHUNT, COURSE = 0, 1, 2  # of a change: a, e and s
GAIN = -1  # in place of an electrode


@dataclass(frozen=True)
class Change:
    """Of a contact impedance or of the gain, in one scan."""

    electrode: int  # GAIN: it is the board's gain
    size: float  # relative, of the contact impedance; logarithm of the gain's factor
    variance: float  # of it
    since_s: float  # it acts from then on, from the middle of the scan
    score: float  # log evidence, without a prior of the fault
    chi2: float  # squared whitened residual a measurement that counts

    @property
    def is_gain(self) -> bool:
        return self.electrode == GAIN

    @property
    def log_prior(self) -> float:
        return float(n.LOG_PRIOR_GAIN if self.is_gain else n.LOG_PRIOR_CONTACT)


@dataclass(frozen=True)
class Unexplained:
    """One scan as faults are asked about it."""

    y: Array  # (K,) log |Z| over what is predicted, touches that stand included; 0 where a measurement does not count
    share: Array  # (K,) of the prediction that is the untouched skin: 1 / (1 + touches)
    live: Mask
    times_s: Array  # (K,) from the middle of the scan
    span_s: float
    white: Whitening

    def since(self, begins_s: float) -> Array:
        """(K,) 1 where a value was measured since then, and counts."""
        return np.asarray(self.live & (self.times_s >= begins_s), float)


@dataclass(frozen=True)
class ContactColumns:
    """What changed contacts do to the measurements of one skin, relative to its |Z| at the tare. A change is what is
    beside those that the skin has for good by now.
    """

    series: Array  # (K, E) of the contacts' part in series with the sheet
    shunt: Array  # (K, E) of the rest
    settled: Array  # (E,) changes that the skin has for good

    @classmethod
    def of(cls, tables: SkinTables) -> ContactColumns:
        return cls(tables.series, tables.contact - tables.series, np.zeros(tables.electrodes))

    def through(self, slopes: Array) -> ContactColumns:
        """The same through wires that are exchanged; slopes (K, K)."""
        return ContactColumns(slopes @ self.series, slopes @ self.shunt, self.settled)

    def with_change(self, electrode: int, size: float) -> ContactColumns:
        """The same of the skin whose contact has changed for good."""
        settled = self.settled.copy()
        settled[electrode] += size
        return ContactColumns(self.series, self.shunt, settled)

    def settled_mean(self) -> Array:
        """(K,) relative change of |Z| since the tare."""
        return np.asarray(self.series @ self.settled + self.shunt @ _shunt(self.settled))

    def mean(self, electrode: int, size: float) -> Array:
        """(K,) relative change of |Z|."""
        shunt = _shunt_of(size, self.settled[electrode])
        return np.asarray(self.series[:, electrode] * size + self.shunt[:, electrode] * shunt)

    def spread(self, electrode: int, size: float, sd: float, course: Array) -> Array:
        """(K, 3) columns of unit variance of what is not known of a change; course (K,): -1 to 1 over the scan."""
        shunt, settled = self.shunt[:, electrode], self.settled[electrode]
        moved = (self.series[:, electrode] + shunt * _shunt_slope(size, settled)) * sd
        return np.column_stack([moved, shunt * _shunt_sd(size, settled), moved * course])

    def begins(self, electrode: int, size: float, since_s: float, times_s: Array) -> Array:
        """(K,) standard deviation of the values about an instant since which a contact has changed: it lies between two
        that tell of it, either of which may have seen any share. times_s (K,): on the clock of since_s.
        """
        mean = np.abs(self.mean(electrode, size))
        tells = mean > 0.5 * mean.max()
        before, after = times_s[tells & (times_s < since_s)], times_s[tells & (times_s >= since_s)]
        if not (before.size and after.size):
            return np.zeros(len(times_s))
        return np.where((times_s >= before.max()) & (times_s <= after.min()), SUDDEN_SD * mean, 0.0)

    def taken_off(self, y: Array, acts: Array, course: Array, change: Change) -> tuple[Array, Array]:
        """log |Z| without a change, whatever touches, (K,); and (K, 3) columns of unit variance of the prior: as wide
        as a change can be, about none. acts (K,): 1 where it acts; course (K,): -1 to 1 over the scan.
        """
        k, size = change.electrode, change.size
        left = np.log1p(np.maximum(np.expm1(np.minimum(y, MOST_LOG)) - self.mean(k, size) * acts, LEAST_MEAN))
        columns = self.spread(k, size, n.CONTACT_CHANGES, course)
        columns[:, 2] *= max(n.COURSE_FLOOR, abs(size)) / n.CONTACT_CHANGES
        columns *= (acts * np.exp(-left))[:, None]
        return left + columns[:, 0] * size / n.CONTACT_CHANGES, columns

    def likeliest(self, scan: Unexplained) -> list[Change]:
        """The likeliest changes of contacts, be it before the scan or from some value of it on."""
        count = len(self.settled)
        electrodes, always = np.tile(np.arange(count), 2), np.full(count, -np.inf)
        begin_s = np.concatenate([always, _onsets(scan, (self.series + self.shunt) * scan.share[:, None])])
        columns, settled = self._acting(scan, electrodes, begin_s), self.settled[electrodes]
        x, explains = self._first(scan, columns, settled)
        leaves = np.sum(scan.white(_left(scan, _changed(columns, x, settled)).T) ** 2, axis=0)
        few = int(n.CONTACTS_EXACT) // 2
        best = np.unique([np.argsort(each, kind="stable")[:few] for each in (-explains, leaves)])
        return self.changes(scan, electrodes[best], begin_s[best])

    def changes(self, scan: Unexplained, electrodes: Indices, begin_s: Array) -> list[Change]:
        """Of each of n electrodes the likeliest change since then (n,), with its evidence."""
        columns, settled = self._acting(scan, electrodes, begin_s), self.settled[electrodes]
        x, _ = self._first(scan, columns, settled)
        for _ in range(STEPS):
            residual, design, precision = _linearised(scan, columns, x, settled)
            slope = (design.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0] - precision * x
            x = x + np.linalg.solve(_normal(design, precision), slope[:, :, None])[:, :, 0]
            x[:, SIZE] = np.maximum(x[:, SIZE], LEAST_MEAN - settled)
        residual, design, precision = _linearised(scan, columns, x, settled)
        normal = _normal(design, precision)
        chi2 = (residual**2).sum(axis=1)
        occam = np.linalg.slogdet(normal)[1] - np.log(precision).sum(axis=1)
        score = scan.white.log_density - 0.5 * (chi2 + (precision * x**2).sum(axis=1) + occam)
        variance = np.linalg.inv(normal)[:, SIZE, SIZE]
        chi2 = chi2 / max(int(scan.live.sum()), 1) / self._forgiven(scan, electrodes, x)
        found = electrodes, x[:, SIZE], variance, begin_s, score, chi2
        return [Change(*each) for each in zip(*(values.tolist() for values in found), strict=True)]

    def _acting(self, scan: Unexplained, electrodes: Indices, begin_s: Array) -> Array:
        """(n, K, 3) columns of changes that act from then on."""
        acts = (scan.live & (scan.times_s >= begin_s[:, None])) * scan.share  # (n, K)
        series, shunt = self.series.T[electrodes] * acts, self.shunt.T[electrodes] * acts
        return np.stack([series, shunt, series * (2 * scan.times_s / scan.span_s)], axis=-1)

    @staticmethod
    def _first(scan: Unexplained, columns: Array, settled: Array) -> tuple[Array, Array]:
        """(n, 3) of a change that is no logarithm's, linear in the impedance itself, and how much it explains (n,)."""
        change = np.expm1(np.minimum(scan.y, MOST_LOG))
        weighted = (columns[:, :, SIZE] + columns[:, :, SHUNT]) / (1 + change)
        design = weighted @ scan.white.w.T
        seen = scan.white(change / (1 + change))
        along, precision = design @ seen, (design**2).sum(axis=1) + n.CONTACT_CHANGES**-2
        x = np.zeros_like(columns[:, 0])
        x[:, SIZE] = np.maximum(along / precision, LEAST_MEAN - settled)
        return x, along**2 / precision

    def _forgiven(self, scan: Unexplained, electrodes: Indices, x: Array) -> Array:
        """(n,) by how much chi^2 may be larger, as columns are not exact."""
        wrong = (n.CONTACT_MISFIT * self.series[:, electrodes] * x[:, SIZE]) ** 2 * scan.live[:, None]
        return np.asarray(1 + (wrong * scan.white.conditional_precisions()[:, None]).sum(axis=0) / len(scan.live))


def _changed(columns: Array, x: Array, settled: Array) -> Array:
    """(n, K) relative changes of x (n, 3)."""
    law = np.stack([x[:, SIZE], _shunt_of(x[:, SIZE], settled) + x[:, SHUNT], x[:, COURSE]], axis=-1)
    return np.maximum((columns @ law[:, :, None])[:, :, 0], LEAST_MEAN)


def _left(scan: Unexplained, changed: Array) -> Array:
    """(n, K) residuals of relative changes (n, K)."""
    return np.where(scan.live, scan.y - np.log1p(changed), 0.0)


def _linearised(scan: Unexplained, columns: Array, x: Array, settled: Array) -> tuple[Array, Array, Array]:
    """Whitened residuals (n, K) and slopes (n, K, 3) at x (n, 3), and the priors' precisions there (n, 3)."""
    mean = _changed(columns, x, settled)
    both = np.concatenate([_left(scan, mean)[:, :, None], columns], axis=-1)
    slopes = both[:, :, 1:]
    slopes[:, :, SIZE] += columns[:, :, SHUNT] * _shunt_slope(x[:, SIZE], settled)[:, None]
    slopes /= (1 + mean)[:, :, None]
    both = scan.white.w @ both
    size, course = np.full(len(x), n.CONTACT_CHANGES**-2), np.maximum(n.COURSE_FLOOR, np.abs(x[:, SIZE])) ** -2
    precision = np.stack([size, _shunt_sd(x[:, SIZE], settled) ** -2, course], axis=-1)
    return both[:, :, 0], both[:, :, 1:], precision


def _normal(design: Array, precision: Array) -> Array:
    """(n, 3, 3) of the normal equations."""
    return np.asarray(design.transpose(0, 2, 1) @ design + precision[:, :, None] * np.eye(precision.shape[1]))


def gain_changes(scan: Unexplained) -> list[Change]:
    """The likeliest steps of the board's gain, before the scan and within it, each measurement by itself."""
    within_s = float(_onsets(scan, np.ones((len(scan.y), 1)))[0])
    return [gain_change(scan, since_s) for since_s in (-np.inf, within_s)]


def gain_change(scan: Unexplained, begins_s: float) -> Change:
    """The likeliest step of the board's gain since then, with its evidence."""
    acts = scan.white(scan.since(begins_s))
    seen = scan.white(scan.y)
    precision = float(acts @ acts) + n.GAIN_CHANGES**-2
    found = float(acts @ seen) / precision
    chi2 = float(seen @ seen) - found * float(acts @ seen)
    score = scan.white.log_density - 0.5 * (chi2 + np.log(precision * n.GAIN_CHANGES**2))
    return Change(GAIN, found, 1 / precision, begins_s, float(score), chi2 / max(int(scan.live.sum()), 1))


def _onsets(scan: Unexplained, columns: Array) -> Array:
    """(n,) of columns (K, n) that act from then on."""
    order = np.argsort(-scan.times_s)
    weight = np.where(scan.live, scan.white.conditional_precisions(), 0.0)[order, None]
    column = columns[order]
    along = np.cumsum(weight * column * scan.y[order, None], axis=0)
    information = np.cumsum(weight * column**2, axis=0)
    explains = np.where(information > 0, along**2 / np.maximum(information, n.TINY), 0.0)
    return np.asarray(scan.times_s[order[explains.argmax(axis=0)]])


def _shunt_of(size: Array | float, settled: Array | float) -> Array:
    """b of a contact whose change goes from `settled` on by `size`."""
    return _shunt(settled + size) - _shunt(settled)


def _shunt(size: Array | float) -> Array:
    return np.asarray(size / (1 + np.asarray(size) / n.SHORT_WAY))


def _shunt_slope(size: Array | float, settled: Array | float) -> Array:
    return np.asarray((1 + np.asarray(size + settled) / n.SHORT_WAY) ** -2)


def _shunt_sd(size: Array | float, settled: Array | float) -> Array:
    return np.asarray(n.SHORT_WAY_SD * np.abs(_shunt_of(size, settled)) + n.REST_FLOOR)
