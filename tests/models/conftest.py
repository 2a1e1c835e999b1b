"""Reference data that nobody here made up; where it is missing the tests that need it say so."""

import os
from pathlib import Path

import numpy as np
import pytest

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
