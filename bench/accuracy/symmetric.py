"""A network's image of a frame, by itself or as the mean over the square's symmetries (services/symmetry.py)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from models import metrics
from models.bundle import Bundle
from models.forward import shared
from models.shapes import Array, Shape
from models.turns import TURNS
from services.networks import Network, Stack
from services.symmetry import SymmetryMean

RADIUS, DROP = 0.2, 0.15  # of the paper's touch for the LDCI


def pictures(network: Network, made: tuple[Any, Any, float], mean: bool = False) -> list[Array]:
    """Drop and its standard deviation (n, n), class probabilities (5, h, w), as the service makes them of a frame;
    mean: over the square's symmetries. made: what `Operator.stack` gives.
    """
    stack = Stack(*made)
    found = network.run(stack)
    held = SymmetryMean(network, TURNS[1:] if mean else ())
    held.begin(stack, found)
    while held.busy:
        found = held.step() or found
    return [np.asarray(each, dtype=float) for each in found]


def ldci(
    network: Network, bundle: Bundle, mesh: str, sigma: Array, refined: dict[str, Callable[[Array, Array], float]]
) -> dict[str, float]:
    """Noise-free: of the image, of the mean over the symmetries, and of the drop that each of `refined` makes of
    difference and image. Every one of the 49 places is solved.
    """
    model, operator = shared(bundle.name, mesh), bundle.prereconstructor().condition(sigma)
    z0 = np.abs(model.solve().impedances())
    peaks: dict[str, list[float]] = {name: [] for name in ("network", "symmetry", *refined)}
    for x, y in metrics.ldci_positions():
        touched = model.touched([Shape("circle", float(x), float(y), RADIUS, DROP)])
        d = np.abs(model.solve(touched).impedances()) / z0 - 1
        made = operator.stack(d)
        images = {name: pictures(network, made, name == "symmetry")[0] for name in ("network", "symmetry")}
        for name, image in images.items():
            peaks[name].append(float(image.max()))
        for name, fitted in refined.items():
            peaks[name].append(fitted(d, images["network"]))
    return {name: metrics.ldci(found) for name, found in peaks.items()}
