"""What a controller installs: protocol/ under the name eitskin, with numpy, pyzmq and msgpack alone."""

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]

CODE = """
import pathlib, pkgutil, sys
sys.path.insert(0, sys.argv[1])

class Only:
    def find_spec(self, name, path=None, target=None):
        top = name.split(".")[0]
        if top not in sys.stdlib_module_names and top not in ("eitskin", "numpy", "zmq", "msgpack"):
            raise ImportError(f"{name} is not there")

sys.meta_path.insert(0, Only())
import eitskin
for module in pkgutil.iter_modules(eitskin.__path__):
    __import__(f"eitskin.{module.name}")
assert all(getattr(eitskin, name) for name in eitskin.__all__) and issubclass(eitskin.Stale, eitskin.EitskinError)
assert eitskin.aio.AsyncContactSubscriber and eitskin.listener.ContactListener and eitskin.client.ContactSubscriber
"""


def test_every_module_is_importable_under_the_wheels_name_with_its_three_packages_only(tmp_path):
    (tmp_path / "eitskin").symlink_to(ROOT / "protocol")
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE, str(tmp_path)], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_the_wheel_is_the_client_and_leaves_nothing_beside_its_sources(tmp_path):
    """What `pip install .` builds, in a copy of what it reads: typed, every module of protocol/, three packages."""
    source = tmp_path / "source"
    shutil.copytree(ROOT / "protocol", source / "protocol", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    before = sorted(source.rglob("*"))
    built = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run([*built, "-w", tmp_path, source], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(source.rglob("*")) == before
    (wheel,) = tmp_path.glob("eitskin-*.whl")
    with zipfile.ZipFile(wheel) as file:
        names = {name for name in file.namelist() if ".dist-info/" not in name}
        (metadata,) = (name for name in file.namelist() if name.endswith(".dist-info/METADATA"))
        needs = re.findall(r"^Requires-Dist: ([a-z]+)[^;\n]*$", file.read(metadata).decode(), re.MULTILINE)
    modules = {f"eitskin/{path.name}" for path in (ROOT / "protocol").glob("*.py")}
    assert names == modules | {"eitskin/py.typed", "eitskin/WIRE.md"}
    assert set(needs) == {"numpy", "pyzmq", "msgpack"}
