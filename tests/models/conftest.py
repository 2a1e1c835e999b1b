"""Reference data that nobody here made up; where it is missing the tests that need it say so."""

import numpy as np
import pytest

from models.bundle import Bundle
from tests import needs


@pytest.fixture(scope="session")
def reference():
    """reference(name) -> dict of arrays."""
    return lambda name: dict(np.load(needs.reference(f"{name}.npz")))


@pytest.fixture(scope="session")
def bundle():
    return Bundle.load("square16")


@pytest.fixture(scope="session")
def pre(bundle):
    return bundle.prereconstructor()
