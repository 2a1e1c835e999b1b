"""Ctrl-C in any command or example: it leaves, with 130 or by the signal, and without a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests import needs

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
LEFT = (130, -signal.SIGINT)
RUNS = 0.7  # s before Ctrl-C: about when modules have been loaded, on a busy machine while they are


def interrupted(command: list[str], after_s: float, folder: Path) -> tuple[int, str]:
    """Exit status and output of a command that gets SIGINT, as a terminal sends it: it and what it started."""
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "EITSKIN_RUNTIME": str(folder)},
    )
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)
    try:
        out, _ = process.communicate(timeout=30)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise AssertionError(f"{command} goes on after Ctrl-C: {process.communicate()[0]}") from None
    return process.returncode, out


@pytest.mark.parametrize(
    ("arguments", "codes"),
    [
        (("top", "--json"), LEFT),
        (("echo", "contact", "--timeout", "60"), LEFT),
        (("compare", "--seconds", "60"), LEFT),
        (("limits", "--rank"), LEFT),
        (("bench", "stability"), LEFT),
        (("bench", "skip"), LEFT),
        (("calibrate", "force"), LEFT),
        (("reconstruct", "many.npz", "out.npz", "--skin", "square16"), LEFT),
        (("import", "many.npz", "out.mcap", "--rate", "20"), LEFT),
        (("record", "file.mcap"), (*LEFT, 3)),  # Ctrl-C is how a recording ends: here with nothing in it
        (("up",), (*LEFT, 0)),  # Ctrl-C is how the service ends
    ],
    ids=lambda value: " ".join(map(str, value[:2])),
)
def test_commands(runtime: Path, tmp_path: Path, arguments: tuple[str, ...], codes: tuple[int, ...]) -> None:
    rows = np.ones((20_000, 120)) * (1 + 1e-4 * np.random.default_rng(0).standard_normal((20_000, 120)))
    if "many.npz" in arguments:
        np.savez(tmp_path / "many.npz", measurements=rows, untouched=rows[:64])
    files = [str(tmp_path / a) if a.endswith((".npz", ".mcap")) else a for a in arguments]
    code, out = interrupted([sys.executable, str(ROOT / "skin"), *files], RUNS, runtime)
    assert code in codes and "Traceback" not in out and "a fault of this program" not in out, (code, out)


@pytest.mark.parametrize("name", ["stop_on_contact", "guarded_move", "follow_the_finger", "reflex"])
def test_examples(runtime: Path, name: str) -> None:
    command = [sys.executable, "-m", f"examples.{name}", "--max-age", "60"]
    code, out = interrupted(command, RUNS, runtime)
    assert code in LEFT and "Traceback" not in out, (code, out)


@pytest.mark.parametrize("module", ["bench.picture", "bench.tracking.__main__", "models.limits"])
def test_offline_programs(runtime: Path, module: str) -> None:
    if module == "bench.picture":
        needs.PLOTS.here()
    code, out = interrupted([sys.executable, "-m", module], RUNS, runtime)
    assert code in LEFT and "Traceback" not in out, (code, out)


LOADING = """
import models
try:
    raise KeyboardInterrupt
except KeyboardInterrupt as stopped:
    raise ImportError("initialization failed") from stopped
"""


def test_a_compiled_module_that_is_interrupted_while_it_loads_says_so() -> None:
    ended = subprocess.run([sys.executable, "-c", LOADING], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


def test_a_robot_stands_still_however_its_controller_ends(capsys: pytest.CaptureFixture[str]) -> None:
    from examples.robot import Robot

    with pytest.raises(KeyboardInterrupt), Robot() as robot:
        robot.move((0.1, 0.0, 0.0))
        raise KeyboardInterrupt
    assert not any(robot.velocity) and "robot stands" in capsys.readouterr().out
