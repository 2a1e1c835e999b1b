"""Regression by Matern kernels, its constants by leave-one-out error; models/locator_arrays.py runs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.locator_arrays import matern
from services.calibration.presses import evenly

Array = NDArray[np.float64]

LENGTHS = (0.35, 0.5, 0.7, 1.0, 1.5, 2.5)  # of the kernels, beside the root of the number of directions
RIDGES = (0.01, 0.03, 0.1, 0.3, 1.0)
MOST_FOR_SEARCH = 700  # presses from which a kernel machine's constants are found


@dataclass(frozen=True)
class Machine:
    """A kernel machine's constants and weights, and what it leaves of presses that it was not trained on."""

    length: float  # of the kernel, in the features' unit
    offset: Array  # (M,) what is said far from all presses
    weights: Array  # (N, M)
    left: Array  # (N, M) targets less what is said without them
    error: float  # root mean square of `left`


def search(features: Array, targets: Array, offset: Array, size: float) -> Machine:
    """The kernel machine of the least leave-one-out error. features (N, F), targets (N, M) and their offset (M,) in any
    unit; size: how far features are apart, which lengths are shares of.
    """
    n = len(features)
    some = evenly(n, MOST_FOR_SEARCH)
    best = min(
        (error, length, ridge)
        for length in (size * share for share in LENGTHS)
        for ridge, error in _errors(features[some], targets[some] - offset, length)
    )
    _, length, ridge = best
    inverse = np.linalg.inv(matern(features, features, length) + ridge * np.eye(n))
    weights = inverse @ (targets - offset)
    left = weights / np.diag(inverse)[:, None]
    return Machine(length, offset, weights, left, float(np.sqrt((left**2).mean())))


def _errors(features: Array, targets: Array, length: float) -> list[tuple[float, float]]:
    """(ridge, leave-one-out error) of each ridge, by one decomposition."""
    values, vectors = np.linalg.eigh(matern(features, features, length))
    turned, square = vectors.T @ targets, vectors**2
    found = []
    for ridge in RIDGES:
        shrunk = 1 / (np.maximum(values, 0.0) + ridge)
        left = (vectors @ (shrunk[:, None] * turned)) / (square @ shrunk)[:, None]
        found.append((ridge, float(np.sqrt((left**2).mean()))))
    return found


def named(name: str, machine: Machine, centres: Array, spread: Array) -> dict[str, Any]:
    """The arrays of a kernel machine, as models/locator_arrays.py has them. centres (N, F): the features that it was
    trained on; spread (M,): what to expect where it knows nothing.
    """
    return {
        f"{name}_centres": centres.astype(np.float32),
        f"{name}_weights": machine.weights,
        f"{name}_offset": machine.offset,
        f"{name}_length": np.array(machine.length),
        f"{name}_sigma": np.sqrt((machine.left**2).mean(axis=0)),
        f"{name}_spread": spread,
    }


def nothing_known(name: str, outputs: int) -> dict[str, Any]:
    """The arrays of a kernel machine that is not there."""
    arrays = {f"{name}_{part}": np.zeros(outputs) for part in ("offset", "sigma", "spread")}
    return arrays | {
        f"{name}_centres": np.zeros((0, 0)),
        f"{name}_weights": np.zeros((0, outputs)),
        f"{name}_length": np.array(1.0),
    }
