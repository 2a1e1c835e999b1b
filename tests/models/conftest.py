"""Reference data that nobody here made up; where it is missing the tests that need it say so."""

import os
from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from models.scenes import random_scene
from models.shapes import to_rows

FOLDER = Path(os.environ.get("EITSKIN_REFERENCE", "../shared/data"))


@pytest.fixture(scope="session")
def reference():
    """reference(name) -> dict of arrays. Missing: skips, or fails where EITSKIN_REQUIRE_REFERENCE is set."""

    def load(name):
        path = FOLDER / f"{name}.npz"
        if not path.is_file():
            message = f"REFERENCE DATA MISSING: {path.resolve()} (set EITSKIN_REFERENCE to the folder that holds it)"
            if os.environ.get("EITSKIN_REQUIRE_REFERENCE", "0") not in ("", "0"):
                pytest.fail(message)
            pytest.skip(message)
        with np.load(path, allow_pickle=False) as data:
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
    from models import samples  # needs torch

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
