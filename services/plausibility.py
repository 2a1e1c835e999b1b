"""Differences that no touch can make: gross faults of the board that nothing else tells from a touch.

Pressing lowers the sheet's conductivity, and the impedance between two electrodes can only rise with it (Rayleigh's
monotonicity: it is the least dissipation of any current between them). It also leaves the pairs far from it nearly
alone. So a pair that fell, or all pairs risen together, is a wire exchanged, a multiplexer that stuck, another gain.
In simulation (drops to 0.85 S/m, radii to 0.6 of half the side, one to three touches) no pair falls, and the least of
all pairs rises by at most 0.4 %; exchanged wires let one fall by 8 % or more, a stuck address bit by 60 %.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LIMIT = 0.03  # relative: a few kelvin on the sheet, or a contact that wears, are left to the tare
SIGMAS = 6.0


def impossible(d: Array, sigma: Array, pairs: NDArray[np.bool_]) -> bool:
    """Whether (K,) differences d with standard deviations sigma are of no touch. pairs (K,): live measurements between
    the very two electrodes that they drive; too few of them tell nothing.
    """
    if pairs.sum() < len(d) / 2:
        return False
    least = d[pairs]
    return bool((least + SIGMAS * sigma[pairs]).min() < -LIMIT or least.min() > LIMIT)
