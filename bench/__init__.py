"""Benchmarks. Numerical libraries get one thread, as in the services."""

from pathlib import Path

import models  # noqa: F401  (also: Ctrl-C, or a package that is missing, gives no traceback)
import services  # noqa: F401  (sets it, before numpy is loaded)

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "bench" / "work"
"""What was solved or simulated, kept for the next run; git does not see it."""
REPORTS = ROOT / "bench" / "reports"


def commands() -> dict[str, str]:
    """The benchmarks that can be run: name -> module. A folder's `__main__` has the folder's name."""
    found = {}
    for file in sorted([*(ROOT / "bench").glob("*.py"), *(ROOT / "bench").glob("*/*.py")]):
        if file.parent != WORK and "\ndef main(argv" in file.read_text(encoding="utf-8"):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            found[file.parent.name if file.stem == "__main__" else file.stem] = module
    return found
