"""Version, licence and citation: each stated once, or the same wherever it is stated."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib

import protocol
from models import EXTRAS
from tests.docs.snippets import ROOT


def test_the_version_is_the_same_everywhere() -> None:
    """The wheel reads protocol.__version__; the other two are for people."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["dynamic"] == ["version"]
    newest = re.search(r"^## \[(\d+\.\d+\.\d+)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert newest and cited
    assert newest[1] == cited[1] == protocol.__version__


def test_skin_says_its_version() -> None:
    ran = subprocess.run([sys.executable, ROOT / "skin", "--version"], capture_output=True, text=True)
    assert (ran.returncode, ran.stdout) == (0, f"eitskin {protocol.__version__}\n")


def test_the_licence_is_apache_2() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    text = (ROOT / "LICENSE").read_text()
    assert project["license"] == "Apache-2.0" and project["license-files"] == ["LICENSE"]
    assert re.search(r"Apache License\s+Version 2\.0, January 2004", text) and "END OF TERMS AND CONDITIONS" in text
    assert "license: Apache-2.0" in (ROOT / "CITATION.cff").read_text()


def test_an_extra_that_an_error_names_brings_the_package() -> None:
    """Packages by the names under which they are imported; `make venv EXTRAS=...` installs what the lock says."""
    installed = {"PIL": "pillow", "zenoh": "eclipse-zenoh"}
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        brought = [*extras[extra], *(ROOT / "requirements" / f"{extra}.lock").read_text().splitlines()]
        for package in packages:
            name = installed.get(package, package)
            assert any(line.startswith(f"{name}==") for line in brought), f"{extra} does not bring {name}"


def test_what_tests_need_comes_without_what_is_large() -> None:
    """`make test` installs this; PyTorch is several GB, pictures and peers are extras of their own."""
    brought = (ROOT / "requirements" / "dev.lock").read_text()
    for package in ("torch", "nvidia", "matplotlib", "pyeit", "dask", "eclipse-zenoh"):
        assert not re.search(rf"^{package}\b", brought, re.MULTILINE), package
