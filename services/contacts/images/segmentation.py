"""Touches in an image of the conductivity drop: each thresholded at half its own peak.

Where touches merge they are told apart by the valley between their peaks (splitting.py says which part of the image is
whose). The tracker's expectation counts as evidence: a shallower valley is enough to separate two known touches than
two new ones. Every pixel of the smoothed image above the floor belongs to exactly one touch, so that the integrated
drop is the same however a patch is split.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from services.contacts.images.splitting import FOUR, Image, Labels, Place, cut, peaks_of, territories

FLOOR = 0.02  # S/m: a weaker peak is no touch (0.2 N by the published law)
RELATIVE_FLOOR = 0.12  # of the strongest peak: weaker ones are side lobes of it
PLATEAU = 0.9  # fraction of the highest pixel above which pixels belong to the peak
LARGEST = 1e6  # S/m: beyond it a number is no conductivity
MARGIN = 4  # pixels round the box that is looked at
SMALLEST = 3  # pixels of a touch
SMOOTHING = 1.0  # pixels: standard deviation of the Gaussian under which peaks are looked for
KERNEL = np.exp(-0.5 * (np.arange(-4, 5) / SMOOTHING) ** 2)
KERNEL /= KERNEL.sum()


@dataclass
class Segment:
    """One touch in pixels: mask (H, W) of at least half its peak, peak drop [S/m], centroid and moments of the mask."""

    mask: NDArray[np.bool_]
    peak: float
    peak_sigma: float
    volume: float  # sum of the drop over all pixels that are this touch's, S/m * pixels: conserved under splitting
    x: float
    y: float
    area: float  # pixels
    orientation: float  # rad, of the longest axis to x, -pi/2 to pi/2
    reach: float  # pixels from the centroid to the farthest of the mask


def readable(image: Image) -> bool:
    """Whether every pixel is a number that a conductivity can be."""
    return image.ndim == 2 and bool((np.abs(image) < LARGEST).all())  # NaN compares false


def segment(image: Image, sigma: Image, expected: Sequence[Place] = ()) -> list[Segment]:
    """Touches of a drop image (H, W) [S/m] with its standard deviation (H, W) or (0, 0); strongest first.

    expected: (x, y) [pixels] of touches that were there a moment ago. An image that is not `readable` has no touches.
    """
    if not image.size or not readable(image):
        return []
    top = float(image.max())
    floor = max(FLOOR, RELATIVE_FLOOR * top)
    if top <= floor:
        return []
    high = image > 0.5 * floor
    rows, columns = _box(high)
    part = image[rows, columns].astype(np.float64)
    smooth = _smoothed(part)
    near = [(x - columns.start, y - rows.start) for x, y in expected]
    labels, count = _labels(smooth, floor, near)
    volumes = np.bincount(labels.ravel(), part.ravel(), count + 1)
    noise = sigma[rows, columns] if sigma.shape == image.shape else np.zeros((0, 0))
    found = []
    for label in range(1, count + 1):
        own = np.where(labels == label, smooth, 0.0)
        found.append(_measured(part, noise, own, image.shape, (rows.start, columns.start), float(volumes[label])))
    return sorted(found, key=lambda s: -s.peak)


def divided(image: Image, sigma: Image, places: Sequence[Place]) -> list[Segment]:
    """The same image as touches that are known to be at these (x, y) [pixels], one each, in their order: every pixel is
    the nearest one's. Where the image shows nothing of a touch, its pixel and the four round it.
    """
    smooth = _smoothed(image.astype(np.float64))
    floor = max(FLOOR, RELATIVE_FLOOR * float(image.max(initial=0.0)))
    y, x = np.indices(image.shape)
    nearest = np.argmin([(x - px) ** 2 + (y - py) ** 2 for px, py in places], axis=0)
    found = []
    for number, (px, py) in enumerate(places):
        own = np.where((nearest == number) & (smooth > 0.5 * floor), smooth, 0.0)
        volume = float(image[own > 0].sum())
        if own.max() <= 0:
            column, row = (int(min(max(round(p), 0), n - 1)) for p, n in ((px, image.shape[1]), (py, image.shape[0])))
            own[row, column] = floor
        found.append(_measured(image, sigma, own, image.shape, (0, 0), volume))
    return found


def class_probabilities(s: Segment, classes: NDArray[np.float32]) -> list[float]:
    """Mean over the touch of the per-pixel class probabilities (5, h, w), which are on a coarser grid; [] where there
    are none.
    """
    if not classes.size or not (classes.min() >= 0 and classes.max() <= 1.001):  # NaN compares false
        return []
    y, x = np.nonzero(s.mask)
    count, h, w = classes.shape
    pixels = np.bincount(y * h // s.mask.shape[0] * w + x * w // s.mask.shape[1], minlength=h * w)
    total = classes.reshape(count, h * w) @ pixels.astype(np.float32)
    return [min(1.0, float(p)) for p in total / max(float(total.sum()), 1e-9)]


def _smoothed(image: Image) -> Image:
    return np.asarray(ndimage.correlate1d(ndimage.correlate1d(image, KERNEL, 0), KERNEL, 1))


def _box(high: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns round all high pixels, with a margin: empty pixels cost time too."""
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(high.any(axis=axis))
        spans.append(slice(max(0, int(at[0]) - MARGIN), int(at[-1]) + 1 + MARGIN))
    return spans[0], spans[1]


def _labels(smooth: Image, floor: float, expected: Sequence[Place]) -> tuple[Labels, int]:
    """Which touch each pixel belongs to, 1, 2, ..., or 0; and how many there are."""
    peaks = peaks_of(smooth, floor, expected)
    while True:
        labels = territories(smooth, 0.5 * floor, peaks)
        if len(peaks) == 1:
            break
        small = [p for k, p in enumerate(peaks) if ((labels == k + 1) & (smooth > 0.5 * smooth[p])).sum() < SMALLEST]
        if not small:
            break
        peaks.remove(small[-1])  # a speck: its pixels go to a neighbour
    label, count = 1, len(peaks)
    while label <= count:
        side = cut(np.where(labels == label, smooth, 0.0), expected)
        if side is None:
            label += 1
        else:
            count += 1
            labels[side] = count
    return labels, count


def _measured(
    image: Image, sigma: Image, own: Image, shape: tuple[int, ...], corner: tuple[int, int], volume: float
) -> Segment:
    """The touch in numbers; own: its part of the smoothed image, shape: of the whole image, corner: row and column
    there of these.
    """
    top = int(own.argmax())
    labels, _ = ndimage.label(own > 0.5 * own.flat[top], FOUR)
    mask = labels == labels.flat[top]  # the pixels above half the peak that are connected to it
    whole = np.zeros(shape, dtype=bool)
    whole[corner[0] : corner[0] + mask.shape[0], corner[1] : corner[1] + mask.shape[1]] = mask
    values = image[mask]
    peak = values[values >= PLATEAU * values.max()]  # its mean is what one noisy pixel does not move
    noise = sigma[mask] if sigma.size else sigma
    peak_sigma = float(noise.mean()) if noise.size and np.isfinite(noise).all() else 0.0
    y, x = np.nonzero(ndimage.binary_dilation(mask, FOUR))
    weight = np.clip(2 * own[y, x] / own.max() - 0.5, 0, 1)  # pixels on the edge count in part
    area = float(weight.sum())
    cx, cy = float(weight @ x) / area, float(weight @ y) / area
    dx, dy = x - cx, y - cy
    mxx, myy, mxy = (float(weight @ v) / area for v in (dx * dx, dy * dy, dx * dy))
    return Segment(
        mask=whole,
        peak=float(peak.mean()),
        peak_sigma=peak_sigma,
        volume=volume,
        x=cx + corner[1],
        y=cy + corner[0],
        area=area,
        orientation=0.5 * float(np.arctan2(2 * mxy, mxx - myy)),
        reach=float(np.sqrt((dx * dx + dy * dy).max())),
    )
