"""Who may import whom: protocol <- models <- services; firmware_stub uses protocol and models, never services; and no
circle of files or folders.

The running services read bundles and do pure numerics; they must start without PyTorch or a mesh.
"""

import ast
import pathlib
import sys
from collections.abc import Iterator, Mapping

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDERS = {"protocol", "models", "services", "firmware_stub", "bridges", "bench", "examples", "tests"}
ALLOWED = {
    "protocol": {"protocol"},
    "models": {"protocol", "models"},
    "services": {"protocol", "models", "services"},
    "firmware_stub": {"protocol", "models", "firmware_stub"},
    "examples": {"protocol", "examples"},
    "bridges": {"protocol", "bridges"},
}
WIRE_NEEDS = {"numpy", "zmq", "msgpack"}
RUNTIME_NEEDS = WIRE_NEEDS | {"serial", "onnxruntime", "scipy", "pydantic", "typer", "rich", "supervisor", "mcap"}
BRIDGES_NEED = {
    "page": {"aiohttp", "mcap", "prometheus_client"},
    "ros2": {"cyclonedds"},
    "foxglove": {"foxglove", "aiohttp"},
    "door.py": {"aiohttp"},
    "serving.py": {"aiohttp"},
    "export": {"mcap", "foxglove", "rerun"},
}
"""What each bridge needs beside what protocol needs: an extra of its own."""
# The command line hands these over to the offline tools on demand.
OFFLINE_DOORS = {"services/cli"}
SERVICES_USE_OF_MODELS = {
    "models.bundle",
    "models.calibration_file",
    "models.files",
    "models.locator",
    "models.locator_arrays",
    "models.measurement",
    "models.npz",
    "models.prereconstruction",
    "models.patterns",
    "models.rolling",
    "models.refine",
    "models.symmetries",
    "models.turns",
    "models.shapes",
    "models.touch_grid",
    "models.touch_parameters",
    "models.touch_posterior",
    "models.pressure",
}

WITHOUT_CIRCLES = ("protocol", "models", "services", "firmware_stub", "bridges", "bench")
NUMERICS = ("models", "services.estimation", "protocol.frames", "protocol.frame_types", "protocol.errors")
"""What services/estimation may import of the project: numerics, the frames that name what a scan holds, and the base of
the project's exceptions.
"""


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


def test_a_bridge_needs_what_protocol_needs_and_its_own_extra() -> None:
    for path in sources("bridges"):
        own = BRIDGES_NEED.get(path.relative_to(ROOT).parts[1], set())
        outside = {n.split(".")[0] for n in imports(path)} - set(sys.stdlib_module_names) - FOLDERS - {""}
        assert outside <= WIRE_NEEDS | own, f"{path.relative_to(ROOT)} imports {sorted(outside - WIRE_NEEDS - own)}"


def test_services_take_only_bundle_and_numerics_from_models() -> None:
    for path in sources("services"):
        if any(str(path.relative_to(ROOT)).startswith(door) for door in OFFLINE_DOORS):
            continue
        direct = {n for n in imports(path) if n.startswith("models.") and n.count(".") == 1}
        assert direct <= SERVICES_USE_OF_MODELS, f"{path.relative_to(ROOT)} imports {sorted(direct)}"
        for module in closure(direct):
            heavy = {n.split(".")[0] for n in imports(ROOT / (module.replace(".", "/") + ".py"))} & {"torch", "skfem"}
            assert not heavy, f"{path.relative_to(ROOT)} reaches {sorted(heavy)} through {module}"


def test_a_class_name_is_defined_once() -> None:
    places: dict[str, list[str]] = {}
    for folder in ("protocol", "models", "services", "firmware_stub", "bench", "examples", "bridges"):
        for path in sources(folder):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert len(places) > 300
    twice = {name: found for name, found in places.items() if len(found) > 1}
    assert not twice, f"a class of this name is there already, choose another: {twice}"


Graph = dict[str, set[str]]


def module_graph(root: pathlib.Path, folders: tuple[str, ...]) -> Graph:
    """Module -> the modules of `folders` that it imports, wherever in the file and whether for types only or not.

    `from package import part` is an import of the part where that is a module, else of the package's __init__.
    """
    files = [p.relative_to(root) for folder in folders for p in sorted((root / folder).rglob("*.py"))]
    names = {".".join(p.with_suffix("").parts).removesuffix(".__init__"): p for p in files if "work" not in p.parts}
    modules = {name: root / path for name, path in names.items()}
    graph: Graph = {}
    for name, path in modules.items():
        package = path.relative_to(root).parent.parts
        found = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else ()
                module = ".".join([*base, *([node.module] if node.module else [])])
                parts = {f"{module}.{alias.name}" for alias in node.names}
                found |= {part if part in modules else module for part in parts}
        graph[name] = {other for other in found if other in modules} - {name}
    # protocol/__init__ only lends names of its modules, each loaded when it is first used
    return {name: set() if name == "protocol" else others for name, others in graph.items()}


def folder_graph(files: Graph) -> Graph:
    """The same, folder by folder: services.board stands for all of its files, a file beside the folders for itself."""

    def unit(module: str) -> str:
        return ".".join(module.split(".")[:2])

    graph: Graph = {unit(name): set() for name in files}
    for name, others in files.items():
        graph[unit(name)] |= {unit(other) for other in others} - {unit(name)}
    return graph


def top_graph(files: Graph) -> Graph:
    """The same between protocol, models, services, firmware_stub, bench; the command line, which hands over to the
    offline tools, apart from the services.
    """
    graph: Graph = {name.split(".")[0]: set() for name in files}
    for name, others in files.items():
        if any(name.replace(".", "/").startswith(door) for door in OFFLINE_DOORS):
            continue
        graph[name.split(".")[0]] |= {other.split(".")[0] for other in others} - {name.split(".")[0]}
    return graph


def circles(graph: Mapping[str, set[str]]) -> Iterator[list[str]]:
    """One circle, [a, b, ..., a], of each strongly connected part of more than one node."""

    def reached(start: str) -> dict[str, str]:
        """What `start` imports, directly or not: node -> the node it was first seen from."""
        seen: dict[str, str] = {}
        todo = [start]
        for node in todo:
            for other in sorted(graph[node] - seen.keys()):
                seen[other] = node
                todo.append(other)
        return seen

    named: set[str] = set()
    for start in sorted(graph):
        seen = reached(start)
        if start in seen and start not in named:
            back = [start, seen[start]]
            while back[-1] != start:
                back.append(seen[back[-1]])
            named |= {node for node in seen if start in reached(node)}
            yield back[::-1]


def told(graph: Graph) -> list[str]:
    return [" -> ".join(circle) for circle in circles(graph)]


def test_no_circle_of_files_or_folders() -> None:
    files = module_graph(ROOT, WITHOUT_CIRCLES)
    assert len(files) > 150 and files["services.cli.common"] >= {"services.runtime.config"}
    found = [*told(files), *told(folder_graph(files)), *told(top_graph(files))]
    assert not found, "circles of imports: " + "; ".join(found)


def test_a_circle_is_found_and_named(tmp_path: pathlib.Path) -> None:
    for file, text in {
        "services/__init__.py": "",
        "services/board/__init__.py": "",
        "services/board/port.py": "from services.board import clock\nfrom services.touches.late import late\n",
        "services/board/clock.py": "",
        "services/touches/__init__.py": "",
        "services/touches/late.py": "def late() -> None: ...\n",
        "services/touches/early.py": "def f() -> None:\n    import services.board.clock\n",
        "services/a.py": "from . import b\n",
        "services/b.py": "from .c import x\n",
        "services/c.py": "from services.a import y\n",
    }.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    files = module_graph(tmp_path, ("services",))
    assert told(files) == ["services.a -> services.b -> services.c -> services.a"]
    assert told(folder_graph(files)) == [
        "services.a -> services.b -> services.c -> services.a",
        "services.board -> services.touches -> services.board",
    ]


def test_estimation_imports_numerics_only() -> None:
    """Settings come as plain arguments; what keeps states and answers commands stays outside."""
    for path in sources("services/estimation"):
        relative = str(path.relative_to(ROOT))
        ours = {n for n in imports(path) if n.split(".")[0] in FOLDERS}
        more = {n for n in ours if not any(n == ok or n.startswith(f"{ok}.") for ok in NUMERICS)} - {"services"}
        modules = {n for n in more if (ROOT / (n.replace(".", "/") + ".py")).exists()}
        assert not modules, f"{relative} imports {sorted(modules)}: estimation imports numerics only"
        outside = {n.split(".")[0] for n in imports(path)} - FOLDERS - set(sys.stdlib_module_names) - {""}
        assert outside <= {"numpy", "scipy"}, f"{relative} imports {sorted(outside)}"
        assert not outside_world(path), f"{relative} imports {sorted(outside_world(path))}"


NEW_HOUSE = ("filter", "overlap", "touches", "asked.hypotheses", "tared", "answering", "settling", "estimator")
"""Rooms of the new estimator, each of which stands on those before it, on values and on models/measurement."""


def test_the_new_estimator_stands_in_its_order() -> None:
    graph = module_graph(ROOT, ("models", "services", "bench"))
    rooms = [f"services.estimation.{name}" for name in NEW_HOUSE]
    for place, room in enumerate(rooms):
        assert not graph[room] & set(rooms[place + 1 :]), room
    for name in (name for name in graph if name.startswith("services.estimation.values")):
        ours = {other for other in graph[name] if other.startswith("services")}
        assert all(other.startswith("services.estimation.values") for other in ours), name
    asks = {name for name, others in graph.items() if rooms[-1] in others}
    assert asks == {"services.preprocessing"}


def test_the_measurement_model_reads_no_file_but_through_the_bundle() -> None:
    for path in sources("models/measurement"):
        outside = {n.split(".")[0] for n in imports(path)} - set(sys.stdlib_module_names) - FOLDERS - {""}
        assert outside <= {"numpy", "scipy"} and not outside_world(path), path


def outside_world(path: pathlib.Path) -> set[str]:
    """What of the standard library a file imports that reads or writes files, sockets or processes."""
    return imports(path) & {"os", "socket", "pathlib", "tempfile", "shutil", "subprocess", "threading", "time"}
