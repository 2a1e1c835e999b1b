"""Fixtures of the command line's tests: `skin` run in this process."""

import os
import sys
from dataclasses import dataclass

import pytest


@dataclass
class Ran:
    code: int
    out: str
    err: str


@pytest.fixture
def skin(runtime, monkeypatch, capsys):
    """`skin ARGUMENTS` in this process. A traceback, or an error of more than a line, fails the test."""
    from services.cli.app import run

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["skin", *map(str, arguments)])
        before = dict(os.environ)
        code = run()
        os.environ.clear()  # --config and --runtime are said in the environment of the command's own process
        os.environ.update(before)
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err and "a fault of this program" not in captured.err, captured.err
        return Ran(code, captured.out, captured.err)

    return call
