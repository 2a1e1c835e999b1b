"""Touches in an image of the conductivity drop: each thresholded at half its own peak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float32]

FLOOR = 0.02  # S/m: a weaker peak is no touch (0.2 N by the default law)
RELATIVE_FLOOR = 0.12  # of the strongest peak: weaker ones are side lobes of it
SIGNIFICANT = 3.0  # standard deviations of the image that a peak must exceed
SADDLE = 0.75  # two peaks are two touches where the ridge between them sinks below this fraction of the lower one
SMALLEST = 3  # pixels of a touch
PLATEAU = 0.9  # fraction of the highest pixel above which pixels belong to the peak
MOST = 8  # touches
SMOOTHING = 1.0  # pixels, of the image in which peaks are looked for


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
    top = float(image.max(initial=0.0))
    floor = max(FLOOR, RELATIVE_FLOOR * top)
    if not np.isfinite(top) or top < floor:
        return []
    smooth = ndimage.gaussian_filter(image, SMOOTHING)
    candidates = np.argwhere((smooth == ndimage.maximum_filter(smooth, size=5)) & (smooth > 0.5 * floor))
    order = sorted(candidates.tolist(), key=lambda p: -smooth[p[0], p[1]])
    peaks: list[tuple[int, int]] = []
    for iy, ix in order[: 4 * MOST]:
        if _stands_alone(smooth, (iy, ix), peaks):
            peaks.append((iy, ix))
    basins = _basins(smooth, peaks)
    found = []
    for index, peak in enumerate(peaks[:MOST]):
        one = _measure(image, sigma, basins == index + 1 if basins is not None else None, peak, floor)
        if one is not None:
            found.append(one)
    return sorted(found, key=lambda s: -s.peak)


def _stands_alone(smooth: Image, peak: tuple[int, int], stronger: list[tuple[int, int]]) -> bool:
    """Whether a valley lies between this peak and every stronger one."""
    if not stronger:
        return True
    labels, _ = ndimage.label(smooth > SADDLE * smooth[peak])
    return all(labels[peak] != labels[other] for other in stronger)


def _basins(smooth: Image, peaks: list[tuple[int, int]]) -> NDArray[np.int16] | None:
    """Which peak each pixel drains to (1, 2, ...); None where there is only one."""
    if len(peaks) < 2:
        return None
    markers = np.zeros(smooth.shape, np.int16)
    for index, peak in enumerate(peaks):
        markers[peak] = index + 1
    depth = np.clip(255 * (1 - smooth / smooth.max()), 0, 255).astype(np.uint8)
    return np.asarray(ndimage.watershed_ift(depth, markers), np.int16)


def _measure(
    image: Image, sigma: Image, basin: NDArray[np.bool_] | None, at: tuple[int, int], floor: float
) -> Segment | None:
    own = image if basin is None else np.where(basin, image, np.float32(0))
    top = _highest_near(own, at)
    peak = float(own[top])
    if peak < floor:
        return None
    mask = own > 0.5 * peak
    labels, count = ndimage.label(mask)
    if count > 1:
        mask = labels == labels[top]
    y, x = np.nonzero(mask)
    area = len(x)
    if area < SMALLEST:
        return None
    peak_sigma = float(sigma[mask].mean()) if sigma.size else 0.0
    if peak_sigma and peak < SIGNIFICANT * peak_sigma:
        return None
    cx, cy = float(x.mean()), float(y.mean())
    mxx, myy, mxy = ((x - cx) ** 2).mean(), ((y - cy) ** 2).mean(), ((x - cx) * (y - cy)).mean()
    orientation = 0.5 * float(np.arctan2(2 * mxy, mxx - myy))
    return Segment(mask, _plateau(image[mask]), peak_sigma, float(image[mask].sum()), cx, cy, float(area), orientation)


def _highest_near(image: Image, at: tuple[int, int]) -> tuple[int, int]:
    """The highest pixel within two of `at`: smoothing moves a peak a little."""
    y0, x0 = max(0, at[0] - 2), max(0, at[1] - 2)
    near = image[y0 : at[0] + 3, x0 : at[1] + 3]
    iy, ix = divmod(int(near.argmax()), near.shape[1])
    return y0 + iy, x0 + ix


def _plateau(values: NDArray[np.float32]) -> float:
    """Peak drop of a touch: the mean of its pixels near the highest, which one noisy pixel does not move."""
    return float(values[values >= PLATEAU * values.max()].mean())
