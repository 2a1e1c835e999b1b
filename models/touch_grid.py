"""A grid of touches, and what each does to the measurements by a bundle's linear physics (numpy only)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.prereconstruction import Matrices
from models.pressure import ANCHOR_DROP

Array = npt.NDArray[np.floating]
Rows = npt.NDArray[np.integer]

RADIUS = 0.2  # model units, of the touches that parts are chosen by
RADII = (0.1, 0.2, 0.4)  # model units, of the touches that are told apart
SPACING = 0.1  # model units between grid positions
SNR_DB = 70.0

# Standard deviations before measuring: x, y (model units), log of drop times area; as models/fisher.py.
PRIOR = np.array([2.0, 2.0, np.hypot(np.log(5), 2 * np.log(3))]) / np.sqrt(12)


@dataclass(frozen=True)
class Touches:
    """Circles on a grid, wholly on the skin. M touches, P pixels, K measurements."""

    position: Array  # (M, 2) model units
    radius: Array  # (M,) model units
    coverage: Array  # (M, P) share of each pixel
    response: Array  # (M, K) d per S/m of drop


def touches(m: Matrices, half_width: float = 1.0, radii: tuple[float, ...] = RADII) -> Touches:
    """Every circle of the given radii on the grid."""
    h, w = m.inside.shape
    pixel = 2 * half_width / w
    x = (np.arange(w) + 0.5) * pixel - half_width
    y = (np.arange(h) + 0.5) * pixel - half_width
    steps = int(round(half_width / SPACING))
    line = np.arange(-steps, steps + 1) * SPACING
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    distance = np.hypot(x[None, None, :] - grid[:, 0, None, None], y[None, :, None] - grid[:, 1, None, None])
    position, radius, coverage = [], [], []
    for r in radii:
        share = np.clip((r - distance) / pixel + 0.5, 0.0, 1.0).reshape(len(grid), -1)
        on = (share @ m.inside.ravel().astype(float)) / (np.pi * r**2 / pixel**2) > 0.98
        position.append(grid[on])
        radius.append(np.full(int(on.sum()), r))
        coverage.append(share[on] * (np.pi * r**2 / pixel**2) / share[on].sum(axis=1, keepdims=True))
    stacked = np.concatenate(coverage).astype(np.float32)
    return Touches(np.concatenate(position), np.concatenate(radius), stacked, stacked @ m.jacobian.T)


def slopes(grid: Touches, judged: npt.NDArray[np.bool_], sigma: float) -> Array:
    """(M, K, 3) of d over sigma, to x, y and the log of drop times area, which a linear touch changes d in proportion
    to; of the judged touches of one newton (RADIUS is 10 mm on square16).
    """
    place = {(round(x, 6), round(y, 6)): k for k, (x, y) in enumerate(grid.position[judged])}
    signal = ANCHOR_DROP * grid.response[judged] / sigma
    columns = []
    for axis in np.eye(2):
        ahead, behind, distance = np.arange(len(signal)), np.arange(len(signal)), np.zeros(len(signal))
        for k, at in enumerate(grid.position[judged]):
            for side, index in ((1, ahead), (-1, behind)):
                neighbour = place.get(tuple(np.round(at + side * SPACING * axis, 6)))
                if neighbour is not None:
                    index[k] = neighbour
                    distance[k] += SPACING
        columns.append((signal[ahead] - signal[behind]) / np.maximum(distance, 1e-9)[:, None])
    return np.stack([*columns, signal], axis=-1)
