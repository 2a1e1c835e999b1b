"""Who may import whom, without circles. The running services must start without PyTorch or a mesh."""

import ast
import builtins
import graphlib
import pathlib
import re
import subprocess
import sys
from functools import cache
from typing import NamedTuple

from protocol.errors import EitskinError

ROOT = pathlib.Path(__file__).resolve().parents[1]
ALLOWED = {folder: {"protocol", folder} for folder in ("protocol", "models", "examples", "bridges")}
ALLOWED |= {folder: {"protocol", "models", folder} for folder in ("services", "firmware_stub")}
ALLOWED["simulation"] = {"protocol", "models", "services", "firmware_stub", "simulation"}
FOLDERS = {*ALLOWED, "bench", "tests"}
WIRE_NEEDS = {"numpy", "zmq", "msgpack"}
RUNTIME_NEEDS = WIRE_NEEDS | {"serial", "onnxruntime", "scipy", "pydantic", "typer", "rich", "supervisor", "mcap"}
NEEDS = {"protocol": WIRE_NEEDS, "services": RUNTIME_NEEDS, "bridges": WIRE_NEEDS}
BRIDGES_NEED = dict.fromkeys(("door", "serving"), {"aiohttp"})  # beside what protocol needs: an extra of its own
BRIDGES_NEED |= {"page": {"aiohttp", "mcap", "prometheus_client"}}
BRIDGES_NEED["ros2"] = {*"eitskin eitskin_ros geometry_msgs launch launch_ros rcl_interfaces rclpy setuptools".split()}
BRIDGES_NEED["ros2"] |= {"std_srvs"}
BRIDGES_NEED |= {"foxglove": {"foxglove", "aiohttp"}, "export": {"rosbags", "foxglove", "rerun"}}
OFFLINE_DOORS = "services.cli"  # the command line hands over to the offline tools on demand
SERVICES_USE_OF_MODELS = {*"bundle calibration_file files locator locator_arrays measurement npz patterns".split()}
SERVICES_USE_OF_MODELS |= {*"prereconstruction pressure rolling shapes symmetries turns".split()}
# What services/estimation may import of the project
NUMERICS = ("models", "services.estimation", "protocol.frames", "protocol.frame_types", "protocol.errors")
# Rooms of the estimator, each of which stands on those before it, on values and on models/measurement
ROOMS = ("filter", "overlap", "track", "touches", "hypotheses.hypotheses", "tared", "hypotheses.selection")
ROOMS += ("track_update", "scan_step", "estimator")
# What of the standard library reads or writes files, sockets or processes
OUTSIDE_WORLD = {"os", "socket", "pathlib", "tempfile", "shutil", "subprocess", "threading", "time"}


class Source(NamedTuple):
    imports: set[str]  # absolute names, anywhere in the file
    classes: list[tuple[str, list[str]]]  # name, bases

    def outside(self) -> set[str]:
        return {name.split(".")[0] for name in self.imports} - FOLDERS - set(sys.stdlib_module_names) - {""}


@cache
def sources() -> dict[str, Source]:
    files = [p.relative_to(ROOT) for folder in (*ALLOWED, "bench") for p in sorted((ROOT / folder).rglob("*.py"))]
    names = {".".join(p.with_suffix("").parts).removesuffix(".__init__"): p for p in files if "work" not in p.parts}
    return {name: source(path, names.keys()) for name, path in names.items()}


def source(path: pathlib.Path, modules: set[str]) -> Source:
    found = Source(set(), [])
    todo: list[ast.AST] = [ast.parse((ROOT / path).read_text(encoding="utf-8"))]
    for node in todo:  # statements alone: an expression imports nothing
        for field in ("body", "orelse", "finalbody", "handlers", "cases"):
            todo += getattr(node, field, ())
        if isinstance(node, ast.ClassDef):
            bases = [base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "") for base in node.bases]
            found.classes.append((node.name, bases))
        elif isinstance(node, ast.Import):
            found.imports.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level or path.parts[0] != "protocol" or (node.module or "").split(".")[0] != "protocol", path
            base = path.parent.parts[: len(path.parent.parts) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            parts = {f"{module}.{alias.name}" for alias in node.names}
            found.imports.update(part if part in modules else module for part in parts)
    return found


def of(folder: str) -> dict[str, Source]:
    return {name: each for name, each in sources().items() if f"{name}.".startswith(f"{folder}.")}


@cache
def graph() -> dict[str, set[str]]:
    found = {name: {i for i in each.imports if i in sources()} - {name} for name, each in sources().items()}
    return found | {"protocol": set()}  # which only lends names of its modules, each loaded when it is first used


def test_folders_import_only_what_they_may() -> None:
    for folder, allowed in ALLOWED.items():
        for name, each in of(folder).items():
            if not name.startswith(OFFLINE_DOORS):
                forbidden = {n for n in each.imports if n.split(".")[0] in FOLDERS - allowed}
                assert not forbidden, f"{name} imports {sorted(forbidden)}"
            own = BRIDGES_NEED.get((*name.split("."), "")[1], set()) if folder == "bridges" else set()
            drawing = {"matplotlib"} if name.endswith("session_picture") else set()  # `skin info --png`: an extra
            more = each.outside() - NEEDS.get(folder, each.outside()) - own - drawing
            assert not more, f"{name} imports {sorted(more)}"


def test_services_take_only_bundle_and_numerics_from_models() -> None:
    for name, each in of("services").items():
        if not name.startswith(OFFLINE_DOORS):
            direct = {n for n in each.imports if n.startswith("models.")}
            assert {n.split(".")[1] for n in direct} <= SERVICES_USE_OF_MODELS, f"{name} imports {sorted(direct)}"
            todo = [n for n in direct if n in sources()]
            for module in todo:
                heavy = sources()[module].outside() & {"torch", "skfem"}
                assert not heavy, f"{name} reaches {sorted(heavy)} through {module}"
                todo += sorted(graph()[module] - {*todo})


def test_no_circle_of_files_or_folders() -> None:
    files = {name: others for name, others in graph().items() if not name.startswith("examples")}
    assert len(files) > 150 and files["services.cli.common"] >= {"services.runtime.config"}
    for depth in (9, 2, 1):  # files; services.board for all of its files; folders of the root
        parts: dict[str, set[str]] = {}
        for name, others in files.items():
            if depth > 1 or not name.startswith(OFFLINE_DOORS):
                here, *there = (".".join(n.split(".")[:depth]) for n in (name, *others))
                parts.setdefault(here, set()).update({*there} - {here})
        graphlib.TopologicalSorter(parts).prepare()  # names the circle


def test_estimation_imports_numerics_only_and_stands_in_its_order() -> None:
    for name, each in (of("services.estimation") | of("models.measurement")).items():
        more = {n for n in graph()[name] - {"services"} if not f"{n}.".startswith(tuple(f"{ok}." for ok in NUMERICS))}
        assert not more or name.startswith("models"), f"{name} imports {sorted(more)}: estimation imports numerics only"
        strange = each.outside() - {"numpy", "scipy"} | each.imports & OUTSIDE_WORLD
        assert not strange, f"{name} imports {sorted(strange)}"
    rooms = [f"services.estimation.{name}" for name in ROOMS]
    assert not [room for place, room in enumerate(rooms) if graph()[room] & {*rooms[place + 1 :]}]
    values = set().union(*(graph()[name] for name in of("services.estimation.values")))
    assert not {n for n in values if n.startswith("services") and not n.startswith("services.estimation.values")}
    assert {name for name, others in graph().items() if rooms[-1] in others} == {"services.preprocessing"}


def test_a_class_name_is_defined_once_and_exceptions_are_those_that_their_base_lists() -> None:
    classes = [found for each in sources().values() for found in each.classes]
    names, bases = [name for name, _ in classes], dict(classes)
    assert len(bases) > 300
    assert not {name for name in names if names.count(name) > 1}, "a class of this name is there, choose another"
    built_in = {n for n, what in vars(builtins).items() if isinstance(what, type) and issubclass(what, BaseException)}

    def derives(name: str, root: set[str]) -> bool:
        return name in root or any(derives(base, root) for base in bases.get(name, ()))

    errors = {name for name in bases if derives(name, built_in) and not name.startswith("_")} - {"EitskinError"}
    strangers = {name for name in errors if not derives(name, {"EitskinError"})}
    assert not strangers, f"{strangers} do not derive from protocol.errors.EitskinError"
    told = re.findall(r"^ *[│├└─ ]+ (\w+)(?: \((\w+)\))?  ", EitskinError.__doc__ or "", re.MULTILINE)
    assert dict(told) == {name: "".join(base for base in bases[name] if base in built_in) for name in errors}


def test_protocol_loads_nothing_before_it_is_used() -> None:
    code = "import sys, protocol; print({'numpy', 'zmq', 'msgpack', 'asyncio'} & set(sys.modules)); "
    code += "from protocol import *; protocol.Nonsense"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "set()" and "AttributeError" in done.stderr and "Nonsense" in done.stderr
