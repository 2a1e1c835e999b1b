"""How much of the skin do the measurements of a frame see that came without all of them?

Touches anywhere are estimated from the measurements that are left (least squares with a prior, as in equation 1 of the
paper), and the share of a touch that is found again is compared with what all measurements find. With 15 of 120 lost
one after the other, a touch near the electrodes that they use keeps 0.55, and is given two thirds of its force; with 40
lost here and there it keeps 0.8, and its force.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.touch_grid import touches

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]

RADIUS = 0.2  # model units: of the touches that are asked for
NOISE = 0.1  # of d for a drop of 1 S/m at every place at once: what no touch of this size explains
PLACES = 0.05  # share of the places that may be seen worse than EVERYWHERE
EVERYWHERE = 0.5  # of a touch, wherever it may be
THERE = 0.56  # of the touch that explains the frame
EXPLAINS = 0.5  # of |d|^2, from which a touch explains it


class Coverage:
    """For one bundle: K measurements, touches at M places."""

    def __init__(self, bundle: Bundle) -> None:
        grid = touches(bundle.matrices, bundle.half_width, (RADIUS,))
        self._response = np.asarray(grid.response, dtype=float)  # (M, K)

    def found_again(self, live: Mask) -> Array:
        """(M,) share of a touch at each place that the measurements live (K,) find again."""
        seen = self._response[:, live]
        covariance = seen.T @ seen + NOISE**2 * np.eye(seen.shape[1])
        return np.asarray(np.einsum("mk,km->m", seen, np.linalg.solve(covariance, seen.T)))

    def enough(self, d: Array, live: Mask, all_of: Mask) -> bool:
        """Whether the measurements live (K,), of all_of (K,), see the skin, and the touch that d (K,) shows."""
        tiny = np.finfo(float).tiny
        share = self.found_again(live) / np.maximum(self.found_again(all_of), tiny)
        if np.quantile(share, PLACES) < EVERYWHERE:
            return False
        found = np.where(live, d, 0.0)
        explained = (self._response @ found) ** 2 / np.maximum(self._response**2 @ live, tiny)
        best = int(np.argmax(explained))
        return bool(explained[best] < EXPLAINS * (found @ found) or share[best] >= THERE)
