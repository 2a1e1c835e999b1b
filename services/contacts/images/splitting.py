"""Which part of a smoothed image belongs to which touch, where several lie side by side or merge."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.floating]
Labels = NDArray[np.intp]
Place = tuple[float, float]  # x, y in pixels

STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
FOUR = ndimage.generate_binary_structure(2, 1)  # neighbours that share an edge
EIGHT = ndimage.generate_binary_structure(2, 2)  # diagonal ones too

SADDLE = 0.75  # two peaks are two touches where the ridge between them sinks below this fraction of the lower one
SADDLE_KNOWN = 0.95  # the same where two touches are expected: only a plateau makes them one
NEAR = 6.0  # pixels within which a peak is the one that was expected
WAIST_KNOWN = 0.92  # two touches are expected in one patch: they are two where it narrows to this fraction
WAIST_NEW = 0.6  # the same where one is expected, or none
LONG = 1.2  # times as long as wide: a rounder patch is one touch
LONG_KNOWN = 2.0  # or where it is so many times as long as wide
SLIMMEST = 0.15  # share of a patch that a part of it must have
CANDIDATES = 32  # local maxima looked at
MOST = 8  # touches


def peaks_of(smooth: Image, floor: float, expected: Sequence[Place]) -> list[tuple[int, int]]:
    """(row, column) of the maxima above the floor that are a touch's, highest first."""
    peaks: list[tuple[int, int]] = []
    free = list(expected)
    for peak in _maxima(smooth, floor):
        own = min(free, key=lambda p: _distance(p, peak), default=None)
        known = own is not None and _distance(own, peak) < NEAR
        if len(peaks) < MOST and _stands_alone(smooth, peak, peaks, SADDLE_KNOWN if known else SADDLE):
            peaks.append(peak)
            if own is not None and known:
                free.remove(own)
    return peaks


def _distance(place: Place, peak: tuple[int, int]) -> float:
    return float(np.hypot(place[0] - peak[1], place[1] - peak[0]))


def _maxima(smooth: Image, floor: float) -> list[tuple[int, int]]:
    """Local maxima above the floor, highest first; a flat top counts once."""
    top = (smooth == ndimage.maximum_filter(smooth, size=5)) & (smooth > floor)
    if top.sum() == 1:
        return [divmod(int(top.argmax()), top.shape[1])]
    flat, count = ndimage.label(top, EIGHT)
    if count == 0:
        return []
    places = {flat[iy, ix]: (iy, ix) for iy, ix in np.argwhere(flat).tolist()}.values()
    return sorted(places, key=lambda p: -smooth[p])[:CANDIDATES]


def _stands_alone(smooth: Image, peak: tuple[int, int], stronger: list[tuple[int, int]], saddle: float) -> bool:
    """Whether a valley lies between this peak and every stronger one."""
    if not stronger:
        return True
    labels, _ = ndimage.label(smooth > saddle * smooth[peak], FOUR)
    return all(labels[peak] != labels[other] for other in stronger)


def territories(smooth: Image, floor: float, peaks: list[tuple[int, int]]) -> Labels:
    """The peak that each pixel above the floor belongs to, 1, 2, ...: where steepest ascent leads; 0 below the
    floor.
    """
    above = smooth > floor
    if len(peaks) < 2:
        return above.astype(np.intp) * len(peaks)
    islands, count = ndimage.label(above, FOUR)
    order = [int(islands[peak]) for peak in peaks]
    if sorted(order) == list(range(1, count + 1)):  # far apart: one peak on each
        names = np.zeros(count + 1, dtype=np.intp)
        names[order] = range(1, count + 1)
        return np.asarray(names[islands])
    return np.asarray(_uphill(smooth, peaks) * above)


def _uphill(smooth: Image, peaks: list[tuple[int, int]]) -> Labels:
    """Which peak each pixel belongs to: steepest ascent from pixel to neighbour."""
    h, w = smooth.shape
    padded = np.pad(smooth, 1, constant_values=-np.inf)
    best, top = smooth.copy(), np.arange(h * w).reshape(h, w)
    for dy, dx in STEPS:
        neighbour = padded[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]
        higher = neighbour > best
        best[higher] = neighbour[higher]
        top[higher] = np.flatnonzero(higher) + dy * w + dx
    end = top.ravel()
    while not np.array_equal(end, further := end[end]):
        end = further
    ends, belongs = np.unique(end, return_inverse=True)
    # Ascent may end at a maximum that does not stand alone: it goes to the nearest one that does.
    away = np.linalg.norm(np.array(np.divmod(ends, w)).T[:, None] - np.array(peaks)[None], axis=2)
    return np.asarray(away.argmin(axis=1)[belongs].reshape(h, w) + 1, dtype=np.intp)


def cut(own: Image, expected: Sequence[Place]) -> NDArray[np.bool_] | None:
    """The smaller side (h, w) of a patch that is two touches grown together, or None where it is one.

    own: the smoothed image where it is this patch's, 0 elsewhere. The patch's profile along its longest axis (the drop
    summed across) has a waist where two touches meet, also where their peaks have become one plateau. Where two are
    expected, a patch that is long without a waist is two as well.
    """
    top = float(own.max())
    y, x = np.nonzero(own > 0.5 * top)
    weight = own[y, x]
    total = float(weight.sum())
    cx, cy = float(weight @ x) / total, float(weight @ y) / total
    dx, dy = x - cx, y - cy
    mxx, myy, mxy = (float(weight @ v) / total for v in (dx * dx, dy * dy, dx * dy))
    spread = math.hypot(mxx - myy, 2 * mxy)  # of the squared lengths of the two axes
    if mxx + myy + spread < LONG**2 * (mxx + myy - spread):
        return None
    angle = 0.5 * math.atan2(2 * mxy, mxx - myy)
    c, s = math.cos(angle), math.sin(angle)
    along = c * dx + s * dy
    start = float(along.min())
    profile = _profile(along - start, weight)
    depth = profile / np.minimum(np.maximum.accumulate(profile), np.maximum.accumulate(profile[::-1])[::-1])
    waist = float(depth.argmin())
    if depth[int(waist)] > WAIST_NEW:
        inside = sorted(c * (px - cx) + s * (py - cy) - start for px, py in expected if _covers(own, px, py))
        if len(inside) < 2:
            return None
        if depth[int(waist)] > WAIST_KNOWN:
            if mxx + myy + spread < LONG_KNOWN**2 * (mxx + myy - spread):
                return None
            waist = (inside[0] + inside[-1]) / 2
    share = float(weight[along - start < waist].sum()) / total
    if not SLIMMEST < share < 1 - SLIMMEST:
        return None
    rows, columns = np.indices(own.shape)
    beyond = c * (columns - cx) + s * (rows - cy) - start >= waist
    return np.asarray((beyond if share > 0.5 else ~beyond) & (own > 0))


def _profile(along: Image, weight: Image) -> Image:
    """Weights by place along an axis, one bin a pixel, each weight shared between its two bins; lightly smoothed."""
    low = along.astype(int)
    share = along - low
    n = int(low.max()) + 2
    profile = np.bincount(low, weight * (1 - share), n) + np.bincount(low + 1, weight * share, n)
    return np.convolve(profile, [0.25, 0.5, 0.25], mode="same")


def _covers(own: Image, x: float, y: float) -> bool:
    """Whether a patch covers a place."""
    h, w = own.shape
    column, row = round(x), round(y)
    return 0 <= column < w and 0 <= row < h and bool(own[row, column] > 0.25 * own.max())
