"""What tests need beyond the packages of `make venv-dev`. Where it is missing, a test is skipped with one line that
says how to get it, and the end of the run counts what was skipped by what is missing. A run that must have something
says so in the environment ($EITSKIN_REQUIRE_TRAIN and so on): there a test that lacks it fails.
"""

import importlib.util
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Need:
    """Packages, programs and files, all of which there must be. required: the variable by which a run insists."""

    get: str
    required: str = ""
    packages: Sequence[str] = ()
    programs: Sequence[str] = ()
    files: Sequence[Path] = ()

    def here(self) -> None:
        missing = [name for name in self.packages if importlib.util.find_spec(name) is None]
        missing += [name for name in self.programs if shutil.which(name) is None]
        if missing := missing + [str(file) for file in self.files if not file.is_file()]:
            self.lack(", ".join(missing))

    def lack(self, what: str) -> None:
        said = f"no {what}: {self.get}"
        if self.required and os.environ.get(self.required, "0") not in ("", "0"):
            pytest.fail(f"{said} (${self.required} is set)", pytrace=False)
        pytest.skip(said, allow_module_level=True)


TRAIN = Need("`make venv-dev EXTRAS=train`", "EITSKIN_REQUIRE_TRAIN", packages=["torch"])
PLOTS = Need("`make venv-dev EXTRAS=plots`", "EITSKIN_REQUIRE_PLOTS", packages=["matplotlib"])
RERUN = Need("`.venv/bin/pip install 'rerun-sdk>=0.41'`", "EITSKIN_REQUIRE_RERUN", packages=["rerun"])
BROWSER = os.environ.get("EITSKIN_CHROMIUM") or "chromium"
GET_BROWSER = "`apt-get install chromium`, or $EITSKIN_CHROMIUM names one"
CHROMIUM = Need(GET_BROWSER, "EITSKIN_REQUIRE_BROWSER", programs=[BROWSER])
NODE = Need("`apt-get install nodejs`", programs=["node"])
SUPERUSER = Need("run the tests as root, in a container of their own")
GET_CPP = "`apt-get install g++ cppzmq-dev libmsgpack-cxx-dev`"
HEADERS = [Path("/usr/include/zmq.hpp"), Path("/usr/include/msgpack.hpp")]
CPP = Need(GET_CPP, "EITSKIN_REQUIRE_CPP", programs=["g++"], files=HEADERS)
ROS_PYTHON = Path(os.environ.get("EITSKIN_ROS_PYTHON") or ROOT / ".venv-ros" / "bin" / "python")
ROS_NODE = ROS_PYTHON.parents[1] / "lib" / "eitskin_ros" / "skin"
GET_ROS = "`make ros-venv` (400 MB), or $EITSKIN_ROS_PYTHON names one"
ROS_2 = Need(GET_ROS, "EITSKIN_REQUIRE_ROS", files=[ROS_PYTHON, ROS_NODE])
REFERENCE = Path(os.environ.get("EITSKIN_REFERENCE") or ROOT / ".." / "shared" / "data").resolve()


def reference(name: str) -> Path:
    path = REFERENCE / name
    Need("$EITSKIN_REFERENCE names the folder of the reference data", "EITSKIN_REQUIRE_REFERENCE", files=[path]).here()
    return path


def pytest_terminal_summary(terminalreporter: Any) -> None:
    said = [report.longrepr for report in terminalreporter.stats.get("skipped", [])]
    reasons = Counter(str(s[2] if isinstance(s, Sequence) else s).removeprefix("Skipped: ") for s in said)
    for reason, count in sorted(reasons.items()):
        terminalreporter.write_line(f"not run, {count}: {reason}")
