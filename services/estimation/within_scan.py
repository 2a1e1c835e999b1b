"""Does a touch that came, went or changed while it was scanned explain a frame that no image explains?

A scan takes its measurements one after the other, so a touch whose force changes meanwhile is in each with another
size. A touch that came or went at once is in those after an instant, or in those before it. Else one touch on the grid
of the estimation, its size a line through KNOTS moments of the scan, leaves next to nothing of such a frame; two
touches are tried, one after the other. Of what is no touch the same models leave most.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from models.bundle import Bundle
from models.touch_grid import touches
from services.estimation.rolling import measured_at
from services.estimation.tuning import TUNING

Array = NDArray[np.float64]

CHANGING_FRAMES = 2  # in a row that may be explained by a touch that changes: a press within 0.1 s is over by then
ENDED = 0.1  # of a touch's largest size, at most which is left of it where it ended
AS_WELL = 2.0  # times what a changing touch leaves: a touch that did not change does as well
KNOTS = 4  # moments of a scan between which a touch's size is a line: a force ramp begins or ends in one of three parts
PAIRS = tuple(combinations_with_replacement(range(KNOTS), 2))
FEWEST = 6  # measurements that felt a touch which came or went at once: any one is explained by some touch
TINY = 1e-300  # keeps a touch out that no measurement counts of
RIDGE = 1e-6  # of a touch's own energy: keeps the fit of its sizes solvable where few measurements count


class ScanChange(NamedTuple):
    left: float  # share of |d|^2 that a touch which changed during the scan leaves, noise apart
    ended: bool  # whether nothing of it was left when the scan ended


class ChangingTouch:
    """For one bundle. `knows` is false where its differences have no sign: then nothing is explained."""

    def __init__(self, bundle: Bundle) -> None:
        m = bundle.matrices
        self.knows = m.normalisation == "model"
        self._response = np.asarray(touches(m, bundle.half_width, TUNING.radii).response, dtype=float)  # (M, K)
        self._bundle = bundle
        self._courses: dict[int, tuple[Array, Array]] = {}  # by the part measured last

    def warm_up(self, parts: int) -> None:
        """Do once what is slow the first time, of scans in so many parts."""
        for part in range(parts + 1) if parts > 1 else (0,):
            self._course(part)

    def _course(self, part: int) -> tuple[Array, Array]:
        """(KNOTS, K) by how much each moment counts in each measurement, and (K, pairs) their products."""
        if part not in self._courses:
            at = np.linspace(0.0, 1.0, KNOTS)
            size = np.maximum(0.0, 1.0 - np.abs(measured_at(self._bundle, part) - at[:, None]) * (KNOTS - 1))
            self._courses[part] = size, np.array([size[i] * size[j] for i, j in PAIRS]).T
        return self._courses[part]

    def steady(self, difference: NDArray[np.floating], sigma: NDArray[np.floating], part: int = 0) -> bool:
        """Whether a touch that did not change explains a difference (K,) about as well as one that did. sigma (K,):
        standard deviation of d, infinite where a measurement does not count. part: the one measured last, of a scan
        in parts.
        """
        live, d, noise = _counted(difference, sigma)
        changed = self(difference, sigma, part)
        if changed is None:
            return False
        response = self._response * live
        gain = float(((response @ d) ** 2 / ((response**2).sum(axis=1) + TINY)).max())
        return float(d @ d) - gain - noise <= AS_WELL * changed.left * float(d @ d)

    def __call__(
        self, difference: NDArray[np.floating], sigma: NDArray[np.floating], part: int = 0
    ) -> ScanChange | None:
        """The change that explains a difference (K,); None where it leaves too much."""
        live, d, noise = _counted(difference, sigma)
        energy = float(d @ d)
        if not self.knows or live.sum() < len(d) / 2 or not energy > noise:
            return None
        response, (size, by_pairs) = self._response * live, self._course(part)
        products = response**2 @ by_pairs
        gram = np.empty((len(response), KNOTS, KNOTS))
        for n, (i, j) in enumerate(PAIRS):
            gram[:, i, j] = gram[:, j, i] = products[:, n]
        gram += RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(KNOTS) + TINY * np.eye(KNOTS)
        stepped = _stepped(response, d)
        if (share := max(0.0, energy - stepped[0] - noise) / energy) <= TUNING.changing_left:
            return ScanChange(share, stepped[1])
        columns, left = np.zeros((len(d), 0)), d
        strength: list[float] = []
        for _ in range(2):
            seen = response @ (size * left).T
            gain = (seen * np.linalg.solve(gram, seen[:, :, None])[:, :, 0]).sum(axis=1)
            found = response[int(gain.argmax())]
            columns, strength = np.hstack([columns, (size * found).T]), [*strength, float(np.linalg.norm(found))]
            sizes, _ = nnls(columns, d)
            left = d - columns @ sizes
            share = max(0.0, float(left @ left) - noise) / energy
            if share <= TUNING.changing_left:
                course = np.array(strength) @ sizes.reshape(-1, KNOTS)
                return ScanChange(share, bool(course[-1] <= ENDED * course.max()))
        return None


def _stepped(response: Array, d: Array) -> tuple[float, bool]:
    """Energy of d (K,) explained by the best touch, of response (M, K), that came or went at once; whether it went."""
    seen, energy = np.cumsum(response * d, axis=1), np.cumsum(response**2, axis=1)
    came = (np.maximum(seen[:, -1:] - seen, 0.0) ** 2 / (energy[:, -1:] - energy + TINY))[:, :-FEWEST].max()
    went = (np.maximum(seen, 0.0) ** 2 / (energy + TINY))[:, FEWEST:].max()
    return float(max(came, went)), bool(went > came)


def _counted(difference: NDArray[np.floating], sigma: NDArray[np.floating]) -> tuple[NDArray[np.bool_], Array, float]:
    """Measurements that count, d (K,) with 0 elsewhere, and the energy of their noise."""
    live = np.isfinite(sigma)
    return live, np.where(live, difference, 0.0).astype(float), float((sigma[live].astype(float) ** 2).sum())
