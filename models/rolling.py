"""The order of a scan in parts: each part sees the whole skin (numpy only).

By turns each part takes the measurement that lowers the mean variance of a touch's position most, given what the part
has (A-optimal, Bayesian: Chaloner & Verdinelli, Statistical Science 10, 1995). Every electrode is in every
part, so that a fault of one shows in each.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from models.prereconstruction import Matrices
from models.touch_grid import PRIOR, RADIUS, SNR_DB, Array, Rows, slopes, touches
from protocol.link import PARTS


def most_parts(measurements: int, electrodes: int, at_most: int = max(PARTS)) -> int:
    """Into how many parts a scan is cut: as many as leave each enough measurements to see every electrode twice over,
    as pairs of electrodes would.
    """
    fits = [n for n in PARTS if measurements % n == 0 and measurements // n > electrodes // 2 and n <= at_most]
    return max(fits, default=1)


def order(m: Matrices, pattern: Rows, parts: int, half_width: float = 1.0) -> Rows:
    """(K,) places in the pattern (K, 4), in the order to measure them: part after part. parts divides K."""
    grid = touches(m, half_width)
    judged = grid.radius == RADIUS
    by_place = slopes(grid, judged, float(np.sqrt(10 ** (-SNR_DB / 10))))
    uses = np.zeros((len(pattern), int(pattern.max()) + 1), dtype=bool)
    np.put_along_axis(uses, np.asarray(pattern, np.int64), True, axis=1)
    chosen = _by_turns(by_place, parts)
    _share_electrodes(chosen, uses)
    return np.concatenate([np.sort(part) for part in chosen])


def _by_turns(by_place: Array, parts: int) -> list[list[int]]:
    """The measurements of each part. by_place (M, K, 3): what a touch's position and strength change them by."""
    count = by_place.shape[1]
    information = np.tile(np.diag(PRIOR**-2), (parts, len(by_place), 1, 1))
    free = np.ones(count, dtype=bool)
    chosen: list[list[int]] = [[] for _ in range(parts)]
    for turn in range(count):
        part = turn % parts if turn // parts % 2 == 0 else parts - 1 - turn % parts  # who was last is first
        u = np.einsum("mab,mkb->mka", np.linalg.inv(information[part]), by_place)
        gain = ((u[..., 0] ** 2 + u[..., 1] ** 2) / (1 + np.einsum("mka,mka->mk", u, by_place))).mean(axis=0)
        best = int(np.where(free, gain, -np.inf).argmax())
        chosen[part].append(best)
        free[best] = False
        information[part] += by_place[:, best, :, None] * by_place[:, best, None, :]
    return chosen


def _share_electrodes(chosen: list[list[int]], uses: Array) -> None:
    """Exchange measurements between parts until every part uses every electrode that the pattern does, or no exchange
    helps. uses (K, E): whether a measurement uses an electrode.
    """
    while True:
        counts = np.array([uses[part].sum(axis=0) for part in chosen])
        lacks = (counts == 0) & uses.any(axis=0)
        if not lacks.any():
            return
        part = int(lacks.any(axis=1).argmax())
        exchanges = _exchanges(chosen, uses, counts, part)
        gain, other, wanted, given = max(exchanges, key=lambda each: each[0], default=(0, 0, 0, 0))
        if gain <= 0:
            return
        chosen[part][chosen[part].index(given)] = wanted
        chosen[other][chosen[other].index(wanted)] = given


def _exchanges(chosen: list[list[int]], uses: Array, counts: Array, part: int) -> Iterator[tuple[int, int, int, int]]:
    """What each exchange that gives `part` an electrode that it lacks gains, the other part, its measurement, and that
    of `part`. counts (parts, E): how often a part uses an electrode.
    """
    lacks = (counts == 0) & uses.any(axis=0)
    for other, theirs in enumerate(chosen):
        if other == part:
            continue
        for wanted, given in product([k for k in theirs if uses[k, lacks[part]].any()], chosen[part]):
            change = uses[wanted].astype(int) - uses[given]
            left = ((counts[part] + change) == 0).sum() + ((counts[other] - change) == 0).sum()
            yield int(lacks[part].sum() + lacks[other].sum() - left), other, wanted, given
