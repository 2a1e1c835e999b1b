"""The bundle's own sensitivities as fields over the skin, without the singular points at electrodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from models.bundle import Bundle

Array = NDArray[np.float64]

_known: dict[tuple[str, float], Array] = {}


def sensitivities(bundle: Bundle, blur: float) -> Array:
    """(K, h, w) the sensitivities averaged over a press `blur` pixels wide."""
    key = (bundle.hash, blur)
    if key not in _known:
        while len(_known) > 4:
            _known.pop(next(iter(_known)))
        _known[key] = _averaged(bundle, blur)
    return _known[key]


def _averaged(bundle: Bundle, blur: float) -> Array:
    m = bundle.matrices
    inside = m.inside.astype(float)
    weight = np.maximum(ndimage.gaussian_filter(inside, blur), 0.2)
    found = []
    for row in m.jacobian.astype(float).reshape(-1, *m.inside.shape):
        limit = np.percentile(np.abs(row), 98)
        found.append(ndimage.gaussian_filter(np.clip(row, -limit, limit) * inside, blur) / weight)
    return np.array(found)


def sample(fields: Array, points: Array, half_width_m: float) -> Array:
    """Values (N, K) of fields (K, h, w) at (N, 2) points [m] of the skin's frame; the edge's value outside."""
    h, w = fields.shape[1:]
    x = np.clip((points[:, 0] / half_width_m + 1) * w / 2 - 0.5, 0, w - 1)
    y = np.clip((points[:, 1] / half_width_m + 1) * h / 2 - 0.5, 0, h - 1)
    left, low = np.minimum(x.astype(int), w - 2), np.minimum(y.astype(int), h - 2)
    right, up = x - left, y - low
    lower = (1 - right) * fields[:, low, left] + right * fields[:, low, left + 1]
    upper = (1 - right) * fields[:, low + 1, left] + right * fields[:, low + 1, left + 1]
    return np.asarray(((1 - up) * lower + up * upper).T)


def half_width(bundle: Bundle) -> float:
    """Half the side of the bundle's image, in its metres."""
    return 0.5 * bundle.image_size * bundle.metres_per_pixel


def pixels(bundle: Bundle) -> Array:
    """(h * w, 2) m: the centres of the pixels of the bundle's matrices."""
    h, w = bundle.matrices.inside.shape
    width = half_width(bundle)
    x, y = ((-1 + 2 * (np.arange(n) + 0.5) / n) * width for n in (w, h))
    return np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1)


def electrodes(bundle: Bundle) -> Array:
    """(E, 2) m: the electrodes' centres in the bundle's frame; the image's corners where the manifest has none."""
    said = bundle.skin.get("electrodes", {})
    if isinstance(said, dict) and said.get("centre"):
        return np.asarray(said["centre"], float) * bundle.metres_per_unit
    return half_width(bundle) * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
