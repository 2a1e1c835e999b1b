"""How much there is to read of the estimator: its lines and files, the numbers that decide, and the files that one scan
runs through. What `skin dev numbers` and `skin dev size` print.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from bench import ROOT
from simulation.host import SimulatedHost, tared

AREAS = ("services/estimation", "models/measurement")
STAGES = "preprocessing inference publisher pipeline judged describe networks symmetry mounting linearisation health"
SKIN = "locator locator_arrays pressure response_file response_tables"
HANGS_ON = ("services/contacts", "services/folders.py", *(f"services/{name}.py" for name in STAGES.split()))
HANGS_ON += tuple(f"models/{name}.py" for name in SKIN.split())
FREE = (0, 1, 2, 0.5)  # decide nothing by themselves
DERIVED, LITERAL = "derived", "literal"
REST_S = 1.0


class Decides(NamedTuple):
    """A number that decides something."""

    where: str
    name: str  # of what its expression makes
    value: float
    unit: str
    meaning: str  # of a literal: its line
    origin: str  # "class: where it comes from", or LITERAL

    @property
    def kind(self) -> str:
        return self.origin.partition(":")[0]


def files(folders: tuple[str, ...] = AREAS) -> list[Path]:
    """Modules of folders, and single modules."""
    paths = [ROOT / folder for folder in folders]
    return sorted(file for path in paths for file in (path.rglob("*.py") if path.is_dir() else [path]))


def lines(of: list[Path]) -> int:
    return sum(len(file.read_text().splitlines()) for file in of)


def numbers(of: list[Path]) -> list[Decides]:
    """Entries of the tables, then every further literal but FREE ones and indices."""
    found = [each for file in of for each in _below(ast.parse(file.read_text()), file, "")]
    return sorted(found, key=lambda each: each.kind == LITERAL)


def not_derived(found: list[Decides]) -> int:
    return sum(number.kind != DERIVED for number in found)


def _below(node: ast.AST, file: Path, name: str) -> Iterator[Decides]:
    """Of a node; name: of what the expression makes that it stands in."""
    where = f"{file.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        name = node.targets[0].id
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Number":
        value, *texts = (ast.literal_eval(each) for each in node.args)
        yield Decides(where, name, float(str(value)), *map(str, texts))
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        if node.value not in FREE:
            line = file.read_text().splitlines()[node.lineno - 1].strip()
            yield Decides(where, name, float(node.value), "", line, LITERAL)
    index = node.slice if isinstance(node, ast.Subscript) else None
    for child in ast.iter_child_nodes(node):
        if child is not index:
            yield from _below(child, file, name)


def files_of_scans() -> dict[str, set[str]]:
    """Modules of services and models that run for a whole scan where nothing touches, and until a touch is shown."""
    host = tared("full", snr_db=80.0, seed=1)
    host.until(host.now + REST_S)
    quiet = _run_through(host, len(host.contacts) + 1)
    host.press(x=0.01, y=-0.01, force=2.0)
    host.contacts.clear()
    return {"quiet": quiet, "touched": _run_through(host)}


def _run_through(host: SimulatedHost, until: int = 0) -> set[str]:
    """Until so many frames are out; 0: until one shows a contact."""
    seen = set[str]()
    sys.setprofile(lambda frame, event, argument: seen.add(frame.f_code.co_filename))
    try:
        while len(host.contacts) < until or (not until and not any(each.contacts for _, each in host.contacts)):
            host.step()
    finally:
        sys.setprofile(None)
    names = {str(Path(name).relative_to(ROOT)) for name in seen if Path(name).is_relative_to(ROOT)}
    return {name for name in names if name.startswith(("services/", "models/"))}
