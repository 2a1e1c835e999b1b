"""What a frame is off by from what its touch makes of it: noise, drift, and what the response is wrong by (numpy only).

The response of models/touch_response.py is wrong by a few per mille, as any two meshes are from each other. As a
covariance of the frame it is spread over the directions that touches make, and grows with the drop and with corners,
whose field cells do not resolve. What it does to a touch's parameters has a structure that such a covariance lacks: a
place is off where the skin's outline is near, since there fields are steep and tables coarse; drop and size are off
together, and by more where the touch is large, since all of its edge is put off by the same amount.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from models.shapes import Array, Shape

FLOOR = 5e-6  # of |Z|: two meshes differ by as much where a touch does least
MISFIT = 3.5e-3  # of |d|: what the response is wrong by, over the directions that touches make
MISFIT_ODDS = 0.55  # and it grows with the drop's odds: a drop of a half has all of it, one of a tenth a third
MISFIT_EACH = 0.2  # of that: in each measurement by itself
CORNERED = {"circle": 1.0, "hertz": 1.0, "square": 1.3, "L": 1.7, "triangle": 2.8, "rectangle": 2.8}
"""What the response of each kind is wrong by, over a circle's: the cells do not resolve the field at corners."""
MISFIT_POWER = 0.4  # of the Gram matrix's eigenvalues: that error looks almost as touches do
PLACE_BY_OUTLINE, OUTLINE, PLACE_APART = 1.5, 0.13, 0.06
"""Standard deviations of a place by the response's error, over what the covariance of the frame makes of it: at the
skin's outline; how far it takes to fall by e; and far from it.
"""
SIZE, LARGE = 0.5, 0.23  # the same of drop and size: of a small touch; and the radius from which on it grows
EDGE = {
    "circle": (0.0019, 0.0062),
    "hertz": (0.0019, 0.0062),
    "square": (0.0, 0.0),
    "L": (0.0018, 0.005),
    "triangle": (0.002, 0.005),
    "rectangle": (0.004, 0.015),
}
"""Standard deviations of log radius and logit drop, of opposite sign, by where the response puts a touch's edge: what
the larger covariance of kinds with corners does not cover already. All of these were found on 420 touches without noise
and at 60, 70 and 80 dB, on a mesh that neither training nor any benchmark uses.
"""
LEFT = 0.8  # whitened energy that such an error leaves of a frame without noise, typically
SURE_OF_IT = 0.15  # of LEFT: how much the assumed size of the error counts beside the one that is seen


class FrameErrors(NamedTuple):
    """Covariances (K, K) of a frame about what its touch makes of it: noise and drift; and what the model is wrong by,
    whose size is a guess that the fit itself corrects.
    """

    noise: Array
    model: Array


def frame_errors(
    gram: Array, sigma: Array, d: Array, peak: float, tare_frames: float = 64.0, drift: Array | None = None
) -> FrameErrors:
    """Of d (K,) about what a touch of about the drop `peak` makes of it.

    gram (K, K): the bundle's; sigma (K,): standard deviation of d of one frame; drift (K, K): covariance of what drift
    since the tare does.
    """
    peak = min(max(peak, 0.05), 0.9)
    wrong = MISFIT * (peak / (1 - peak)) ** MISFIT_ODDS
    noise = np.diag(sigma**2 * (1 + 1 / tare_frames) + FLOOR**2)
    factor = wrong * float(np.linalg.norm(d)) * misfit_factor(gram)
    model = factor @ factor.T + np.diag((MISFIT_EACH * wrong * d) ** 2)
    return FrameErrors(noise if drift is None else noise + drift, model)


def misfit_factor(gram: Array, power: float = MISFIT_POWER) -> Array:
    """(K, K) factor of a covariance of trace 1 that lies where touches do: powers of the Gram matrix's eigenvalues."""
    values, vectors = np.linalg.eigh(gram)
    profile = np.maximum(values, 0) ** power
    return np.asarray(vectors * (profile / np.linalg.norm(profile)))


class Widening(NamedTuple):
    """What the response's error does to the parameters of a touch (theta of models/touch_parameters.py), over what its
    covariance of the frame makes of it: factors (n,) of standard deviations, and one that is added (n,).
    """

    factor: Array
    edge: Array


def widening(shape: Shape, room: float, count: int, known_size: bool) -> Widening:
    """room: from the shape's circle to the skin's outline. count: of parameters."""
    factor, edge = np.ones(count), np.zeros(count)
    factor[:2] = PLACE_APART + PLACE_BY_OUTLINE * np.exp(-room / OUTLINE)
    factor[2:4] = SIZE * np.hypot(1.0, (shape.radius / LARGE) ** 2)
    if not known_size:
        size, drop = EDGE[shape.kind]
        edge[2:4] = -size, drop
    return Widening(factor, edge)


def seen_error(misfit: float, noise: float) -> float:
    """Variance of the response's error over what was assumed: as large as what is left of the frame (`misfit`, whitened
    energy, of which noise leaves `noise` on the mean), as far as noise lets that be seen.
    """
    assumed = SURE_OF_IT + 3 * (2 * noise) ** 0.5 / LEFT
    return float((assumed + max(0.0, misfit - noise) / LEFT) / (assumed + 1))
