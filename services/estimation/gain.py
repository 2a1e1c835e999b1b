"""A step of the board's gain: all measurements change by one common factor between two frames, and by nothing else.

A touch that comes, goes or moves changes pairs near it more than others; so does a contact. Two frames are compared,
not a frame and the baseline: so a step is told under a held touch as well. A factor is named where the common change is
six standard deviations of its own noise and what it leaves is no more than noise. An unchanged gain passes for a step
with a probability below 1e-8 a frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.estimation.tuning import TUNING, Tuning

Array = NDArray[np.floating]


def common_factor(
    before: Array, now: Array, sigma: Array, live: NDArray[np.bool_], tuning: Tuning = TUNING
) -> float | None:
    """now / before of (K,) |Z| where all live pairs have it in common; None where they changed otherwise, or not at
    all. sigma (K,): relative standard deviation of one frame.
    """
    count = int(live.sum())
    if count < len(live) / 2:
        return None
    change, noise = now[live] / before[live] - 1.0, np.sqrt(2.0) * sigma[live]
    weight = noise**-2
    gain = float(weight @ change / weight.sum())
    if not abs(gain) > max(tuning.gain_least, tuning.gain_sigmas * float(weight.sum()) ** -0.5):
        return None
    # Noise is relative: after a factor, the frame's own has it too.
    left = float((((change - gain) / (noise * max(1.0, 1.0 + gain))) ** 2).sum())
    return 1.0 + gain if left < count + tuning.gain_left * np.sqrt(2.0 * count) else None
