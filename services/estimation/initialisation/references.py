"""Scans of the untouched skin that stand in a file: each is the baseline of what follows it, together they tell the
noise. Their order says nothing: neither when they were taken nor how long one was after the other.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.measurement.numbers import LEAST_NOISE, MEDIAN_DEVIATION
from models.prereconstruction import PreReconstructor, shrunk
from services.estimation.initialisation.baseline import SEE, Baseline, in_proportion, unlike
from services.estimation.values import numbers
from services.estimation.values.state import shaped

Array = NDArray[np.float64]

MOST_ROWS = 1024  # of which noise is found: time and memory go with their square
NEIGHBOURS = 2  # scans that each is compared with: more are less alike, one alone tells less


class References:
    """Baselines of K measurements from the reference scans of one file."""

    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.doubt = ""  # what a reader of the whole file says against all of them
        self.reset()

    def reset(self) -> None:
        self._row: list[Array] = []  # those that came one after the other, without another scan in between
        self.noise: Array | None = None  # (K,) relative, of one scan
        self.typical = np.zeros(self._k)  # (K,) |Z| of the scans that it was found from; 0 where nothing was measured
        self._found_from = 0  # how many those were
        self.scan = -1  # number of the last one

    def interrupted(self) -> None:
        """Another scan than a reference came."""
        self._row.clear()

    def baseline(
        self, amplitude: Array, scan: int, board: str, sample_ns: int, pre: PreReconstructor
    ) -> Baseline | None:
        """The baseline that this scan's |Z| (K,) is, NaN where a measurement failed; None where half of it did. It is
        in doubt where `pre` predicts another skin.
        """
        self.scan, good = scan, in_proportion(np.log(np.where(amplitude > 0, amplitude, np.nan))[None])
        if good.sum() < self._k / 2:
            return None
        self._row.append(np.where(good, amplitude, np.nan))
        del self._row[:-MOST_ROWS]
        if self.noise is None or len(self._row) > 1:
            rows = np.array(self._row)
            self.noise, self._found_from = noise_of_references(rows), len(rows)
            self.typical = np.nan_to_num(_quietly(lambda scans: np.nanmedian(scans, axis=0), rows))
        z0, sigma = np.where(good, amplitude, 0.0), np.where(good, self.noise * amplitude, np.inf)
        # Two scans share each of the differences that it was found from.
        off = unlike(z0, sigma, pre)
        doubt = f"the reference is {off}: {SEE}" if off else self.doubt
        return Baseline(z0, sigma, 1, board, sample_ns, doubt, taken_by="file", noise_frames=self._found_from // 2)

    def sigma(self, baseline: Baseline, pre: PreReconstructor) -> Array:
        """(K,) noise of d against this baseline: that of a typical scan, so that operators are made once for all."""
        known = self.typical > 0
        share = np.divide(self.typical, pre.normaliser(self.typical), out=np.zeros(len(self.typical)), where=known)
        return np.where(np.isfinite(baseline.sigma) & known, self.noise * share, np.inf)

    def state(self) -> dict[str, Any]:
        state = {"row": np.array(self._row), "noise": self.noise, "typical": self.typical}
        return state | {"found_from": self._found_from, "scan": self.scan}

    def load(self, state: dict[str, Any]) -> None:
        """Raises KeyError, TypeError or ValueError where it does not fit."""
        self.reset()
        self._row = [shaped(row, (self._k,), finite=False) for row in state["row"]]
        self.noise = None if state["noise"] is None else shaped(state["noise"], (self._k,))
        self.typical = shaped(state["typical"], (self._k,))
        self._found_from, self.scan = int(state["found_from"]), int(state["scan"])


def forms(scans: Array) -> Array:
    """(N, K) |Z| -> how each scan differs from the median one, as logarithms, less what all measurements do together
    (gain); 0 where nothing was measured.
    """
    logs = np.log(np.where(np.isfinite(scans) & (scans > 0), scans, np.nan))
    logs -= np.nanmedian(logs, axis=1, keepdims=True)  # first, so that a gain of each scan changes nothing below
    logs -= np.nanmedian(logs, axis=0)
    logs -= np.nanmedian(logs, axis=1, keepdims=True)
    return np.where(np.isfinite(logs), logs, 0.0)


def alike(scans: Array, count: int) -> NDArray[np.intp]:
    """Which `count` of the scans (N, K) are most alike, in ascending order."""
    if len(scans) <= count:
        return np.arange(len(scans))
    form = _quietly(forms, scans)
    middle = form[np.abs(form).sum(axis=1).argmin()]
    return np.sort(np.argsort(((form - middle) ** 2).sum(axis=1), kind="stable")[:count])


def noise_of_references(reference: Array) -> Array:
    """(K,) relative noise of one scan, from (N, K) |Z| of the untouched skin, in any order; NaN: not measured.

    From one to another the skin drifts, so that each is compared with the few most like it. Half of the measurements
    say which those are, the other half how far it is from them, and the other way round: to choose by the very noise
    that is asked for would find too little of it. Gain is left out, and medians let outliers count little. Where all
    are the same scan, `TARE_ASSUMED`.
    """
    return _quietly(_noise, reference)


def _noise(reference: Array) -> Array:
    measured = np.where(np.isfinite(reference) & (reference > 0), reference, 0.0)
    rows = np.unique(measured, axis=0)  # a scan that stands there twice says nothing of noise
    rows = rows[:: -(-len(rows) // MOST_ROWS)]
    n, k = len(rows), reference.shape[1]
    if n < 2:
        return np.full(k, numbers.TARE_ASSUMED)
    form, own, few = forms(rows), np.full(k, np.nan), min(NEIGHBOURS, n - 1)
    form[rows == 0] = np.nan
    for half in (slice(0, None, 2), slice(1, None, 2)):
        nearest = _nearest(np.nan_to_num(np.delete(form, np.arange(k)[half], axis=1)), few)
        apart = np.abs(form[:, None, half] - form[:, half][nearest])
        own[half] = np.nanmedian(apart, axis=(0, 1)) / MEDIAN_DEVIATION / np.sqrt(2)
    typical = np.nanmedian(np.where(own > 0, own, np.nan))
    if not np.isfinite(typical):
        return np.full(k, numbers.TARE_ASSUMED)
    own = np.where(np.isfinite(own), own, typical)
    return np.asarray(np.maximum(np.sqrt(shrunk(own**2, typical**2, n)), LEAST_NOISE))


def _nearest(points: Array, count: int) -> NDArray[np.intp]:
    """(N, count) of each of the points (N, K) the nearest others."""
    square = (points**2).sum(axis=1)
    distance = square[:, None] + square - 2 * points @ points.T
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1, kind="stable")[:, :count]


def _quietly(function: Callable[[Array], Array], scans: Array) -> Array:
    """numpy warns of columns without a value: they are looked after."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return function(np.asarray(scans, dtype=float))
