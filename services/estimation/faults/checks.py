"""Some checks cannot be made with the measurements of a bundle: they are named, so that none looks passed."""

from __future__ import annotations

import numpy as np

from models.bundle import Bundle
from services.estimation.faults.wires import all_pairs


def skipped(bundle: Bundle) -> dict[str, str]:
    """Returns the checks that cannot be made, each with the reason, from the bundle's pattern and normalisation."""
    pattern, found = np.asarray(bundle.pattern), {}
    measured = bundle.matrices.normalisation != "model"
    own = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
    nothing_predicted = "a measured bundle predicts no impedances"
    if not own.any():
        found["shorts between electrodes"] = "no pair senses where it drives"
    if measured or not all_pairs(pattern):
        why = nothing_predicted if measured else "not all pairs of electrodes are measured"
        found["exchanged wires and stuck multiplexers"] = why
    if measured or not own.all():
        found["contacts that change"] = nothing_predicted if measured else "not all pairs sense where they drive"
    if measured or own.sum() < len(own) / 2:
        found["changes that no touch can make"] = nothing_predicted if measured else "few pairs sense where they drive"
    if measured:
        for check in ("touches at the first start", "drift under a touch", "touches that change during a scan"):
            found[check] = nothing_predicted
    return found


def sentence(bundle: Bundle) -> str:
    """Says the same to a person; "" where every check is made."""
    by_reason: dict[str, list[str]] = {}
    for check, why in skipped(bundle).items():
        by_reason.setdefault(why, []).append(check)
    parts = [f"{', '.join(checks)} ({why})" for why, checks in by_reason.items()]
    return f"not checked with the bundle {bundle.name}: {'; '.join(parts)}" if parts else ""
