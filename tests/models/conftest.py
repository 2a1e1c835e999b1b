"""Reference data that nobody here made up; where it is missing the tests that need it say so."""

import numpy as np
import pytest

from models.bundle import Bundle
from models.scenes import random_scene
from models.shapes import to_rows
from tests import needs


@pytest.fixture(scope="session")
def reference():
    """reference(name) -> dict of arrays."""

    def load(name):
        with np.load(needs.reference(f"{name}.npz"), allow_pickle=False) as data:
            return dict(data)

    return load


@pytest.fixture(scope="session")
def bundle():
    return Bundle.load("square16")


@pytest.fixture(scope="session")
def pre(bundle):
    return bundle.prereconstructor()


@pytest.fixture(scope="session")
def drawn(pre):
    """drawn(n, seed, **kwargs of random_scene) -> Samples: differences by the linearised model."""
    needs.TRAIN.here()
    from models import samples

    def draw(count, seed, **wanted):
        rng = np.random.default_rng(seed)
        rows = np.stack([to_rows(random_scene(rng, **wanted)) for _ in range(count)]).astype(np.float32)
        drop, mask, classes = samples.picture(rows)
        coarse = drop.astype(float).reshape(count, 24, 4, 24, 4).mean(axis=(2, 4)).reshape(count, -1)
        return samples.Samples((coarse @ pre.m.jacobian.T).astype(np.float32), drop, mask, classes, rows)

    return draw


@pytest.fixture(scope="session")
def scenes(drawn):
    """96 scenes: enough to learn something from."""
    return drawn(96, seed=0)
