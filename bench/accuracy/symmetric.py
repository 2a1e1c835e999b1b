"""A network's image of a frame, by itself or as the mean over the square's symmetries (services/symmetry.py)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from models import metrics
from models.bundle import Bundle
from models.forward import shared
from models.shapes import Array, Shape
from models.turns import TURNS, Turn

ONE = TURNS[:1]  # as it is
RADIUS, DROP = 0.2, 0.15  # of the paper's touch for the LDCI


def pictures(network: Any, made: tuple[Any, Any, float], turns: Sequence[Turn] = ONE) -> list[Array]:
    """Drop and its standard deviation (n, n), class probabilities (5, h, w). made: what `Operator.stack` gives."""
    stack, context, scale = made
    each = []
    for turn in turns:
        turned = np.ascontiguousarray(turn.image(stack))[None]
        drop, log_sigma, logits = network.run(
            ("drop", "log_sigma", "classes"), {"stack": turned, "context": context[None]}
        )
        shifted = np.exp(logits[0] - logits[0].max(axis=0))
        found = drop[0, 0] * scale, np.exp(log_sigma[0, 0]) * scale, shifted / shifted.sum(axis=0)
        each.append([turn.back.image(picture) for picture in found])
    return [np.mean(parts, axis=0) for parts in zip(*each, strict=True)]


def ldci(
    network: Any, bundle: Bundle, mesh: str, sigma: Array, refined: dict[str, Callable[[Array, Array], float]]
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
        images = {name: pictures(network, made, turns)[0] for name, turns in (("network", ONE), ("symmetry", TURNS))}
        for name, image in images.items():
            peaks[name].append(float(image.max()))
        for name, fitted in refined.items():
            peaks[name].append(fitted(d, images["network"]))
    return {name: metrics.ldci(found) for name, found in peaks.items()}
