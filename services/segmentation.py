"""Touches in an image of the conductivity drop: each thresholded at half its own peak."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.floating]
STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
EIGHT = np.ones((3, 3), dtype=bool)  # neighbours, diagonal ones too

FLOOR = 0.02  # S/m: a weaker peak is no touch (0.2 N by the default law)
RELATIVE_FLOOR = 0.12  # of the strongest peak: weaker ones are side lobes of it
SADDLE = 0.75  # two peaks are two touches where the ridge between them sinks below this fraction of the lower one
CANDIDATES = 32  # local maxima looked at
MARGIN = 4  # pixels round the box that is looked at
SMALLEST = 3  # pixels of a touch
PLATEAU = 0.9  # fraction of the highest pixel above which pixels belong to the peak
MOST = 8  # touches
SMOOTHING = 1.0  # pixels: standard deviation of the Gaussian under which peaks are looked for
KERNEL = np.exp(-0.5 * (np.arange(-4, 5) / SMOOTHING) ** 2)
KERNEL /= KERNEL.sum()


@dataclass
class Segment:
    """One touch in pixels: mask (H, W) of at least half its peak, peak drop [S/m], centroid and moments of the mask."""

    mask: NDArray[np.bool_]
    peak: float
    peak_sigma: float
    volume: float  # sum of the drop over the mask, S/m * pixels
    x: float
    y: float
    area: float  # pixels
    orientation: float  # rad, of the longest axis to x


def segment(image: Image, sigma: Image) -> list[Segment]:
    """Touches of a drop image (H, W) [S/m] with its standard deviation (H, W) or (0, 0); strongest first."""
    shape, top = image.shape, float(image.max(initial=0.0))
    floor = max(FLOOR, RELATIVE_FLOOR * top)
    if not np.isfinite(top) or top < floor or not np.isfinite(image).all():
        return []
    rows, columns = _box(image > 0.5 * floor)
    image, sigma = image[rows, columns].astype(np.float64), sigma[rows, columns]
    smooth = ndimage.correlate1d(ndimage.correlate1d(image, KERNEL, 0), KERNEL, 1)
    peaks: list[tuple[int, int]] = []
    for peak in _maxima(smooth, floor):
        if len(peaks) < MOST and _stands_alone(smooth, peak, peaks):
            peaks.append(peak)
    basins = _basins(smooth, peaks)
    found = []
    for index, peak in enumerate(peaks):
        own = smooth if basins is None else np.where(basins == index + 1, smooth, 0.0)
        one = _measure(image, sigma, own, peak)
        if one is not None:
            found.append(_placed(one, shape, rows, columns))
    return sorted(found, key=lambda s: -s.peak)


def _box(high: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns round all high pixels, with a margin: empty pixels cost time too."""
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(high.any(axis=axis))
        spans.append(slice(max(0, int(at[0]) - MARGIN), int(at[-1]) + 1 + MARGIN))
    return spans[0], spans[1]


def _placed(s: Segment, shape: tuple[int, ...], rows: slice, columns: slice) -> Segment:
    """A segment of the box as one of the whole image."""
    mask = np.zeros(shape, dtype=bool)
    mask[rows, columns] = s.mask
    return dataclasses.replace(s, mask=mask, x=s.x + columns.start, y=s.y + rows.start)


def _maxima(smooth: Image, floor: float) -> list[tuple[int, int]]:
    """Local maxima above the floor, highest first; a flat top counts once."""
    flat, count = ndimage.label((smooth == ndimage.maximum_filter(smooth, size=5)) & (smooth > floor), EIGHT)
    if count == 0:
        return []
    places = {flat[iy, ix]: (iy, ix) for iy, ix in np.argwhere(flat).tolist()}.values()
    return sorted(places, key=lambda p: -smooth[p])[:CANDIDATES]


def _stands_alone(smooth: Image, peak: tuple[int, int], stronger: list[tuple[int, int]]) -> bool:
    """Whether a valley lies between this peak and every stronger one."""
    if not stronger:
        return True
    labels, _ = ndimage.label(smooth > SADDLE * smooth[peak])
    return all(labels[peak] != labels[other] for other in stronger)


def _basins(smooth: Image, peaks: list[tuple[int, int]]) -> NDArray[np.integer] | None:
    """Which peak each pixel belongs to, 1, 2, ...: where steepest ascent leads to. None where there is only one."""
    if len(peaks) < 2:
        return None
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
    return np.asarray(away.argmin(axis=1)[belongs].reshape(h, w) + 1)


def _measure(image: Image, sigma: Image, own: Image, at: tuple[int, int]) -> Segment | None:
    """The touch whose peak is at `at` in its own part of the smoothed image."""
    peak = own[at]
    mask = own > 0.5 * peak
    labels, count = ndimage.label(mask)
    if count > 1:
        mask = labels == labels[at]
    if mask.sum() < SMALLEST:
        return None
    height = _plateau(image[mask])
    peak_sigma = float(sigma[mask].mean()) if sigma.size else 0.0
    y, x = np.nonzero(_grown(mask))
    weight = np.clip(2 * own[y, x] / peak - 0.5, 0, 1)  # pixels on the edge count in part
    area = float(weight.sum())
    cx, cy = float(weight @ x) / area, float(weight @ y) / area
    mxx, myy, mxy = (float(weight @ v) / area for v in ((x - cx) ** 2, (y - cy) ** 2, (x - cx) * (y - cy)))
    orientation = 0.5 * float(np.arctan2(2 * mxy, mxx - myy))
    return Segment(mask, height, peak_sigma, float(image[mask].sum()), cx, cy, area, orientation)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask and the pixels that share an edge with it."""
    grown = mask.copy()
    grown[1:] |= mask[:-1]
    grown[:-1] |= mask[1:]
    grown[:, 1:] |= mask[:, :-1]
    grown[:, :-1] |= mask[:, 1:]
    return grown


def _plateau(values: Image) -> float:
    """Peak drop of a touch: the mean of its pixels near the highest, which one noisy pixel does not move."""
    return float(values[values >= PLATEAU * values.max()].mean())
