"""The C++ example, compiled once for the tests of a file."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests import needs

ROOT = Path(__file__).resolve().parents[2]
CPP = ROOT / "examples" / "cpp" / "subscribe.cpp"


@pytest.fixture(scope="module")
def cpp_subscriber(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The C++ subscriber, compiled."""
    needs.CPP.here()
    program = tmp_path_factory.mktemp("cpp") / "subscribe"
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-DMSGPACK_NO_BOOST"]
    done = subprocess.run(["g++", *flags, str(CPP), "-lzmq", "-o", str(program)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program
