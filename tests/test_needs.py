"""A test that lacks something is skipped in words and counted at the end of the run; where CI insists, it fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TESTS = """
import pytest
from tests import needs
NOWHERE = needs.Need("`apt-get install no-such-program`", "EITSKIN_REQUIRE_NOWHERE", programs=["no-such-program"])
THERE = needs.Need("nobody reads this", packages=["json"], programs=["sh"])

@pytest.mark.parametrize("n", [1, 2])
def test_lacks(n):
    NOWHERE.here()
    assert False, "went on without it"

def test_has_it():
    THERE.here()
"""
WHOLE = """
from tests import needs
needs.Need("`make venv-dev EXTRAS=nothing`", packages=["no_such_package"]).here()
import no_such_package
"""


def run(folder: Path, *options: str, **environment: str) -> tuple[int, list[str]]:
    """Status and last lines of these tests, run as pytest runs ours."""
    (folder / "test_some.py").write_text(TESTS)
    for name in ("test_whole.py", "test_another.py"):
        (folder / name).write_text(WHOLE)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.needs", "-p", "no:cacheprovider", "-c", os.devnull]
    ran = subprocess.run(
        [*command, *options, "--rootdir", folder, folder],
        cwd=ROOT,
        env={**os.environ, **environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    return ran.returncode, ran.stdout.splitlines()


@pytest.mark.parametrize("options", [(), ("-n", "2", "--dist", "loadfile")], ids=["one process", "two processes"])
def test_what_was_not_run_is_counted_by_what_is_missing(tmp_path: Path, options: tuple[str, ...]) -> None:
    code, lines = run(tmp_path, *options)
    assert code == 0 and any("1 passed, 4 skipped" in line for line in lines), lines
    assert [line for line in lines if line.startswith("not run, ")] == [
        "not run, 2 tests: no no-such-program: `apt-get install no-such-program`",
        "not run, 2 whole files: no no_such_package: `make venv-dev EXTRAS=nothing`",
    ]


def test_what_ci_insists_on_fails(tmp_path: Path) -> None:
    code, lines = run(tmp_path, EITSKIN_REQUIRE_NOWHERE="1")
    assert code == 1 and any("2 failed, 1 passed, 2 skipped" in line for line in lines), lines
    assert any("no no-such-program" in line and "$EITSKIN_REQUIRE_NOWHERE is set" in line for line in lines)
