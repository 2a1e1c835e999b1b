"""Does the image explain the measurements? The forward residual.

The relative difference d is nearly linear in y = -log(1 - drop), with the drop in S/m on a background of 1: J y is
within 4 % of d (median over touches of drops to 0.9 S/m; 17 % for J times the drop itself), and costs one matrix-vector
product at the resolution of the bundle's Jacobian. What J y leaves, whitened by noise and by what may have drifted,
beyond noise, over what there was, is the share not explained: next to nothing for touches, nearly all for anything
else.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.prereconstruction import Drift
from services.estimation.images.reconstruct import MEANS, sigma_of_mean

KEPT = 10  # noises of frames whose matrices are kept, 0.3 MB each
MOST_DROP = 0.97  # S/m: a contact never cuts the sheet through
DRIFT = Drift(scale=2e-3, contact=1e-2)  # a change that drift of this size explains is not held against the image
CHANCE = 4.0  # standard deviations of chi-square that the noise may come to
REFUSED = 0.5  # share not explained from which an image is none of a touch
FAINT = 100.0  # energy over the noise's below which it is refused from REFUSED_FAINT on:
REFUSED_FAINT = 0.15  # of a faint touch noise hides what the image gets wrong, of a faint anything-else it does not


class Conditioned(NamedTuple):
    """For one noise of the frames."""

    whiten: NDArray[np.float32]  # (K, K)
    forward: NDArray[np.float32]  # (K, h * w), whitened
    noise: float  # the energy that noise may leave


class Residual:
    """For one bundle and image size. Conditioned once for each noise that frames come with: those of a touch that is
    held are means of 1, 2, 4, 8 or 16.
    """

    def __init__(self, bundle: Bundle, to_scale: bool) -> None:
        """to_scale: images are in S/m; else only their form counts, not their size."""
        self.pre, self.to_scale = bundle.prereconstructor(), to_scale
        self.shape: tuple[int, int] = bundle.matrices.inside.shape
        self.refused = False  # whether the last image that was given a share is of no touch
        self._known: OrderedDict[bytes, Conditioned | None] = OrderedDict()

    def __call__(
        self, difference: NDArray[np.float32], sigma: NDArray[np.float32], image: NDArray[np.float32]
    ) -> float | None:
        """(K,) difference and its standard deviation (infinite: not used), drop (n, n) [S/m] -> the share not
        explained: 0 up to 1, or beyond where the image makes it worse; None where it cannot be told.
        """
        h, w = self.shape
        if image.ndim != 2 or not image.size or image.shape[0] % h or image.shape[1] % w:
            return None
        if len(difference) != self.pre.measurements or (known := self._conditioned(sigma)) is None:
            return None
        y = np.clip(image, np.float32(0.0), np.float32(MOST_DROP))
        if self.to_scale:
            np.subtract(np.float32(1.0), y, out=y)
            np.log(y, out=y)
            np.negative(y, out=y)
        down, across = _means(h, w, *image.shape)
        coarse = (down @ y @ across).ravel()
        seen, expected = known.whiten @ difference, known.forward @ coarse
        if not self.to_scale:
            expected *= max(0.0, float(expected @ seen)) / max(float(expected @ expected), 1e-30)
        left = seen - expected
        beyond = float(left @ left) - known.noise
        energy = max(float(seen @ seen), known.noise)
        share = max(0.0, beyond) / energy
        self.refused = not share <= (REFUSED if energy > FAINT * known.noise else REFUSED_FAINT)
        return share if np.isfinite(share) else None

    def prepare(self, sigma: NDArray[np.float32]) -> bool:
        """Condition for one of the noises of a touch whose single frames have this one (K,); False where none is left
        to do. The first image of a touch would wait for it, 10 ms and more.
        """
        if len(sigma) != self.pre.measurements:
            return False
        for n in MEANS:
            of_mean = sigma_of_mean(sigma, n)
            is_new = of_mean.tobytes() not in self._known
            self._conditioned(of_mean)
            if is_new:
                return True
        return False

    def _conditioned(self, sigma: NDArray[np.float32]) -> Conditioned | None:
        """None where too few measurements count."""
        key = sigma.tobytes()
        if key not in self._known:
            self._known[key] = self._condition(sigma)
            if len(self._known) > KEPT:
                self._known.popitem(last=False)
        self._known.move_to_end(key)
        return self._known[key]

    def _condition(self, sigma: NDArray[np.float32]) -> Conditioned | None:
        live = np.isfinite(sigma)
        if live.sum() < len(sigma) / 4:
            return None
        operator = self.pre.condition(sigma.astype(float), drift=DRIFT, weights=live.astype(float))
        count = int(live.sum())
        return Conditioned(
            whiten=np.ascontiguousarray(operator.whiten, dtype=np.float32),
            forward=np.ascontiguousarray(operator.whiten @ operator.jacobian, dtype=np.float32),
            noise=count + CHANCE * float(np.sqrt(2 * count)),
        )


@lru_cache(maxsize=4)
def _means(h: int, w: int, rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(h, rows) and (columns, w): the mean over the pixels of each coarse one (a product is faster than `mean`)."""
    down = np.repeat(np.eye(h, dtype=np.float32), rows // h, axis=1) * np.float32(h / rows)
    across = np.repeat(np.eye(w, dtype=np.float32), columns // w, axis=0) * np.float32(w / columns)
    return np.ascontiguousarray(down), np.ascontiguousarray(across)
