"""Processes of the service that a test has started."""

from __future__ import annotations

import os
from pathlib import Path


def pid_of(module: str) -> int:
    """The process `python -m module` of this test's own service: the one with its runtime folder."""
    wanted = f"EITSKIN_RUNTIME={os.environ['EITSKIN_RUNTIME']}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = (folder / "cmdline").read_bytes(), (folder / "environ").read_bytes()
        except OSError:
            continue
        if module.encode() in command.split(b"\0") and wanted in environment.split(b"\0"):
            return int(folder.name)
    raise AssertionError(f"no process of {module}")
