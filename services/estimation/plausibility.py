"""Some differences no touch can make: gross faults of the board that nothing else tells from a touch.

Pressing lowers the sheet's conductivity, and the impedance between two electrodes can only rise with it (Rayleigh's
monotonicity: it is the least dissipation of any current between them). It also leaves the pairs far from it nearly
alone. So a pair that fell, or all pairs risen together, is a wire exchanged, a multiplexer that stuck, another gain.
In simulation (drops to 0.85 S/m, radii to 0.6 of half the side, one to three touches) no pair falls, the least of
all pairs rises by at most 0.4 %, and their variance is 0.16 of their squared mean at least (0.27 for one or two
touches); exchanged wires let one fall by 8 % or more, a stuck address bit by 60 %, and a gain moves all alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

LIMIT = 0.03  # relative: a few kelvin on the sheet, or a contact that wears, are left to the tare
SIGMAS = 6.0
RISEN = 0.006  # relative: all pairs risen by more are no touch either, where drift was not what made the change
DRIFTED = 1e-3  # relative fall that a touched skin's drift may come to
EVEN = 0.02  # variance over squared mean below which pairs moved all alike, as a gain moves them
CLEAR = 3.0  # standard deviations of one pair that they must have moved by, for that to be told
FALLEN = 0.3  # share of a change's energy that is of falls, beyond which it is no touch


def impossible(d: Array, sigma: Array, pairs: NDArray[np.bool_], touched: bool) -> bool:
    """Returns whether (K,) differences d with standard deviations sigma are of no touch. pairs (K,): live measurements
    between the very two electrodes that they drive; too few of them tell nothing. touched: they are taken for a
    touch's.
    """
    if pairs.sum() < len(d) / 2:
        return False
    change, noise = d[pairs], SIGMAS * sigma[pairs]
    if (change + noise).min() < -LIMIT or change.min() > LIMIT:
        return True
    if touched and (change.min() > RISEN or _even(change, sigma[pairs])):
        return True
    falls = np.minimum(change + np.maximum(noise, DRIFTED), 0.0)
    return touched and bool(falls @ falls > FALLEN * (change @ change))


def _even(change: Array, sigma: Array) -> bool:
    """Returns whether all pairs rose alike, beyond noise."""
    mean, noise = float(change.mean()), float(sigma @ sigma) / len(sigma)
    return mean > CLEAR * noise**0.5 and float(change.var()) - noise < EVEN * mean * mean
