"""Drift that was read from a touch, and was a part of the touch: gone with it."""

from __future__ import annotations

import numpy as np
import pytest

from models.shapes import Shape
from tests.services.stub_skin import StubSkin

LONG_S = 70.0  # without an untouched frame that counts: then drift is read from the next touch
TOUCHES = [
    ("circle", 0, 0.82, 0.4),
    ("circle", 0, 0.88, 0.4),
    ("L", 0, 0.82, 0.4),
    ("triangle", 2, 0.86, 0.4),
    ("circle", 5, 0.82, 0.4),
]


@pytest.mark.parametrize(("kind", "electrode", "inward", "drop"), TOUCHES)
def test_a_touch_beside_an_electrode_that_was_read_as_drift_leaves_nothing(
    kind: str, electrode: int, inward: float, drop: float
) -> None:
    stub = StubSkin(80.0)  # its own, as its noise goes on from test to test
    estimator = stub.pipeline.pre.touch_estimator.baseline_estimator
    stub.rest(3)
    estimator.drift_filter.begin(stub.scan * 45_000_000, LONG_S)
    before = estimator.baseline.z0.copy()
    x, y = np.asarray(stub.pipeline.pre.bundle.skin["electrodes"]["centre"]).reshape(-1, 2)[electrode] * inward
    for _ in range(6):
        stub.feel((Shape(kind, x + 0.05, y, 0.1, drop, 0.3, 0.7),))
    assert np.abs(estimator.baseline.z0 / before - 1).max() > 3e-3, "no drift was read from this touch: try another one"
    after = [stub.feel() for _ in range(6)]
    assert not any(found.delta.touched for found in after[1:])
    assert all(found.contact.valid for found in after[1:])
    assert np.abs(estimator.baseline.z0 / before - 1).max() < 3e-4


def test_drift_that_was_there_stays_read() -> None:
    """A touch with drift beside it: the skin is not as it was before, and is known as it is."""
    stub = StubSkin(80.0)
    estimator = stub.pipeline.pre.touch_estimator.baseline_estimator
    estimator.drift_filter.begin(stub.scan * 45_000_000, LONG_S)
    before = estimator.baseline.z0.copy()
    drifted = ((3, 1.05), (9, 0.96))
    for _ in range(6):
        stub.feel((Shape("circle", 0.1, -0.2, 0.2, 0.3),), drifted)
    after = [stub.feel((), drifted) for _ in range(6)]
    assert not any(found.delta.touched for found in after[1:])
    assert np.abs(estimator.baseline.z0 / before - 1).max() > 1.5e-3
