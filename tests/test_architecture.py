"""Who may import whom: protocol <- models <- services; firmware_stub uses protocol and models, never services.

The running services read bundles and do pure numerics; they must start without PyTorch or a mesh.
"""

import ast
import pathlib
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDERS = {"protocol", "models", "services", "firmware_stub", "bench", "examples", "tests"}
ALLOWED = {
    "protocol": {"protocol"},
    "models": {"protocol", "models"},
    "services": {"protocol", "models", "services"},
    "firmware_stub": {"protocol", "models", "firmware_stub"},
    "examples": {"protocol", "examples"},
}
WIRE_NEEDS = {"numpy", "zmq", "msgpack"}
RUNTIME_NEEDS = WIRE_NEEDS | {"serial", "onnxruntime", "scipy", "pydantic", "typer", "rich", "supervisor", "mcap"}
# The command line hands these over to the offline tools on demand.
OFFLINE_DOORS = {"services/cli"}
SERVICES_USE_OF_MODELS = {
    "models.bundle",
    "models.files",
    "models.npz",
    "models.prereconstruction",
    "models.patterns",
    "models.sentinel",
    "models.uncertainty",
}


def imports(path: pathlib.Path) -> set[str]:
    """Absolute module names that a file imports, relative ones resolved."""
    found = set()
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found.add(module)
            if module.split(".")[0] in FOLDERS and (ROOT / module.replace(".", "/")).is_dir():
                found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def sources(folder: str) -> list[pathlib.Path]:
    return sorted(p for p in (ROOT / folder).rglob("*.py") if "work" not in p.relative_to(ROOT).parts)


def closure(names: set[str]) -> set[str]:
    """Project modules reached from `names` through imports."""
    seen: set[str] = set()
    todo = {n for n in names if n.split(".")[0] in FOLDERS}
    while todo:
        name = todo.pop()
        path = ROOT / (name.replace(".", "/") + ".py")
        if name in seen or not path.exists():
            continue
        seen.add(name)
        todo |= {n for n in imports(path) if n.split(".")[0] in FOLDERS}
    return seen


@pytest.mark.parametrize("folder", ALLOWED)
def test_folders_import_only_what_they_may(folder: str) -> None:
    files = sources(folder)
    assert files, f"no Python files in {folder}/"
    for path in files:
        relative = str(path.relative_to(ROOT))
        if any(relative.startswith(door) for door in OFFLINE_DOORS):
            continue
        forbidden = {n for n in imports(path) if n.split(".")[0] in FOLDERS - ALLOWED[folder]}
        assert not forbidden, f"{relative} imports {sorted(forbidden)}"


def test_protocol_imports_its_own_modules_relatively() -> None:
    for path in sources("protocol"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and not node.level:
                assert (node.module or "").split(".")[0] != "protocol", path
            if isinstance(node, ast.Import):
                assert all(a.name.split(".")[0] != "protocol" for a in node.names), path


@pytest.mark.parametrize(("folder", "allowed"), [("protocol", WIRE_NEEDS), ("services", RUNTIME_NEEDS)])
def test_only_runtime_dependencies(folder: str, allowed: set[str]) -> None:
    for path in sources(folder):
        outside = {n.split(".")[0] for n in imports(path)} - set(sys.stdlib_module_names) - FOLDERS - {""}
        assert outside <= allowed, f"{path.relative_to(ROOT)} imports {sorted(outside - allowed)}"


def test_services_take_only_bundle_and_numerics_from_models() -> None:
    for path in sources("services"):
        if any(str(path.relative_to(ROOT)).startswith(door) for door in OFFLINE_DOORS):
            continue
        direct = {n for n in imports(path) if n.startswith("models.") and n.count(".") == 1}
        assert direct <= SERVICES_USE_OF_MODELS, f"{path.relative_to(ROOT)} imports {sorted(direct)}"
        for module in closure(direct):
            heavy = {n.split(".")[0] for n in imports(ROOT / (module.replace(".", "/") + ".py"))} & {"torch", "skfem"}
            assert not heavy, f"{path.relative_to(ROOT)} reaches {sorted(heavy)} through {module}"
