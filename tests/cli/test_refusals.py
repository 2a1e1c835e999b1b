"""Requests that cannot be met: one line that says why, the exit status, nothing made. `skin new`: a skin in one."""

import errno
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zmq

from firmware_stub.rig import Rig
from models import geometry
from protocol.runtime import CONFIG_LINK
from services.cli import board
from services.cli.common import ROOT, CliError
from services.runtime import room

DRAWING = """<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">
<path d="M 0 0 L 50 0 L 50 50 L 100 50 L 100 100 L 0 100 Z M 10 70 L 20 80"/><circle cx="20" cy="80" r="3"/></svg>"""


def test_a_disc_and_a_drawing(skin, tmp_path):
    """An L, by a path of several lines of which one is closed."""
    ran = skin("new", "my-skin", "--disc", 0.06, "--electrodes", 12, "--out", tmp_path, "--json")
    said = json.loads(ran.out)
    assert ran.code == 0 and (said["electrodes"], said["measurements"], said["size_mm"]) == (12, 66, [60, 60])
    assert geometry.load(tmp_path / "my-skin.toml").metres_per_unit == pytest.approx(0.03)
    again = skin("new", "my-skin", "--disc", 0.06, "--out", tmp_path)
    assert again.code == 2 and "is there already: choose another name, or give --overwrite" in again.err
    (tmp_path / "ell.svg").write_text(DRAWING)
    ran = skin("new", "ell", "--outline", tmp_path / "ell.svg", "--first", 0.0125, "--out", tmp_path)
    assert ran.code == 0 and "a polygon of 6 corners, 100 x 100 mm, 16 electrodes 7.5 mm wide" in ran.out, ran.err
    assert "1 closed lines inside the outline were left out" in ran.out
    corner = geometry.load(tmp_path / "ell.toml").inside([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5]])
    assert corner.tolist() == [False, True, True]


@pytest.mark.parametrize(("words", "message"), [
    ("mine --disc 60", "found 60 m x 60 m, expected a longer side of 0.005 to 3 m: --disc takes metres"),
    ("mine --disc 0.06 --electrodes 3", "--electrodes 3 electrodes: expected 4 to 64"),
    (
        "mine --disc 0.12 --electrodes 32 --pattern adjacent",
        r"'adjacent' are 928 measurements, at most 512 .* 'pairs' \(496\) or at most 24 electrodes with 'adjacent'",
    ),
    ("mine --disc 0.12 --electrodes 33", "are 528 measurements, at most 512 .* choose at most 32 electrodes with"),
    ("mine", "give either --disc METRES .* or --outline FILE"),
    ("My_Skin --disc 0.06", "found the name 'My_Skin', expected lower-case letters"),
])  # fmt: skip
def test_what_cannot_be(skin, tmp_path, words, message):
    ran = skin("new", *words.split(), "--out", tmp_path)
    assert ran.code == 2 and not list(tmp_path.iterdir()) and re.search(message, ran.err), ran.err


K = 120
STUB = '[skins.palm]\nport = "stub"\nbundle = "square16"\n'
PRESS_AND_WATCH = "press --x 0 --y 0 --force 1", "tare", "echo contact --timeout 0.1", "compare --seconds 0.1"
TALKERS = (*PRESS_AND_WATCH, "record file.mcap --seconds 0.1", "doctor", "calibrate force")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(ran, code: int, says: str) -> None:
    assert ran.code == code and says in ran.err and not ran.out, (ran.code, ran.err, ran.out)


@pytest.mark.parametrize(("words", "code", "says"), [
    ("press --x 0 --y 0 --force 1 --to-x 0.01", 2, "both --to-x and --to-y"),
    ("compare --seconds -3", 2, "'--seconds'"),
    ("fault electrode_open electrode", 2, "expected key=value"),
    ("top", 2, "the output is no terminal, expected one to draw on: give --once"),
    ("snapshot", 3, "recorder does not run here"),
    ("record /nowhere/x.mcap", 2, "cannot write /nowhere/x.mcap"),
    ("replay a.mcap --from inf", 2, "--from: found inf, expected a finite number"),
    ("golden text.txt", 2, "text.txt is no recording: expected FILE.mcap"),
    ("limits --radius 0.06", 2, "no touch of radius 60 mm fits on skin 'square16'"),
    ("bench acuracy", 2, "accuracy"),
    ("up --config bad.toml", 2, "bad.toml: is not TOML"),
    ("up --config port.toml", 2, "skins.palm.port"),
    ("up --config bundle.toml", 2, "skins.palm.bundle: no bundle 'no-such': shipped are"),
    ("up --config forces.toml", 2, "forces.json"),
    ("collect presses.npz --stub 3 --config real.toml", 2, "palm has '/dev/ttyACM9': leave it out"),
])  # fmt: skip
def test_mistakes_are_answered(skin, folder: Path, words: str, code: int, says: str) -> None:
    files = {
        "bad.toml": "[skins.palm\n",
        "port.toml": "[skins.palm]\nport = 5\n",
        "bundle.toml": STUB.replace("square16", "no-such"),
        "forces.toml": f'{STUB}calibration = "forces.json"\n',
        "real.toml": STUB.replace("stub", "/dev/ttyACM9"),
        "text.txt": "Hello\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    refused(skin(*words.split()), code, says)
    assert {path.name for path in folder.iterdir()} == {*files}


def test_a_service_that_is_not_there_is_named(skin, folder: Path, runtime: Path) -> None:
    """By the folder and the configuration that were given, alike in each command, and at once."""
    (other := runtime / "other").mkdir(mode=0o700)  # its path is short enough for sockets
    (folder / "mine.toml").write_text(STUB.replace("palm", "sole"))
    for command in map(str.split, TALKERS):
        refused(skin(*command, "--runtime", folder / "nowhere"), 2, f"no folder {folder / 'nowhere'}")
        ran = skin(*command, "--config", folder / "none.toml")
        assert ran.code == 2 and "none.toml" in ran.err and "expected a configuration" in ran.err, command
    for command in map(str.split, PRESS_AND_WATCH):
        refused(skin(*command), 3, "skin up")
        ran = skin(*command, "--runtime", other, "--config", folder / "mine.toml")
        refused(ran, 3, str(other))
    runtime.chmod(0o755)  # others could forge contacts there
    refused(skin("press", "--x", 0, "--y", 0, "--force", 1), 2, "chmod 700")


def test_the_running_services_configuration_is_the_default(skin, runtime: Path, folder: Path, monkeypatch) -> None:
    monkeypatch.delenv("EITSKIN_CONFIG", raising=False)
    (folder / "mine.toml").write_text(STUB.replace("palm", "sole"))
    (runtime / CONFIG_LINK).symlink_to(folder / "mine.toml")
    refused(skin("echo", "contact", "--timeout", 0.1), 3, "contact/sole")
    refused(skin("echo", "contact", "--skin", "palm", "--timeout", 0.1), 2, "no skin 'palm'")


ROWS, UNTOUCHED = {"measurements": np.ones((2, K))}, {"untouched": np.ones((8, K))}
GOOD = ROWS | UNTOUCHED
PRESSES = {"touched": np.ones((25, 192)), "untouched": np.ones((25, 192)), "xy": np.zeros((25, 2))}
OTHER = np.ones((2, 192))
OTHER_PATTERN = {"touched": OTHER, "untouched": OTHER, "pattern": np.array([[0, 1, 2, 3]] * 192)}
RECONSTRUCT = "reconstruct in.npz out --skin square16 --no-calibrate"
REGISTER = "register in.npz --skin disc16 --out out"


@pytest.mark.parametrize(("command", "arrays", "says"), [
    (RECONSTRUCT, {"pressures": np.ones((2, K)), "weights": np.ones((2, K))}, "no array `measurements`"),
    (RECONSTRUCT, ROWS, "found neither"),
    (RECONSTRUCT, {**GOOD, "reference": np.ones((2, K))}, "found both"),
    (RECONSTRUCT, {**GOOD, "measurements": np.ones((2, 119))}, "expected numbers of shape (n, 120)"),
    (RECONSTRUCT, {**ROWS, "reference": np.ones((3, K))}, "expected one each"),
    (RECONSTRUCT, {**ROWS, "untouched": np.zeros((8, K))}, "in 0 of 120 columns, expected at least 60"),
    (RECONSTRUCT, {**ROWS, "untouched": [[np.nan] * 100 + [1.0] * 20] * 8}, "in 20 of 120 columns"),
    (REGISTER, PRESSES | {"touched": np.array(3.0)}, "`touched` is float64 of shape ()"),
    ("import in.npz out --skin disc16", OTHER_PATTERN, "`pattern` has 192 rows, and lacks"),
])  # fmt: skip
def test_arrays_that_are_none_of_a_skin(skin, folder: Path, command: str, arrays, says: str) -> None:
    np.savez(folder / "in.npz", **arrays)
    words = command.replace(" out", " out.mcap" if command.startswith("import") else " out.npz", 1)
    refused(ran := skin(*words.split()), 2, says)
    assert len(ran.err.splitlines()) == 1 and len(list(folder.iterdir())) == 1


def test_values_out_of_range_cost_their_row_and_a_bundle_needs_no_configuration(skin, folder, monkeypatch) -> None:
    (folder / "skin.toml").write_text("[skins.palm\n")
    monkeypatch.setenv("EITSKIN_CONFIG", str(folder / "skin.toml"))
    rng = np.random.default_rng(0)
    rows, untouched = rng.uniform(1, 2, (4, K)), 1 + 1e-4 * rng.standard_normal((3, K))
    rows[0], rows[1], rows[2, :3] = np.nan, 1e300, np.inf
    untouched[:, :5], untouched[0, 7] = np.nan, np.inf
    np.savez(folder / "in.npz", measurements=rows, untouched=untouched)
    ran = skin("reconstruct", "in.npz", "out.npz", "--skin", "palm")
    assert ran.code == 2 and "no bundle 'palm'" in ran.err and "skin.toml: is not TOML" in ran.err
    ran = skin(*RECONSTRUCT.replace("out", "out.npz").split())
    assert ran.code == 0 and "Warning" not in ran.err, ran.err
    with np.load(folder / "out.npz") as out:
        assert not out["valid"][:2].any() and np.isfinite(out["image"]).all()


LIMITS = {"-n 64": "of 64 open files, needed 112", "-v 300000": "of 292 MB of memory, needed 500 MB"}


@pytest.mark.live
@pytest.mark.parametrize(("limit", "says"), LIMITS.items())
def test_little_room_is_said_before_anything_starts(folder: Path, runtime: Path, limit: str, says: str) -> None:
    (folder / "mine.toml").write_text(STUB)
    words = [sys.executable, ROOT / "skin", "up", "--config", "mine.toml"]
    ran = subprocess.run(["bash", "-c", f'ulimit {limit}; exec "$@"', "", *words], capture_output=True, text=True)
    assert ran.returncode == 1 and says in ran.stderr and len(ran.stderr.splitlines()) == 1, ran.stderr
    assert f"ulimit {limit[:2]}" in ran.stderr and not ran.stdout


def test_a_full_disk_and_other_lacks_are_said(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(room.os, "statvfs", lambda folder: SimpleNamespace(f_bavail=1, f_frsize=4096))
    assert [f"{tmp_path} has 4096 bytes free" in each for each in room.lacking(1, 1, tmp_path)] == [True]
    full, many = room.sentence(OSError(errno.ENOSPC, "", "a.npz")), room.sentence(zmq.ZMQError(errno.EMFILE))
    assert full.startswith("a.npz: no room on the disk") and "ulimit -n" in many and not room.sentence(ValueError())


TOUCHED, EARLY = "the skin is touched: free it and try again", "only 60 of 64 untouched frames: wait and try again"


@pytest.mark.parametrize(
    ("said", "wait_s", "left"), [([EARLY] * 2, 10.0, 0), ([TOUCHED] * 2, 10.0, 1), ([EARLY] * 100, 1e-300, 99)]
)
def test_a_tare_waits_for_frames_alone_and_not_for_ever(skin, monkeypatch, said, wait_s, left) -> None:
    """Not for a hand to go."""
    refusals = list(said)

    def control(*_, **__):
        if refusals:
            raise CliError(refusals.pop(0))
        return {"frames": 64, "snr_db": 80.0}

    monkeypatch.setattr(board, "control", control)
    ran = skin("tare", "--wait", wait_s)
    assert len(refusals) == left and (said[0] in ran.err if left else "from 64 frames, 80.0 dB" in ran.out)


def test_what_the_stub_answers_to_faults_and_releases() -> None:
    rig = Rig(seed=1)
    rig.play("two", 0.0)
    rig.press({"x": 0.01, "y": 0.0, "force": 2.0}, 5.0)
    rig.fault("brown_out", {}, 5.0)
    expected = {"released": 1, "scene_ended": "two", "faults": {"brown_out": {"silent": False}}}
    assert rig.release(5.5) == expected and rig.status(6.0)["touches"] == 0
    hang = rig.fault("hang", {}, 10.0, 2.0)
    assert (hang["sticky"], hang["seconds"]) == (False, 2.0) and rig.fault("wrong_chip_id", {}, 10.0)["sticky"] is True
