"""All that is not in `.ci/run`, because it is slow, needs more than PyPI, or draws anew: before a release, each night.

    make check-all                      every step, in an hour or two on two idle cores
    make check-all ONLY="ros fuzz"      these steps

Goes on after a failure. Ends with a table of the steps and writes it to build/check-all.json. Exits 1 where a step
failed. What a step finds becomes a case of `make test`.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REPORT = ROOT / "build" / "check-all.json"
PYTHON = ".venv/bin/python"
PYTEST = f"{PYTHON} -m pytest"
PACKAGES = "g++ make libc6-dev python3-dev cppzmq-dev libmsgpack-cxx-dev chromium fonts-dejavu-core iptables"
REQUIRED = ("REFERENCE", "BROWSER", "TRAIN", "PLOTS", "CPP", "ROS")  # tests/needs.py


@dataclass(frozen=True)
class Step:
    """A line for bash. A step whose `needs` failed is not run."""

    name: str
    what: str
    command: str
    limit_s: float
    needs: tuple[str, ...] = ()


DETERMINISTIC = "-m 'not live and not release'"
ROS_NODE = f"{PYTEST} -m 'release or not release' tests/bridges/test_ros2_node.py"
STEPS = (
    Step("packages", "programs that tests need", f"apt-get update -q && apt-get install -y -q {PACKAGES}", 900),
    Step("extras", "every extra, by its own lock", "make venv-dev EXTRAS=train,plots,peers,ros2,foxglove,hdf5", 1800),
    Step("test", "lint, strict about PyTorch too, and make test", "make test", 1800, ("extras",)),
    Step(
        "release",
        "tests that are slow or need more",
        f"make ros-venv; {PYTEST} -n 1 --timeout 1800 --reruns 1 -m release",
        5400,
        ("extras",),
    ),
    Step(
        "order",
        "deterministic tests in another order each time",
        f"{PYTHON} -m pip install -q pytest-randomly; {PYTEST} -n auto -p randomly {DETERMINISTIC};"
        f" {PYTHON} -m pip uninstall -qy pytest-randomly",
        1800,
        ("extras",),
    ),
    Step(
        "kernels",
        "deterministic tests with this machine's own kernels",
        f"EITSKIN_UNPINNED=1 {PYTEST} -n auto {DETERMINISTIC}",
        1800,
        ("extras",),
    ),
    Step(
        "ros",
        "bridges/ros2 built by two distributions of ROS 2, each node heard by a stranger",
        f"make ros-venv; make ros-venv ROS=jazzy; {ROS_NODE}; EITSKIN_ROS_PYTHON=.venv-ros-jazzy/bin/python {ROS_NODE}",
        2400,
        ("extras",),
    ),
    Step("compose", "compose file, with a ROS node", ".ci/compose page ros2 foxglove", 1200),
    Step(
        "rerun",
        "what skin export --rerun writes, read by rerun",
        f"{PYTHON} -m pip install -q 'rerun-sdk>=0.41,<1'; EITSKIN_REQUIRE_RERUN=1 {PYTEST} -k rerun"
        " tests/bridges/test_export.py",
        600,
        ("extras",),
    ),
    Step("fresh", "a fresh clone with each other Python", ".ci/fresh --but .venv/bin/python", 2400),
    Step(
        "fuzz",
        "decoders and commands fed with other rubbish each time",
        f"{PYTHON} -m pip install -q 'atheris>=2.3,<4' || true; make search",
        5400,
        ("extras",),
    ),
    Step(
        "train",
        "a bundle trained from nothing, and pressed",
        f"{PYTHON} -m models.build --skin square16 --minutes 5 --anyway --out build/check-bundle"
        " --work build/check-work;"
        f" EITSKIN_TRAINED=build/check-bundle {PYTEST} -m release tests/cli/test_many_skins.py",
        2400,
        ("extras",),
    ),
    Step("bench", "every benchmark in short form", f"{PYTHON} -m bench.all --quick --out build/bench", 5400),
)


def main(names: list[str]) -> int:
    known = [step.name for step in STEPS]
    if unknown := set(names) - set(known):
        print(f"no step {', '.join(sorted(unknown))}: expected some of {', '.join(known)}", file=sys.stderr)
        return 2
    results: dict[str, dict[str, object]] = {}
    for step in STEPS:
        if not names or step.name in names:
            print(f"\n=== {step.name}: {step.what}", flush=True)
            results[step.name] = asdict(step) | run(step, results)
            REPORT.parent.mkdir(exist_ok=True)
            REPORT.write_text(json.dumps(list(results.values()), indent=1) + "\n")
    print(f"\n{'step':10} {'s':>6} result")
    for name, result in results.items():
        print(f"{name:10} {result['seconds']:6} {result['result']}")
    return int(any(result["result"] != "passed" for result in results.values()))


def run(step: Step, before: dict[str, dict[str, object]]) -> dict[str, object]:
    lacks = [name for name in step.needs if name in before and before[name]["result"] != "passed"]
    if lacks:
        return {"seconds": 0, "result": f"not run: {', '.join(lacks)} failed"}
    environment = os.environ | {"CI": "true"} | {f"EITSKIN_REQUIRE_{name}": "1" for name in REQUIRED}
    began = time.monotonic()
    command = ["timeout", "--kill-after=30", str(step.limit_s), "bash", "-euo", "pipefail", "-c", step.command]
    code = subprocess.run(command, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL).returncode
    result = {0: "passed", 124: f"longer than {step.limit_s:g} s"}.get(code, f"failed, exit {code}")
    if code:
        print(f"{step.name}: {result}; again: {shlex.join(command[3:])}", flush=True)
    return {"seconds": round(time.monotonic() - began), "result": result}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
