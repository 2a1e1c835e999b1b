"""The launcher: any folder, no installation, quick."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]


def ran(*command, **more):
    return subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, **more)


def test_it_runs_from_any_folder_through_a_link_and_without_an_installation_says_make_venv(tmp_path):
    (tmp_path / "skin").symlink_to(ROOT / "skin")
    assert "paper_49" in json.loads(ran(tmp_path / "skin", "scene", "--json", cwd=tmp_path).stdout)
    shutil.copy(ROOT / "skin", tmp_path / "alone")
    bare = [os.path.realpath(sys.executable), "-I", "-S", tmp_path / "alone", "up"]
    alone = subprocess.run(bare, capture_output=True, text=True)
    assert alone.returncode == 2 and "make venv" in alone.stderr and len(alone.stderr.splitlines()) == 1


def test_starting_a_command_loads_nothing_heavy():
    loaded = ran("-c", "import sys, services.cli.app; print(*sys.modules)", cwd=ROOT, check=True).stdout
    heavy = {*"numpy scipy onnxruntime torch zmq supervisor mcap models serial".split()}
    assert not heavy & {name.split(".")[0] for name in loaded.split()}
