"""What a controller installs: protocol/ under the name eitskin, with numpy, pyzmq and msgpack alone."""

import subprocess
import sys
import tomllib
from pathlib import Path

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


def test_the_wheel_is_typed_and_needs_three_packages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needs = {need.split(">")[0] for need in project["project"]["dependencies"]}
    assert needs == {"numpy", "pyzmq", "msgpack"}
    assert "py.typed" in project["tool"]["setuptools"]["package-data"]["eitskin"]
    assert (ROOT / "protocol" / "py.typed").is_file()
