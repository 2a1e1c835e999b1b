"""Every exception of the project is an EitskinError, and the docstring of EitskinError names each at its place."""

from __future__ import annotations

import ast
import builtins
import importlib
import inspect
import pathlib
import re
import subprocess
import sys

import pytest

import protocol
from protocol.errors import EitskinError
from tests import needs

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDERS = ("protocol", "models", "services", "firmware_stub", "bridges", "bench", "examples")
BUILT_IN = {n for n, what in vars(builtins).items() if isinstance(what, type) and issubclass(what, BaseException)}
ENTRY = re.compile(r"^ *((?:[│├└]| {4})[│├└─ ]*) (\w+)(?: \((\w+)\))?  ", re.MULTILINE)


def named(base: ast.expr) -> str:
    return base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "")


def exception_classes() -> list[type[BaseException]]:
    """Public classes of the project that derive from an exception, found in the sources, then imported."""
    classes: dict[str, tuple[str, set[str]]] = {}
    for path in (p for folder in FOLDERS for p in sorted((ROOT / folder).rglob("*.py"))):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes[f"{module}:{node.name}"] = (node.name, {named(base) for base in node.bases})
    known, size = set(BUILT_IN), 0
    while size != len(known):
        size = len(known)
        known |= {name for name, bases in classes.values() if bases & known}
    found = [key for key, (name, bases) in classes.items() if bases & known and not name.startswith("_")]
    modules = {key: importlib.import_module(key.partition(":")[0]) for key in found}
    return [getattr(modules[key], key.partition(":")[2]) for key in sorted(found)]


def tree() -> dict[str, tuple[str, str]]:
    """The docstring's entries: name -> (name of the entry it hangs on, built-in base or "")."""
    entries, above = {}, {0: "EitskinError"}
    for line in ENTRY.finditer(inspect.cleandoc(EitskinError.__doc__ or "")):
        depth = len(line[1].rstrip("─")) // 4 + 1
        above[depth] = line[2]
        entries[line[2]] = (above[depth - 1], line[3] or "")
    return entries


@pytest.fixture(scope="module")
def classes() -> list[type[BaseException]]:
    needs.TRAIN.here()  # whose modules have exceptions of their own
    needs.PLOTS.here()
    return exception_classes()


def test_every_exception_is_an_eitskin_error(classes: list[type[BaseException]]) -> None:
    strangers = [f"{c.__module__}.{c.__name__}" for c in classes if not issubclass(c, EitskinError)]
    assert not strangers, f"{strangers} do not derive from protocol.errors.EitskinError"
    assert {"Stale", "FrameError", "ConfigError", "BundleError", "SceneError"} <= {c.__name__ for c in classes}


def test_the_docstring_is_the_tree(classes: list[type[BaseException]]) -> None:
    really = {}
    for error in classes:
        if error is EitskinError:
            continue
        project = next(base for base in error.__bases__ if issubclass(base, EitskinError))
        built_in = [base.__name__ for base in error.__bases__ if base.__name__ in BUILT_IN]
        really[error.__name__] = (project.__name__, "".join(built_in))
    assert tree() == really


def test_the_base_catches_and_the_old_bases_still_do() -> None:
    with pytest.raises(EitskinError):
        raise protocol.Stale("nothing came", None)
    assert issubclass(protocol.Stale, RuntimeError) and issubclass(protocol.FrameError, ValueError)


@pytest.mark.parametrize("name", protocol.__all__)
def test_public_names_are_those_of_their_modules(name: str) -> None:
    value = getattr(protocol, name)
    if isinstance(value, type):
        assert getattr(importlib.import_module(value.__module__), name) is value
    assert name in dir(protocol)


def test_what_is_not_public_is_not_there() -> None:
    with pytest.raises(AttributeError, match="Nonsense"):
        protocol.Nonsense  # noqa: B018


def test_importing_protocol_loads_nothing_but_itself() -> None:
    code = "import sys, protocol; print({'numpy', 'zmq', 'msgpack', 'asyncio'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
