"""Is the skin untouched when nothing is known of it yet? Its first scans, judged by evidence.

Their mean is held against what the bundle predicts, with the gain, the sheet's slow shape and every contact impedance
free. No skin is quite its bundle's: what they differ by has a known form and an unknown size, which is summed over a
ladder of factors of two. Either that explains the scans, or a touch explains what it leaves; and where the difference
is so large that a touch may hide in it, nothing is said.

With an earlier baseline of this very skin both have that difference, and only what drifts meanwhile is free.

Whether the board's wires are as they belong is judged alike: what each fault of the wires would make of the bundle's
skin is held against what sound wires show, both with all that a skin may differ by and with any touches.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from math import gcd
from typing import NamedTuple

import numpy as np

from models.measurement.arrays import Array, Mask, Single
from models.measurement.course import TouchCourse
from models.measurement.fit import FittedScan, FoundTouches, TouchFitter
from models.measurement.tables import SkinTables
from models.measurement.touch import PLACE, RATE, TouchPrior, anywhere
from models.measurement.whitening import Whitening, leave_out
from services.estimation.faults.wires import BoardScan, WireFault, WireMaps, any_touches
from services.estimation.values import numbers as n
from services.estimation.values.estimate import Judgement, Verdict, judge

SIZES: Array = 2.0 ** np.arange(n.START_SIZES)  # of the difference between bundle and skin
ANY_GAIN = 1.0  # variance of the log of an unknown board's gain
COARSE = 12  # pixels along each side of the sheet, that a smooth field is made of
SPAN_S = 1.0  # of a mean of scans, in which nothing changes: any
STEADY_SD = 1e-6  # of rates and velocities of a touch that lasts through all scans


class StartSays(Enum):
    UNTOUCHED = "untouched"
    TOUCHED = "touched"
    UNKNOWN = "unknown"  # the difference between bundle and skin may hide a touch


class SizedDifference(NamedTuple):
    """The scans with a difference of one size."""

    sure: bool  # so small, of a sheet as even as the bundle's, that a touch beside it is one
    untouched: float  # log evidence and prior
    touched: float
    seen: float  # z^2 of the weakest touch that must not hide in the difference
    fit: FoundTouches | None  # None: no disc stands out


@dataclass(frozen=True)
class JudgedStart:
    """What the first scans say."""

    says: StartSays
    odds: float  # nat: log evidence of touched against untouched
    sure: bool  # whether a touch explains the scans, not only better than a difference alone
    bare: SizedDifference | None  # the likeliest of an untouched skin; None: nothing is predicted
    fit: FoundTouches | None  # where touched, under the likeliest difference

    @property
    def judgements(self) -> list[Judgement]:
        """Whether something touches, and whether something may without being seen."""
        if self.bare is None:
            return [Judgement("start", 0.0, float(n.START_NATS), 0.0, Verdict.CANNOT), judge("hidden", 1.0, 1.0)]
        touched = judge("start", self.odds, n.START_NATS)
        if self.says is StartSays.TOUCHED:
            return [touched]
        hides = float(n.FALSE_ALARM_Z2) / max(self.bare.seen, 1e-9)
        return [touched, judge("hidden", max(hides, 1 + self.odds / n.START_NATS), 1.0)]


@dataclass(frozen=True)
class EarlierBaseline:
    """Of this skin and board, untouched."""

    log_z0: Array  # (K,)
    covariance: Array  # (K, K) of what has drifted since


def judge_start(
    tables: SkinTables, log_z: Array, variance: Array, live: Mask, earlier: EarlierBaseline | None = None
) -> JudgedStart:
    """The likelihood ratio of a touch and of a skin that differs from its bundle, over the first scans. tables: of its
    bundle; log_z (K,): mean of the scans; variance (K,): of that mean; live (K,): what of it counts.
    """
    if live.mean() < n.LEAST_LIVE or (earlier is None and not tables.predicted):
        return JudgedStart(StartSays.UNKNOWN, 0.0, False, None, None)
    log_expected = np.log(tables.z0) if earlier is None else earlier.log_z0
    y = log_z - log_expected
    gain = float(np.median(y[live]))
    y = np.where(live, y - gain, 0.0)
    tables = tables.relative_to(np.exp(log_expected + gain))
    base = np.diag(variance + n.START_ABSOLUTE**2) + ANY_GAIN
    leave_out(base, live)
    if earlier is not None:
        form = n.START_ABSOLUTE**2 * np.eye(len(y))
        return decide(weigh_differences(tables, y, live, base + earlier.covariance, form, 0.0))
    base += contacts(tables)
    form, wide = bundle_misfit(tables), uneven(tables, base)
    found = weigh_differences(tables, y, live, base, form, 0.0)
    return decide(found + weigh_differences(tables, y, live, wide, form, float(n.START_COST_WIDE)))


def weigh_differences(
    tables: SkinTables, y: Array, live: Mask, base: Array, form: Array, cost: float
) -> list[SizedDifference]:
    """One mean of scans y (K,), explained with differences of each size, up to beyond the likeliest of an untouched
    skin. base (K, K): covariance but for the difference, whose form (K, K) is; cost: of that base, as log prior.
    """
    covariances = [base + times**2 * form for times in SIZES]
    whites = [Whitening.of(covariance) for covariance in covariances]
    density = [white.log_likelihood(y) for white in whites]
    course = TouchCourse(tables.response, np.zeros(len(y)), SPAN_S)
    found = list[SizedDifference]()
    for k, times in enumerate(SIZES[: int(np.argmax(density)) + 2]):
        log_prior = cost - float(np.log(times))  # the larger, the less likely
        information = tables.grid.information(whites[k])
        least = float(n.START_SEEN**2 * np.quantile(information, n.START_SEEN_SHARE))
        scene = FittedScan(y, covariances[k], course, tables.misfit, int(live.sum()))
        fit = search_touches(scene, tables, whites[k], information)
        touched = -np.inf if fit is None else fit.evidence + n.LOG_PRIOR_TOUCH * len(fit) + log_prior
        sure = cost == 0 and bool(times <= n.START_SURE)
        found.append(SizedDifference(sure, density[k] + log_prior, touched, least, fit))
    return found


def search_touches(scene: FittedScan, tables: SkinTables, white: Whitening, information: Single) -> FoundTouches | None:
    """Touches one after the other, each found as a disc, while they add evidence."""
    weighted_residual = white.solve(scene.y)
    best: FoundTouches | None = None
    priors = list[TouchPrior]()
    for _ in range(int(n.START_TOUCHES)):
        z2, disc, action = tables.grid.likeliest(weighted_residual, information)
        if z2 < n.FALSE_ALARM_Z2:
            break
        x, y = tables.grid.discs[disc, PLACE]
        prior = anywhere(float(x), float(y), action, SPAN_S)
        prior.sd[RATE:] = STEADY_SD
        priors.append(prior)
        fit = TouchFitter(scene, priors, tables.wrong).fit(int(n.STEPS_COLD))
        if best is not None and fit.evidence < best.evidence + n.ANOTHER:
            break
        best, weighted_residual = fit, fit.weighted_residual
    return best


def contacts(tables: SkinTables) -> Array:
    """(K, K) covariance of what an unknown skin's contact impedances do."""
    contact = tables.contact * n.START_CONTACT
    return np.asarray(contact @ contact.T)


def uneven(tables: SkinTables, even: Array) -> Array:
    """(K, K) covariance of a sheet whose log conductivity is any that is smooth over 1 unit, and which conducts better
    one way than across it, where that is known; even (K, K): of one that is even.
    """
    side = len(tables.jacobian)
    block = side // gcd(side, COARSE)
    coarse = tables.jacobian.reshape(side // block, block, side // block, block, -1).sum(axis=(1, 3)).astype(float)
    axis = (np.arange(len(coarse)) + 0.5) * 2 / len(coarse) - 1
    near = np.exp(-((axis[:, None] - axis) ** 2) / 2)
    smoothed = np.einsum("ab,bck->ack", near, np.einsum("cd,bdk->bck", near, coarse))
    grain = np.stack([tables.along.sum(axis=(0, 1)), tables.turned.sum(axis=(0, 1))], axis=1).astype(float)
    field = np.einsum("yxk,yxl->kl", coarse, smoothed, optimize=True)
    return np.asarray(even + n.START_FIELD**2 * field + n.START_FIELD**2 * (grain @ grain.T))


def bundle_misfit(tables: SkinTables) -> Array:
    """(K, K) covariance of log |Z| over the least difference between a skin and its bundle."""
    series = n.START_SERIES**2 * tables.series @ tables.series.T
    return np.asarray(series + n.START_ABSOLUTE**2 * np.eye(len(series)))


def decide(differences: list[SizedDifference]) -> JudgedStart:
    untouched = np.array([each.untouched for each in differences])
    touched = np.array([each.touched for each in differences])
    odds = float(np.logaddexp.reduce(touched)) - float(np.logaddexp.reduce(untouched))
    bare = differences[int(untouched.argmax())]
    best = differences[int(touched.argmax())]
    if odds > n.START_NATS and best.fit is not None:
        return JudgedStart(StartSays.TOUCHED, odds, best.sure, bare, best.fit)
    says = StartSays.UNTOUCHED if odds < 0 and bare.seen > n.FALSE_ALARM_Z2 else StartSays.UNKNOWN
    return JudgedStart(says, odds, False, bare, None)


class WiringTest:
    """Which fault of the wires explains the first scans. tables: of the skin's bundle."""

    def __init__(self, tables: SkinTables) -> None:
        self.maps, self._tables = WireMaps(tables.pattern), tables

    @cached_property
    def _covariances(self) -> list[Array]:
        """(K, K) of log |Z| over what a skin and its bundle differ by, of each size, and touches anywhere."""
        tables = self._tables
        base = uneven(tables, contacts(tables) + ANY_GAIN + any_touches(tables.grid))
        form = bundle_misfit(tables)
        return [base + times**2 * form for times in SIZES]

    def __call__(self, log_z: Array, variance: Array, live: Mask) -> WireFault | None:
        """log_z (K,): mean of the first scans; variance (K,): of that mean; live (K,): what of it counts."""
        if not self.maps.knows or not self._tables.predicted or live.mean() < n.LEAST_LIVE:
            return None
        expected = np.log(self._tables.z0)
        predicted = expected + float(np.median((log_z - expected)[live]))
        at_once = np.zeros(len(log_z))
        scan = BoardScan(np.where(live, log_z, 0.0), predicted, ~live, np.ones_like(live), at_once)
        if not self.maps.suspicious(scan, None):
            return None
        own = np.diag(np.where(live, variance, 1.0))
        best = dict[WireFault | None, float]()
        for times, covariance in zip(SIZES, self._covariances, strict=True):
            for guess in self.maps.guesses(scan, None, covariance, own):
                score = guess.score - float(np.log(times))
                best[guess.fault] = max(best.get(guess.fault, -np.inf), score)
        first, *others = sorted(best, key=lambda fault: -best[fault])
        surely = first is not None and best[first] >= best[None] + n.WIRE_SURE
        apart = all(best[first] > best[other] + n.WIRE_APART for other in others)
        return first if surely and apart else None
