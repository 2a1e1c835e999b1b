"""The machine and versions that a report was made with."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from models import manifest

PACKAGES = ("numpy", "scipy", "onnxruntime", "pyzmq", "msgpack")


def machine() -> str:
    """The processor's name and how many of it there are."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{os.cpu_count()} x {name}"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the service runs on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def provenance(benchmark: str, arguments: Sequence[str] | None) -> dict[str, Any]:
    """How a report was made: command, commit, machine. arguments: as `main` was given them (None: the program's);
    where the report goes to is left out.
    """
    program = sys.argv[3:] if sys.argv[1:2] == ["bench"] else sys.argv[1:]  # of `skin bench NAME`, or of the module
    words = ["skin", "bench", benchmark, *(program if arguments is None else arguments)]
    if "--out" in words:
        del words[words.index("--out") : words.index("--out") + 2]
    return {"command": " ".join(words), "commit": manifest.commit(), "machine": machine(), "versions": versions()}
