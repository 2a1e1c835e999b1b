"""Every `path.py:Class.function` that a page names exists, and so does every `path.py` and folder beside it."""

from __future__ import annotations

import ast
import re

import pytest

from tests.docs.snippets import ROOT, documents

PLACE = re.compile(r"`([\w/]+\.py):([\w.]+)`")
PATH = re.compile(r"`((?:protocol|models|services|firmware_stub|bench|examples|tests)/[\w/.]*)`")
PAGES = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in documents()}
PLACES = sorted({(page, *place) for page, text in PAGES.items() for place in PLACE.findall(text)})


def exists(file: str, name: str) -> bool:
    """Whether the file defines the class, function or method."""
    path = ROOT / file
    if not path.is_file():
        return False
    body: list[ast.stmt] = ast.parse(path.read_text(encoding="utf-8")).body
    for part in name.split("."):
        kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        found = next((node for node in body if isinstance(node, kinds) and node.name == part), None)
        if found is None:
            return False
        body = found.body
    return True


@pytest.mark.parametrize(("page", "file", "name"), PLACES)
def test_the_function_exists(page: str, file: str, name: str) -> None:
    assert exists(file, name), f"{page} names {file}:{name}, which does not exist: correct the page"


@pytest.mark.parametrize("page", PAGES)
def test_paths_exist(page: str) -> None:
    missing = [path for path in PATH.findall(PAGES[page]) if not (ROOT / path).exists()]
    assert not missing, f"{page} names {missing}"


def test_the_whole_way_is_told() -> None:
    assert len([place for place in PLACES if place[0] == "docs/architecture.md"]) > 50


def test_what_does_not_exist_is_missed() -> None:
    assert exists("services/runner.py", "Runner.run")
    assert not exists("services/runner.py", "Runner.walk")
    assert not exists("services/nothing.py", "run")
