"""A step of the board's gain: all measurements change by one common factor between two frames, and by nothing else.

A touch that comes, goes or moves changes pairs near it more than others; so does a contact. Two frames are compared,
not a frame and the baseline: so a step is told under a held touch as well. A factor is named where the common change is
six standard deviations of its own noise and what it leaves is no more than noise. An unchanged gain passes for a step
with a probability below 1e-8 a frame. While a touch moves, it changes the frame by nearly what it changed the frame
before by: that is told apart as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.floating]

MOTION = (0.0, 3.0)  # of what a touch that moves changed before, it changes so much from one frame to the next


def common_factor(
    before: Array,
    now: Array,
    sigma: Array,
    live: NDArray[np.bool_],
    tuning: Tuning = TUNING,
    earlier: Array | None = None,
) -> float | None:
    """now / before of (K,) |Z| where all live pairs have it in common; None where they changed otherwise, or not at
    all. sigma (K,): relative standard deviation of one frame. earlier (K,): |Z| of a frame before `before`,
    where a touch moves: what it changed from there to `before` it may change again, in any amount of MOTION.
    """
    count = int(live.sum())
    if count < len(live) / 2:
        return None
    change, one = now[live] / before[live] - 1.0, np.ones(count)
    if earlier is None:
        motion, columns, noise = 0.0, one[:, None], np.sqrt(2.0) * sigma[live]
    else:
        moved = before[live] / earlier[live] - 1.0
        columns = np.column_stack([one, moved])
        motion = float(_fit(change, columns, sigma[live])[0][1])
        if not MOTION[0] < motion < MOTION[1]:
            return None
        noise = np.sqrt(1.0 + (1.0 + motion) ** 2 + motion**2) * sigma[live]
    found, variance = _fit(change, columns, noise)
    gain = float(found[0])
    if not variance > 0:  # rounding: what moved is one factor too, so the two cannot be told apart
        return None
    if not abs(gain) > max(tuning.gain_least, tuning.gain_sigmas * variance**0.5):
        return None
    # Noise is relative: after a factor, the frame's own has it too.
    left = float((((change - columns @ found) / (noise * max(1.0, 1.0 + gain))) ** 2).sum())
    return 1.0 + gain if left < count + tuning.gain_left * np.sqrt(2.0 * count) else None


def _fit(change: Array, columns: Array, noise: Array) -> tuple[Array, float]:
    """Weighted least squares: the columns' amounts, and the variance of the first."""
    white = columns / noise[:, None]
    inverse = np.linalg.pinv(white.T @ white)
    return np.asarray(inverse @ (white.T @ (change / noise))), float(inverse[0, 0])
