"""What CI runs ends where a step fails: the script itself, with programs that only say what they were asked for."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SAYS = """#!/bin/sh
echo "$(basename "$0") $*"
case "$(basename "$0") $*" in "$FAILS"*) exit 7 ;; esac
"""
PROGRAMS = ("apt-get", "chromium", "g++", "git", "ls", "make", "python3", "roscore", "timeout")


@pytest.mark.parametrize(
    ("command", "next_step"),
    [("make ros-venv", "=== what tests need"), ("make test-all", "=== what skin export --rerun writes")],
)
def test_a_step_that_fails_ends_it(tmp_path: Path, command: str, next_step: str) -> None:
    script = (ROOT / ".ci" / "run").read_text()
    assert next_step.removeprefix("=== ") in script, f"no step of .ci/run any more: name the one after {command!r}"
    fails = next(line for line in script.splitlines() if line.startswith("timeout ") and line.endswith(command))
    for name in PROGRAMS:
        (tmp_path / name).write_text(SAYS)
        (tmp_path / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:/usr/bin:/bin", "FAILS": fails}
    ran = subprocess.run(["bash", ROOT / ".ci" / "run"], env=environment, capture_output=True, text=True, timeout=60)
    assert fails in ran.stdout, ran.stdout + ran.stderr
    assert ran.returncode == 7 and next_step not in ran.stdout, ran.stdout + ran.stderr
