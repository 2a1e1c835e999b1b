"""How much there is to read of the estimator: its lines and files, the numbers that decide, and the files that one scan
runs through. What `skin dev numbers` and `skin dev size` print.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeGuard

from bench import ROOT
from simulation.host import SimulatedHost, tared

AREAS = ("services/estimation", "models/measurement")
HANGS_ON = (
    "services/contacts",
    *(f"services/{name}.py" for name in ("preprocessing", "inference", "publisher", "pipeline", "judged", "describe")),
    *(f"services/{name}.py" for name in ("networks", "symmetry", "mounting", "linearisation", "health", "folders")),
    *(f"models/{name}.py" for name in ("locator", "locator_arrays", "pressure", "response_file", "response_tables")),
)
FREE = (0, 1, 2, 0.5)  # decide nothing by themselves
DERIVED = "derived"
LITERAL = "literal"
REST_S = 1.0


class Decides(NamedTuple):
    """A number that decides something."""

    name: str  # or the line that a literal stands in
    value: float
    unit: str
    origin: str  # "class: where it comes from"; LITERAL: it says nothing
    meaning: str
    where: str

    @property
    def kind(self) -> str:
        return self.origin.partition(":")[0]


def files(folders: tuple[str, ...] = AREAS) -> list[Path]:
    """Modules of folders, and single modules."""
    paths = [ROOT / folder for folder in folders]
    return sorted(file for path in paths for file in (path.rglob("*.py") if path.is_dir() else [path]))


def lines(of: list[Path]) -> int:
    return sum(len(file.read_text().splitlines()) for file in of)


def numbers() -> list[Decides]:
    """Entries of the tables, then every further literal but FREE ones and indices."""
    found = [number for file in files() for number in _of_file(file)]
    return sorted(found, key=lambda number: number.kind == LITERAL)


def not_derived(found: list[Decides]) -> int:
    return sum(number.kind != DERIVED for number in found)


def _of_file(file: Path) -> Iterator[Decides]:
    source, name = file.read_text(), str(file.relative_to(ROOT))
    lines_of_file = source.splitlines()
    for each in _below(ast.parse(source), ""):
        line = int(each.where)
        meaning = each.meaning or lines_of_file[line - 1].strip()
        yield each._replace(meaning=meaning, where=f"{name}:{line}")


def _below(node: ast.AST, label: str) -> Iterator[Decides]:
    """Of a node; label: what the value is called in whose expression it stands."""
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        label = node.targets[0].id
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Number":
        value, *texts = (ast.literal_eval(each) for each in node.args)
        unit, meaning, origin = map(str, texts)
        yield Decides(label, float(str(value)), unit, origin, meaning, str(node.lineno))
        return
    if isinstance(node, ast.Constant) and _is_number(node.value) and node.value not in FREE:
        yield Decides(label, float(node.value), "", LITERAL, "", str(node.lineno))
    index = node.slice if isinstance(node, ast.Subscript) else None
    for child in ast.iter_child_nodes(node):
        if child is not index:
            yield from _below(child, label)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def files_of_scans() -> dict[str, set[str]]:
    """Modules of services and models with a function that runs for a whole scan: one where nothing touches, and those
    until a touch that begins is shown.
    """
    host = tared("full", snr_db=80.0, seed=1)
    host.until(host.now + REST_S)
    quiet = _run_through(host, until=len(host.contacts) + 1)
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


def of_estimator(names: set[str]) -> set[str]:
    return {name for name in names if name.startswith(AREAS)}
