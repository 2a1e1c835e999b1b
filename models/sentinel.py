"""The sentinel list: the few measurements that an idle board repeats, and what a touch does to them (numpy only).

Chosen by design of experiments from a bundle's linear physics, in two steps:

1. *Detection.* A touch at m changes measurement k by s_mk standard deviations, so a list S sees it with deflection
   lambda_m = sqrt(sum_{k in S} s_mk^2). The test takes the largest of the matched filters of all touches of a grid (a
   generalised likelihood ratio); an untouched skin exceeds c with a probability that importance sampling gives
   (`exceedance`), and a touch is seen with probability at least Phi(lambda - c). The shortest list whose worst touch
   is seen well enough is found by exchange on min_m lambda_m.
2. *Place.* These few measurements cannot tell the place. The list is continued, one measurement at a time, by the one
   that lowers the mean variance of the position most, with size and drop unknown (A-optimal, Bayesian: Chaloner &
   Verdinelli, Statistical Science 10, 1995).

The reference is a mean of the untouched skin's own recent scans, so slow drift cancels and is not a nuisance here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from models.prereconstruction import Matrices

Array = npt.NDArray[np.floating]
Rows = npt.NDArray[np.integer]

LENGTH = 12  # measurements: a tenth of `pairs`; bench/speed/sentinel.py shows what longer and shorter ones would give
NEWTON = 0.1  # S/m of drop
RADIUS = 0.2  # model units, of the touch that must be seen
RADII = (0.1, 0.2, 0.4)  # model units, of the touches that are told apart
SPACING = 0.1  # model units between grid positions
SNR_DB = 70.0
POWER = 0.999
FALSE_ALARMS_HZ = 1 / 60
MEASUREMENT_S = 363e-6  # voltage and current, 128 DFT points at 800 kSPS, settling
SAMPLES = 500  # of the importance sampling: c to about 0.01
SHARPNESS = 8.0  # of the smooth minimum that the exchange climbs

# Standard deviations before measuring: x, y (model units), log of drop times area; as models/fisher.py.
PRIOR = np.array([2.0, 2.0, np.hypot(np.log(5), 2 * np.log(3))]) / np.sqrt(12)


@dataclass(frozen=True)
class Touches:
    """Circles on a grid, wholly on the skin. M touches, P pixels, K measurements."""

    position: Array  # (M, 2) model units
    radius: Array  # (M,) model units
    coverage: Array  # (M, P) share of each pixel
    response: Array  # (M, K) d per S/m of drop


def touches(m: Matrices, half_width: float = 1.0, radii: tuple[float, ...] = RADII) -> Touches:
    """Every circle of the given radii on the grid."""
    h, w = m.inside.shape
    pixel = 2 * half_width / w
    x = (np.arange(w) + 0.5) * pixel - half_width
    y = (np.arange(h) + 0.5) * pixel - half_width
    steps = int(round(half_width / SPACING))
    line = np.arange(-steps, steps + 1) * SPACING
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    distance = np.hypot(x[None, None, :] - grid[:, 0, None, None], y[None, :, None] - grid[:, 1, None, None])
    position, radius, coverage = [], [], []
    for r in radii:
        share = np.clip((r - distance) / pixel + 0.5, 0.0, 1.0).reshape(len(grid), -1)
        on = (share @ m.inside.ravel().astype(float)) / (np.pi * r**2 / pixel**2) > 0.98
        position.append(grid[on])
        radius.append(np.full(int(on.sum()), r))
        coverage.append(share[on] * (np.pi * r**2 / pixel**2) / share[on].sum(axis=1, keepdims=True))
    stacked = np.concatenate(coverage).astype(np.float32)
    return Touches(np.concatenate(position), np.concatenate(radius), stacked, stacked @ m.jacobian.T)


@dataclass(frozen=True)
class Sentinel:
    """A list and its touches. n measurements; `rows` are their places in the whole pattern, increasing."""

    rows: Rows
    smallest: Rows  # the shortest list that only detects
    touches: Touches
    signed: bool  # whether a touch's sign is known: it is in a modelled bundle

    @cached_property
    def response(self) -> Array:
        """(M, n) d per S/m; of both signs where it is not known which way the material goes."""
        own = self.touches.response[:, self.rows]
        return own if self.signed else np.concatenate([own, -own])

    @property
    def seconds(self) -> float:
        """Seconds of one scan at 128 DFT points."""
        return len(self.rows) * MEASUREMENT_S

    def filters(self, sigma: Array) -> Array:
        """(M, n) matched filters for noise sigma (n,) of d; `max(filters @ d)` is the statistic, in sigmas."""
        whitened = self.response / sigma
        size = np.linalg.norm(whitened, axis=1, keepdims=True)
        return np.asarray(whitened / np.maximum(size, 1e-12) / sigma)


def design(
    m: Matrices, length: int = LENGTH, half_width: float = 1.0, snr_db: float = SNR_DB, reference: int = 64
) -> Sentinel:
    """The list for a bundle: the shortest that detects, continued for place. reference: scans in the mean compared to.

    A skin on which no list of `length` detects gets the best one of that length.
    """
    grid = touches(m, half_width)
    judged = grid.radius == RADIUS
    sigma = np.sqrt(10 ** (-snr_db / 10) * (1 + 1 / reference))
    deflection = NEWTON * grid.response[judged] / sigma
    signed = m.normalisation == "model"
    smallest = shortest_list(deflection, length, signed)
    by_place = slopes(grid, judged, sigma)
    return Sentinel(np.sort(for_place(smallest, by_place, length)), np.sort(smallest), grid, signed)


def shortest_list(deflection: Array, longest: int, signed: bool = True) -> Rows:
    """The shortest list whose worst touch is seen with POWER at FALSE_ALARMS_HZ. deflection (M, K): of single ones."""
    chosen: list[int] = []
    for n in range(1, longest + 1):
        chosen = exchange(deflection**2, n)
        worst = float(np.sqrt((deflection[:, chosen] ** 2).sum(axis=1).min()))
        margin = NormalDist().inv_cdf(POWER)
        if worst < margin:
            continue
        false_alarm = FALSE_ALARMS_HZ * n * MEASUREMENT_S
        if exceedance(_directions(deflection[:, chosen], signed), worst - margin) <= false_alarm:
            break
    return np.array(chosen)


def exchange(power: Array, n: int) -> list[int]:
    """n columns of power (M, K), squared deflections, with the largest smallest row sum: greedy, then swaps."""
    chosen: list[int] = []
    total = np.zeros(len(power))
    for step in range(n):
        value = _smooth_minimum(total[:, None] + power, 0.5 + 0.5 * SHARPNESS * min(1.0, step / 4))
        value[chosen] = -np.inf
        chosen.append(int(value.argmax()))
        total += power[:, chosen[-1]]
    best = _smooth_minimum(total[:, None], SHARPNESS)[0]
    while True:
        swap = None
        for place, old in enumerate(chosen):
            value = _smooth_minimum((total - power[:, old])[:, None] + power, SHARPNESS)
            value[chosen] = -np.inf
            if value.max() > best + 1e-9 * abs(best):
                best, swap = value.max(), (place, int(value.argmax()))
        if swap is None:
            return chosen
        total += power[:, swap[1]] - power[:, chosen[swap[0]]]
        chosen[swap[0]] = swap[1]


def for_place(start: Rows, slopes: Array, length: int) -> Rows:
    """`start` continued to `length` so that the mean variance of the position falls fastest. slopes (M, K, 3)."""
    chosen = [int(k) for k in start]
    information = np.diag(PRIOR**-2) + np.einsum("mka,mkb->mab", slopes[:, chosen], slopes[:, chosen])
    while len(chosen) < length:
        u = np.einsum("mab,mkb->mka", np.linalg.inv(information), slopes)
        gain = ((u[..., 0] ** 2 + u[..., 1] ** 2) / (1 + np.einsum("mka,mka->mk", u, slopes))).mean(axis=0)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
        new = slopes[:, chosen[-1]]
        information += new[:, :, None] * new[:, None, :]
    return np.array(chosen)


def exceedance(directions: Array, c: float, samples: int = SAMPLES) -> float:
    """P(max_m u_m g > c) of standard normal g (n,), for unit rows u_m (M, n): any c, however rare.

    Importance sampling of a union of half-spaces: draw one of them, a point in it, and count how many it lies in (Owen,
    Maximov, Chertkov, Electronic Journal of Statistics 13, 2019). The draws are the same each time.
    """
    rng = np.random.default_rng(0)
    count, n = directions.shape
    tail = NormalDist().cdf(-c)
    if tail == 0.0:
        return 0.0
    normal = NormalDist()
    along = np.array([-normal.inv_cdf(max(tail * q, 1e-300)) for q in 1 - rng.random(samples)])
    u = directions[rng.integers(count, size=samples)]
    g = rng.standard_normal((samples, n))
    g += (along - (g * u).sum(axis=1))[:, None] * u
    inside = (g @ directions.T > c - 1e-9).sum(axis=1)
    return float(min(1.0, count * tail * (1 / np.maximum(inside, 1)).mean()))


def threshold(directions: Array, false_alarm: float) -> float:
    """The c that an untouched scan's statistic exceeds with probability `false_alarm`."""
    low, high = 0.0, 12.0
    while high - low > 0.01:
        middle = (low + high) / 2
        low, high = (middle, high) if exceedance(directions, middle) > false_alarm else (low, middle)
    return high


def _directions(deflection: Array, signed: bool) -> Array:
    unit = deflection / np.maximum(np.linalg.norm(deflection, axis=1, keepdims=True), 1e-12)
    return unit if signed else np.concatenate([unit, -unit])


def slopes(grid: Touches, judged: npt.NDArray[np.bool_], sigma: float) -> Array:
    """(M, K, 3) of d over sigma, to x, y and the log of drop times area, which a linear touch changes d in proportion
    to; of the judged touches of one newton.
    """
    place = {(round(x, 6), round(y, 6)): k for k, (x, y) in enumerate(grid.position[judged])}
    signal = NEWTON * grid.response[judged] / sigma
    columns = []
    for axis in np.eye(2):
        ahead, behind, distance = np.arange(len(signal)), np.arange(len(signal)), np.zeros(len(signal))
        for k, at in enumerate(grid.position[judged]):
            for side, index in ((1, ahead), (-1, behind)):
                neighbour = place.get(tuple(np.round(at + side * SPACING * axis, 6)))
                if neighbour is not None:
                    index[k] = neighbour
                    distance[k] += SPACING
        columns.append((signal[ahead] - signal[behind]) / np.maximum(distance, 1e-9)[:, None])
    return np.stack([*columns, signal], axis=-1)


def _smooth_minimum(totals: Array, sharpness: float) -> Array:
    """(M, K) -> (K,), larger where the smallest of a column is larger; the near-smallest count too."""
    return np.asarray(-(np.maximum(totals, 1e-2) ** -sharpness).sum(axis=0))
