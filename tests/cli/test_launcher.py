"""The launcher: any folder, no installation, quick."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]


def test_it_runs_from_any_folder_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "skin").symlink_to(ROOT / "skin")
    command = [sys.executable, str(tmp_path / "skin"), "scene", "--json"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0 and "paper_49" in json.loads(ran.stdout)


def test_without_an_installation_it_says_make_venv(tmp_path: Path) -> None:
    shutil.copy(ROOT / "skin", tmp_path / "skin")
    base = os.path.realpath(sys.executable)
    command = [base, "-I", "-S", str(tmp_path / "skin"), "up"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 2 and "make venv" in ran.stderr and len(ran.stderr.splitlines()) == 1


def test_starting_a_command_loads_nothing_heavy() -> None:
    program = "import sys; from services.cli import app; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy = {"numpy", "scipy", "onnxruntime", "torch", "zmq", "supervisor", "mcap", "models", "serial"}
    assert not heavy & {name.split(".")[0] for name in loaded.stdout.split()}


def test_press_needs_neither_network_nor_solver() -> None:
    program = "import sys, protocol.sockets, services.cli.board; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not {"scipy", "onnxruntime", "torch", "models", "pydantic_settings"} & {
        name.split(".")[0] for name in loaded.stdout.split()
    }
