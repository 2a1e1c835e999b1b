"""The C++ example, compiled once for the tests of a file."""

import subprocess
from pathlib import Path

import pytest

from tests import needs


@pytest.fixture(scope="module")
def cpp_subscriber(tmp_path_factory: pytest.TempPathFactory) -> Path:
    needs.CPP.here()
    program, source = tmp_path_factory.mktemp("cpp") / "subscribe", needs.ROOT / "examples/cpp/subscribe.cpp"
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-DMSGPACK_NO_BOOST"]
    done = subprocess.run(["g++", *flags, source, "-lzmq", "-o", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program
