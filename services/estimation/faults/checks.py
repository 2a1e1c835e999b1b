"""Some checks cannot be made with the measurements of a bundle: they are named, so that none looks passed."""

from __future__ import annotations

import numpy as np

from models.bundle import Bundle
from services.estimation.faults.wires import all_pairs

PREDICTED = ("touches at the first start", "drift under a touch", "touches that change during a scan")


def skipped(bundle: Bundle) -> dict[str, str]:
    """Returns the checks that cannot be made, each with the reason, from the bundle's pattern and normalisation."""
    pattern = np.asarray(bundle.pattern)
    own = (pattern[:, 0] == pattern[:, 2]) & (pattern[:, 1] == pattern[:, 3])
    predicting = [  # check, whether the pattern allows it, what it lacks otherwise
        ("exchanged wires and stuck multiplexers", all_pairs(pattern), "not all pairs of electrodes are measured"),
        ("contacts that change", own.all(), "not all pairs sense where they drive"),
        ("changes that no touch can make", own.sum() >= len(own) / 2, "few pairs sense where they drive"),
        *((check, True, "") for check in PREDICTED),
    ]
    if bundle.matrices.normalisation != "model":
        predicting = [(check, False, "a measured bundle predicts no impedances") for check, _, _ in predicting]
    checks = [("shorts between electrodes", own.any(), "no pair senses where it drives"), *predicting]
    return {check: why for check, made, why in checks if not made}


def sentence(bundle: Bundle) -> str:
    """Says the same to a person; "" where every check is made."""
    by_reason: dict[str, list[str]] = {}
    for check, why in skipped(bundle).items():
        by_reason.setdefault(why, []).append(check)
    parts = [f"{', '.join(checks)} ({why})" for why, checks in by_reason.items()]
    return f"not checked with the bundle {bundle.name}: {'; '.join(parts)}" if parts else ""
