"""The untouched baseline: when frames agree well enough to be one, what their noise is, and whether the skin was
really untouched; and a file's reference scans.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtri

from models.measurement.arrays import Array, Indices, Mask
from models.measurement.numbers import LEAST_NOISE, MEDIAN_DEVIATION
from models.prereconstruction import PreReconstructor, noise_of_frames, shrunk
from protocol.errors import EitskinError
from services.estimation.values import numbers
from services.estimation.values.state import loaded

TAKING = "taking the baseline"  # what the status says until there is one
OUT_OF_PROPORTION = 1e3  # of a measurement over the median one: pairs of one sheet differ by 10
DEAD = 4.0  # times the bundle's proportion: contact impedances of 0.1 to 30 times change none by so much
UNLIKE = 0.12  # rms relative misfit: columns in another order, another unit or pattern have 0.17 and more; with gains
# of 10 % from pair to pair, electrodes off by 5 mm and a sheet uneven by 20 % touches are still placed right
SEE = "see that the skin, the order of columns and the unit are those measured, and that no electrode is open"
REPEATED = 0.1  # of the values that equal the row before: noise of a third of a step gives 0.65, of 4 steps 0.07
COARSE = 2e-3  # relative step of |Z|: by 9 bits touches of 1 N are placed 4 to 15 mm off, by 10 bits 2 at most
MOST_ROWS = 1024  # of which noise is found: time and memory go with their square
NEIGHBOURS = 2  # scans that each is compared with: more are less alike, one alone tells less


class NoBaseline(EitskinError, ValueError):
    """Frames, or a saved state, make no baseline. The text says why and what to do; with ": wait", time alone helps."""


@dataclass(frozen=True)
class Baseline:
    """|Z0| of the untouched skin. K measurements."""

    z0: Array  # (K,) unit of the raw frames
    sigma: Array  # (K,) standard deviation of one frame's |Z|, same unit
    frames: int  # how many it is the mean of
    board: str  # unique id of the board
    taken_ns: int  # `sample` of the newest frame in it
    doubt: str = ""  # why the skin may have been touched meanwhile; empty: no doubt
    taken_by: str = "start"  # or "command", "file"
    restored: bool = False  # an earlier process took it

    def __post_init__(self) -> None:
        """Whoever holds a baseline holds what its hash says: the arrays are its own, and nobody writes to them."""
        for name in ("z0", "sigma"):
            array = np.array(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def hash(self) -> str:
        return hashlib.sha256(self.z0.tobytes() + self.sigma.tobytes()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, saved: dict[str, Any], measurements: int) -> Baseline:
        """Raises NoBaseline where `saved` is no baseline of that many measurements."""
        try:
            z0, sigma = np.array(saved["z0"], dtype=float), np.array(saved["sigma"], dtype=float)
            rest = int(saved["frames"]), str(saved["board"]), int(saved["taken_ns"]), str(saved["doubt"])
            provenance = str(saved.get("taken_by", "start")), bool(saved.get("restored", False))
        except (KeyError, TypeError, ValueError) as wrong:
            raise NoBaseline(f"no baseline in the saved state ({wrong}): tare again") from None
        if z0.shape != (measurements,) or sigma.shape != (measurements,):
            raise NoBaseline(f"the saved baseline has {z0.size} measurements, this skin {measurements}: tare again")
        if not (np.isfinite(z0).all() and (z0 >= 0).all() and (sigma > 0).all()):
            raise NoBaseline("the saved baseline has impedances or noises that are not possible: tare again")
        known = int(((z0 > 0) & np.isfinite(sigma)).sum())
        if known < numbers.LEAST_LIVE * measurements:
            raise NoBaseline(f"the saved baseline knows only {known} of {measurements} measurements: tare again")
        return cls(z0, sigma, *rest, *provenance)


def take(frames: Array, pre: PreReconstructor, board: str) -> Baseline:
    """The baseline of (N, K) |Z| of a file. Raises NoBaseline where the frames do not agree with each other.

    A measurement that is not finite in every frame gets an infinite sigma: it is left out until the next tare.
    """
    log_z = np.log(np.where(frames > 0, frames, np.nan))
    live, noise = measured(log_z)
    if not (found := agreement(log_z[:, live])).holds:
        raise NoBaseline(str(found))
    good = frames[:, live]
    z0, sigma = np.zeros(frames.shape[1]), np.full(frames.shape[1], np.inf)
    z0[live] = good.mean(axis=0)
    sigma[live] = noise_of_frames(good, z0[live])
    sigma = plausible_noise(z0, sigma)
    doubt = identical(len(frames)) if noise < numbers.TARE_IDENTICAL else ""
    share = float(np.median(sigma[live] / z0[live]))
    if pre.m.normalisation == "model" and share > numbers.TARE_UNTRAINED:  # a measured bundle knows its own noise
        doubt = untrained(share)
    return Baseline(z0, sigma, len(frames), board, 0, doubt)


def percent(share: float, digits: int = 1) -> str:
    return f"{share:.{digits}%}".replace("%", " %")


def measured(log_z: Array) -> tuple[Mask, float]:
    """(K,) which measurements of (N, K) log |Z| every frame has, in some proportion to the others, and their relative
    noise. Raises NoBaseline where those are too few, or scatter by too much.
    """
    live = in_proportion(log_z)
    if live.mean() < numbers.LEAST_LIVE:
        few = f"only {int(live.sum())} of {len(live)} measurements give values"
        raise NoBaseline(f"{few}: check the cable and the electrodes")
    noise = float(np.median(log_z[:, live].std(axis=0, ddof=1)))
    if noise > numbers.TARE_NOISY:
        most = percent(numbers.TARE_NOISY, 0)
        raise NoBaseline(f"the frames scatter by {percent(noise)} (at most {most}): check grounding and cable")
    return live, noise


def identical(count: int) -> str:
    """Why so many untouched frames tell no noise, to a person."""
    return (
        f"the {count} untouched frames are identical, as measured ones never are: a noise of "
        f"{numbers.TARE_ASSUMED:g} of each measurement is assumed; check the source and run `skin tare`"
    )


def untrained(noise: float) -> str:
    """Why no network is to be believed beside this relative noise, to a person."""
    trained = f"networks were trained for {percent(numbers.TARE_UNTRAINED, 2)} at most"
    return f"the frames scatter by {percent(noise)}, {trained}: check grounding and cable, then run `skin tare`"


def plausible_noise(z0: Array, sigma: Array) -> Array:
    """(K,) standard deviations of |Z|: at least LEAST_NOISE, and TARE_ASSUMED where none was found (identical frames,
    NaN); infinite ones stay.
    """
    found = np.isfinite(sigma) & (sigma > numbers.TARE_IDENTICAL * np.abs(z0))
    finite = np.where(found, np.maximum(sigma, LEAST_NOISE * np.abs(z0)), numbers.TARE_ASSUMED * np.abs(z0))
    # A measurement that has no baseline either is not used.
    return np.where(np.isposinf(sigma) | ~(np.abs(z0) > 0), np.inf, finite)


def coarseness(rows: Array) -> str:
    """In which steps |Z| of (N, K) rows stands, to a person, where touches are misplaced by them; "" where they are
    finer, or finer than the noise: a value that the next row has again is rare then. A row that is the one before it
    again says nothing.
    """
    steps = np.abs(np.diff(np.abs(rows), axis=0))
    steps = steps[(steps > 0).any(axis=1)]
    steps = steps[np.isfinite(steps)]
    if not (steps > 0).any() or (steps == 0).mean() < REPEATED:
        return ""
    step = float(steps[steps > 0].min())
    share = step / float(np.nanmedian(np.abs(rows)))
    return f"in steps of {step:.3g}, {100 * share:.1g} % of it" if share > COARSE else ""


class Agreement(NamedTuple):
    """Whether untouched scans are the same but for their noise."""

    statistic: float
    limit: float  # that quiet scans keep to

    @property
    def holds(self) -> bool:
        return not self.statistic > self.limit

    def __str__(self) -> str:
        """Why they make no baseline, to a person."""
        return (
            f"the frames disagree (statistic {self.statistic:.0f}, limit {self.limit:.0f}): something touched or moved "
            "meanwhile"
        )


def agreement(scans: Array) -> Agreement:
    """Chi-square of the quarters' means of (n, K) log |Z| against the noise within them."""
    quarters = int(numbers.TARE_QUARTERS)
    size = len(scans) // quarters
    parts = scans[-quarters * size :].reshape(quarters, size, -1)
    # Presses that come and go make the quarters scatter within as well; from scan to scan they seldom do.
    steps = 0.5 * (np.diff(scans, axis=0) ** 2).mean(axis=0)
    noise = np.minimum(parts.var(axis=1, ddof=1).mean(axis=0), steps)
    within = noise / size + numbers.TARE_HARMLESS**2
    means = parts.mean(axis=1)
    statistic = float((((means - means.mean(axis=0)) ** 2).sum(axis=0) / within).sum())
    dof_within = quarters * (size - 1)
    chi_square = chdtri((quarters - 1) * scans.shape[1], numbers.TARE_DISAGREES)
    estimated = dof_within / (dof_within - 2) * (1 + 2 / dof_within)  # the noise within is estimated too
    return Agreement(statistic, float(chi_square * estimated))


def unlike(z0: Array, sigma: Array, pre: PreReconstructor) -> str:
    """How far |Z0| (K,), known by sigma (K,), is from any skin of the bundle's, however mounted, to a person; "" where
    its misfit is at most UNLIKE beyond its noise. As many measurements as an electrode has do not count where they are
    out of the bundle's proportion: a dead one says nothing of the others.
    """
    if pre.m.normalisation != "model":
        return ""
    live = z0 > 0
    times = np.log(z0[live] / pre.m.z0[live])
    live[live] = np.abs(times - np.median(times)) < np.log(DEAD)
    if (live < (z0 > 0)).mean() <= 2 / len(pre.m.contact.T):
        z0 = np.where(live, z0, 0.0)
    known = np.isfinite(sigma) & (z0 > 0)
    noise = float(np.sqrt(np.mean((sigma[known] / z0[known]) ** 2))) if known.any() else 0.0
    misfit = implausibility(z0, pre)
    return f"{percent(misfit)} off what the bundle predicts" if misfit > np.hypot(UNLIKE, noise) else ""


def in_proportion(log_z: Array) -> Mask:
    """(K,) which of (N, K) log |Z| may be of impedances of the same sheet, in every row; NaN: not measured."""
    live: Mask = np.asarray(np.isfinite(log_z).all(axis=0))
    if live.any():
        live[live] = (np.abs(log_z[:, live] - np.median(log_z[0, live])) < np.log(OUT_OF_PROPORTION)).all(axis=0)
    return live


def implausibility(z0: Array, pre: PreReconstructor) -> float:
    """rms relative misfit of |Z0| to the bundle's prediction, up to gain and contact impedances, neither of which is
    negative; 0 where the bundle predicts none.
    """
    live = z0 > 0
    if pre.m.normalisation != "model" or not live.any():
        return 0.0
    contact = pre.m.contact[live]  # of log |Z|, by the logarithm of each contact impedance
    columns = np.column_stack([1 - contact.sum(axis=1), contact]) * (pre.m.z0[live] / z0[live])[:, None]
    return float(nnls(columns, np.ones(int(live.sum())))[1] / live.sum() ** 0.5)


@dataclass
class ReferencesState:
    """All that changes."""

    typical: Annotated[Array, "K"]  # |Z| of the scans that noise was found from; 0 where nothing was measured
    row: list[Annotated[Array, "K", "gaps"]] = field(default_factory=list)  # scans that came one after the other
    noise: Annotated[Array | None, "K"] = None  # relative, of one scan
    scan: int = -1  # number of the last one


class References:
    """Baselines of K measurements from scans of the untouched skin that stand in one file: each is the baseline of what
    follows it, together they tell the noise. Their order says nothing: neither when they were taken nor how long one
    was after the other.
    """

    def __init__(self, measurements: int) -> None:
        self._k = measurements
        self.doubt = ""  # what a reader of the whole file says against all of them
        self.now = ReferencesState(np.zeros(measurements))

    def interrupted(self) -> None:
        """Another scan than a reference came."""
        self.now.row.clear()

    def baseline(
        self, amplitude: Array, scan: int, board: str, sample_ns: int, pre: PreReconstructor
    ) -> Baseline | None:
        """The baseline that this scan's |Z| (K,) is, NaN where a measurement failed; None where half of it did. It is
        in doubt where `pre` predicts another skin.
        """
        now, good = self.now, in_proportion(np.log(np.where(amplitude > 0, amplitude, np.nan))[None])
        now.scan = scan
        if good.mean() < numbers.LEAST_LIVE:
            return None
        now.row.append(np.where(good, amplitude, np.nan))
        del now.row[:-MOST_ROWS]
        if now.noise is None or len(now.row) > 1:
            rows = np.array(now.row)
            now.noise = noise_of_references(rows)
            with quiet():
                now.typical = np.nan_to_num(np.nanmedian(rows, axis=0))
        z0, sigma = np.where(good, amplitude, 0.0), np.where(good, now.noise * amplitude, np.inf)
        off = unlike(z0, sigma, pre)
        doubt = f"the reference is {off}: {SEE}" if off else self.doubt
        return Baseline(z0, sigma, 1, board, sample_ns, doubt, taken_by="file")

    def sigma(self, baseline: Baseline, pre: PreReconstructor) -> Array:
        """(K,) noise of d against this baseline: that of a typical scan, so that operators are made once for all."""
        typical = self.now.typical
        known = typical > 0
        share = np.divide(typical, pre.normaliser(typical), out=np.zeros(len(typical)), where=known)
        return np.where(np.isfinite(baseline.sigma) & known, self.now.noise * share, np.inf)

    def load(self, state: Any) -> None:
        """Raises ValueError where it does not fit."""
        self.now = loaded(ReferencesState, state, {"K": self._k})


@contextmanager
def quiet() -> Iterator[None]:
    """numpy warns of columns without a value: they are looked after."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


@quiet()
def forms(scans: Array) -> Array:
    """(N, K) |Z| -> how each scan differs from the median one, as logarithms, less what all measurements do together
    (gain); 0 where nothing was measured.
    """
    logs = np.log(np.where(np.isfinite(scans) & (scans > 0), scans, np.nan))
    logs -= np.nanmedian(logs, axis=1, keepdims=True)  # first, so that a gain of each scan changes nothing below
    logs -= np.nanmedian(logs, axis=0)
    logs -= np.nanmedian(logs, axis=1, keepdims=True)
    return np.where(np.isfinite(logs), logs, 0.0)


def alike(scans: Array, count: int) -> Indices:
    """Which `count` of the scans (N, K) are most alike, in ascending order."""
    if len(scans) <= count:
        return np.arange(len(scans))
    form = forms(scans)
    middle = form[np.abs(form).sum(axis=1).argmin()]
    return np.sort(np.argsort(((form - middle) ** 2).sum(axis=1), kind="stable")[:count])


@quiet()
def noise_of_references(reference: Array) -> Array:
    """(K,) relative noise of one scan, from (N, K) |Z| of the untouched skin, in any order; NaN: not measured.

    From one to another the skin drifts, so that each is compared with the few most like it. Half of the measurements
    say which those are, the other half how far it is from them, and the other way round: to choose by the very noise
    that is asked for would find too little of it. Gain is left out, and medians let outliers count little. Where all
    are the same scan, `TARE_ASSUMED`.
    """
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


def _nearest(points: Array, count: int) -> Indices:
    """(N, count) of each of the points (N, K) the nearest others."""
    square = (points**2).sum(axis=1)
    distance = square[:, None] + square - 2 * points @ points.T
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1, kind="stable")[:, :count]
