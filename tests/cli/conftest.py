"""Fixtures of the command line's tests: `skin` run in this process, a runtime folder of its own, the reference data."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Ran:
    code: int
    out: str
    err: str


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder with a path short enough for sockets."""
    folder = Path(tempfile.mkdtemp(prefix="eitc", dir="/tmp"))
    monkeypatch.setenv("EITSKIN_RUNTIME", str(folder))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def skin(runtime: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """`skin ARGUMENTS` in this process. A traceback, or an error of more than a line, fails the test."""
    from services.cli.app import run

    def call(*arguments: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["skin", *map(str, arguments)])
        code = run()
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err and "a fault of this program" not in captured.err, captured.err
        return Ran(code, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def reference() -> Path:
    """The folder of the reference data; says so loudly where it is not there."""
    folder = Path(os.environ.get("EITSKIN_REFERENCE") or ROOT / ".." / "shared" / "data")
    if not (folder / "hydrogel_disc16.npz").is_file():
        message = f"REFERENCE DATA MISSING: {folder.resolve()} (set EITSKIN_REFERENCE to the folder that holds it)"
        if os.environ.get("EITSKIN_REQUIRE_REFERENCE"):
            pytest.fail(message)
        pytest.skip(message)
    return folder
