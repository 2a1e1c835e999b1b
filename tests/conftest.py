"""Fixtures that more than one folder of tests uses."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder of the test's own, with a path short enough for sockets."""
    folder = Path(tempfile.mkdtemp(prefix="eit", dir="/tmp"))
    monkeypatch.setenv("EITSKIN_RUNTIME", str(folder))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)
