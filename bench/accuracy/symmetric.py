"""A network's image of a frame, by itself or as the mean over the square's symmetries (services/symmetry.py)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from models import metrics
from models.bundle import Bundle
from models.forward import shared
from models.shapes import Array, Shape
from models.turns import TURNS, Turn

RADIUS, DROP = 0.2, 0.15  # of the paper's touch for the LDCI


def pictures(network: Any, made: tuple[Any, Any, float], turns: Sequence[Turn] = TURNS[:1]) -> list[Array]:
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


def ldci(network: Any, bundle: Bundle, mesh: str, sigma: Array) -> dict[str, float]:
    """Noise-free: of the image, and of the mean over the symmetries. Every one of the 49 places is solved."""
    model, operator = shared(bundle.name, mesh), bundle.prereconstructor().condition(sigma)
    z0 = np.abs(model.solve().impedances())
    peaks: dict[str, list[float]] = {"network": [], "symmetry": []}
    for x, y in metrics.ldci_positions():
        touched = model.touched([Shape("circle", float(x), float(y), RADIUS, DROP)])
        made = operator.stack(np.abs(model.solve(touched).impedances()) / z0 - 1)
        for name, turns in (("network", TURNS[:1]), ("symmetry", TURNS)):
            peaks[name].append(float(pictures(network, made, turns)[0].max()))
    return {name: metrics.ldci(found) for name, found in peaks.items()}
