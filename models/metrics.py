"""Figures of merit of a reconstruction, in the field's definitions.

Images are conductivity drops [S/m], (n, n) on the square [-1, 1]^2, row 0 at the lowest y, positive where touched.
Lengths are model units unless named otherwise (`of_side` converts). Equation numbers are those of the
MM-CNN paper.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from models.shapes import Array, Shape, drop_image

Mask = NDArray[np.bool_]
SIDE = 2.0  # of the square, model units


def pixel_centres(n: int) -> Array:
    """(n, n, 2) x, y of each pixel."""
    line = -1 + 2 * (np.arange(n) + 0.5) / n
    return np.stack(np.meshgrid(line, line), axis=-1)


# -- LDCI -------------------------------------------------------------------------------------------------------------
def ldci_positions(spacing: float = 0.2, per_side: int = 7) -> Array:
    """(49, 2) positions of the paper's Figure 6: numbered from the top left, row by row, number 25 in the centre."""
    line = (np.arange(per_side) - per_side // 2) * spacing
    return np.array([(x, y) for y in line[::-1] for x in line])


def ldci(peaks: ArrayLike) -> float:
    """Location-dependent consistency indicator, equation 6: peaks (P,) of the same touch at P positions, P odd."""
    pv = np.asarray(peaks, float)
    centre = pv[len(pv) // 2]
    return float(np.abs((pv - centre) / centre).sum() / (len(pv) - 1))


# -- touches of an image ----------------------------------------------------------------------------------------------
def basins(image: Array, least: float = 0.15, prominence: float = 0.4) -> NDArray[np.int64]:
    """Labels (n, n) of the touches an image shows, 0 outside, 1 the highest.

    A peak is a touch if it is at least `least` of the highest one and falls by `prominence` of itself before it meets
    a higher one. Pixels are flooded from the top down; below half its own peak a touch does not reach.
    """
    flat = image.ravel()
    top = flat.max(initial=0.0)
    order = np.argsort(-flat, kind="stable")
    order = order[flat[order] > max(0.5 * least * top, 0.0)]
    owner, parent, peak = _flooded(image, order, prominence)
    root = np.array([*(_root(parent, k) for k in range(len(peak))), -1])
    touches = sorted({k for k in root.tolist() if k >= 0 and peak[k] >= least * top}, key=lambda k: -peak[k])
    labels = np.zeros(image.shape, int)
    for number, k in enumerate(touches, start=1):
        labels[(root[owner] == k) & (image > 0.5 * peak[k])] = number
    return labels


def _flooded(
    image: Array, order: NDArray[np.intp], prominence: float
) -> tuple[NDArray[np.int64], list[int], list[float]]:
    """(n, n) the peak that each pixel was first flooded from (-1: not flooded); of each peak the one that it is a
    shoulder of, itself where it is none, and its height.
    """
    owner = np.pad(np.full(image.shape, -1), 1, constant_values=-1)
    parent: list[int] = []
    peak: list[float] = []
    for y, x in zip(*np.unravel_index(order, image.shape), strict=True):
        around, value = owner[y : y + 3, x : x + 3], image[y, x]
        near = {_root(parent, k) for k in around[around >= 0].tolist()}
        if not near:
            near = {len(peak)}
            parent.append(len(peak))
            peak.append(float(value))
        highest = max(near, key=lambda k: peak[k])
        around[1, 1] = highest
        for other in near - {highest}:
            if peak[other] - value < prominence * peak[other]:  # a shoulder, not a touch
                parent[other] = highest
    return owner[1:-1, 1:-1], parent, peak


def _root(parent: list[int], k: int) -> int:
    while parent[k] != k:
        k = parent[k]
    return k


def touch_masks(image: Array, shapes: Sequence[Shape]) -> list[Mask]:
    """The part of an image that answers for each true touch, thresholded at half its own peak.

    A pixel answers for the touch whose outline is nearest. Where the image shows nothing the mask is empty.
    """
    points = pixel_centres(len(image)).reshape(-1, 2)
    distance = [np.where(s.contains(points), 0.0, s.edge_distance(points)) for s in shapes]
    nearest = np.argmin(distance, axis=0).reshape(image.shape)
    masks = []
    for k in range(len(shapes)):
        own = np.where(nearest == k, image, 0.0)
        masks.append(own > 0.5 * own.max() if own.max() > 0 else np.zeros(image.shape, bool))
    return masks


# -- IoU --------------------------------------------------------------------------------------------------------------
def iou(estimate: Mask, truth: Mask) -> tuple[float, float]:
    """(mean IoU of equation 7 over contact and background, contact IoU) of two masks."""

    def one(a: Mask, b: Mask) -> float:
        union = (a | b).sum()
        return float((a & b).sum() / union) if union else 1.0

    contact = one(estimate, truth)
    return (contact + one(~estimate, ~truth)) / 2, contact


# -- place ------------------------------------------------------------------------------------------------------------
def centroid(weights: NDArray[np.floating | np.bool_]) -> Array:
    """(2,) centroid of a mask or of non-negative weights (n, n); NaN where all are zero."""
    w = np.asarray(weights, float)
    total = w.sum()
    return np.asarray((pixel_centres(len(w)) * w[..., None]).sum((0, 1)) / total) if total else np.full(2, np.nan)


def position_error(mask: Mask, shape: Shape) -> float:
    """Distance of the mask's centroid from the centroid of the patch; half the skin's diagonal for an empty mask."""
    found = centroid(mask)
    return float(np.hypot(*(found - shape.centroid))) if np.isfinite(found).all() else SIDE / np.sqrt(2)


def of_side(distance: ArrayLike) -> Array:
    """Model units -> per cent of the skin's side."""
    return np.asarray(np.asarray(distance, float) / SIDE * 100)


# -- force ------------------------------------------------------------------------------------------------------------
def relative_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Per cent, without sign: force error where force is linear in the (peak or integrated) drop."""
    truth = np.asarray(truth, float)
    return np.asarray(np.abs(np.asarray(estimate, float) - truth) / truth * 100)


def integrated(image: Array) -> float:
    """Integrated drop, S/m times square model units."""
    return float(image.sum() * (SIDE / len(image)) ** 2)


# -- likeness of images -----------------------------------------------------------------------------------------------
def correlation(image: Array, truth: Array) -> float:
    """Pearson correlation of the pixels; 0 where one of them is flat."""
    if image.std() == 0 or truth.std() == 0:
        return 0.0
    return float(np.corrcoef(image.ravel(), truth.ravel())[0, 1])


def ssim(image: Array, truth: Array, sigma: float = 1.5) -> float:
    """Structural similarity, Wang et al. 2004: Gaussian window, K1 = 0.01, K2 = 0.03, range = the truth's."""
    spread = float(truth.max() - truth.min())
    if spread == 0:
        raise ValueError("SSIM needs a truth that is not flat: its range sets the scale")
    c1, c2 = (0.01 * spread) ** 2, (0.03 * spread) ** 2

    def blur(a: Array) -> Array:
        return np.asarray(ndimage.gaussian_filter(a, sigma, truncate=3.5, mode="reflect"))

    a, b = image.astype(float), truth.astype(float)
    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    index = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    return float(index.mean())


# -- one frame --------------------------------------------------------------------------------------------------------
def score(image: Array, shapes: Sequence[Shape], truth: Array | None = None) -> dict[str, float]:
    """All image figures of one frame of touches `shapes`; `truth` (n, n) saves rasterising it.

    position, force and integral only for a single touch; position in model units, errors in per cent.
    """
    truth = drop_image(shapes, len(image)) if truth is None else truth
    masks = touch_masks(image, shapes)
    covered = np.zeros(image.shape, bool)
    for shape in shapes:
        covered |= shape.fraction(len(image), covered=True) > 0.5
    mean, contact = iou(np.any(masks, axis=0), covered)
    found = {
        "mean_iou": mean,
        "contact_iou": contact,
        "correlation": correlation(image, truth),
        "ssim": ssim(image, truth),
        "count": float(basins(image[::2, ::2] if len(image) > 64 else image).max()),
    }
    if len(shapes) == 1:
        shape = shapes[0]
        found["position"] = position_error(masks[0], shape)
        found["peak"] = float(image.max())
        found["force_error"] = float(relative_error(image.max(), shape.drop))
        found["integral_error"] = float(relative_error(integrated(image), shape.integral))
    return found
