"""What somebody meets who mistypes: what was found, what is expected, what to do; never a traceback."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from firmware_stub.faults import FAULTS
from firmware_stub.rig import Rig
from protocol.runtime import CONFIG_LINK
from services.cli.common import of_service
from services.recordings.replay import ReplayError, steps
from tests.cli.talkers import PRESS_AND_WATCH, TALKERS

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("command", TALKERS, ids=lambda c: c[0])
def test_each_says_alike_which_service_it_cannot_find(skin, tmp_path, command) -> None:  # type: ignore[no-untyped-def]
    nowhere = tmp_path / "nowhere"
    ran = skin(*command, "--runtime", nowhere)
    assert ran.code == 2 and f"no folder {nowhere}" in ran.err and not nowhere.exists()
    ran = skin(*command, "--config", tmp_path / "none.toml")
    assert ran.code == 2 and "none.toml" in ran.err and "expected a configuration" in ran.err


@pytest.mark.parametrize("command", PRESS_AND_WATCH, ids=lambda c: c[0])
def test_runtime_and_config_name_the_service(skin, tmp_path, monkeypatch, command) -> None:  # type: ignore[no-untyped-def]
    other = tmp_path / "other"
    other.mkdir(mode=0o700)
    (tmp_path / "mine.toml").write_text('[skins.sole]\nport = "stub"\nbundle = "square16"\n')
    monkeypatch.setenv("EITSKIN_CONFIG", "")
    ran = skin(*command, "--runtime", other, "--config", tmp_path / "mine.toml")
    assert ran.code in (2, 3) and "Traceback" not in ran.err
    assert str(other) in ran.err


def test_the_running_services_configuration_is_the_default(skin, runtime, tmp_path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.delenv("EITSKIN_CONFIG", raising=False)
    mine = tmp_path / "mine.toml"
    mine.write_text('[skins.sole]\nport = "stub"\nbundle = "square16"\n')
    (runtime / CONFIG_LINK).symlink_to(mine)
    ran = skin("echo", "contact", "--timeout", 0.1)
    assert ran.code == 3 and "contact/sole" in ran.err
    ran = skin("echo", "contact", "--skin", "palm", "--timeout", 0.1)
    assert ran.code == 2 and f"no skin 'palm': {mine} has sole" in ran.err


def test_a_configuration_that_is_no_toml_is_named(skin, runtime, tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "bad.toml").write_text("[skins.palm\n")
    for command in (("top", "--once"), ("echo", "contact"), ("compare",), ("up",)):
        ran = skin(*command, "--config", tmp_path / "bad.toml")
        assert ran.code == 2 and "bad.toml: is not TOML" in ran.err, command


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("ech",), "ech"),
        (("press",), "--x"),
        (("press", "--x", "left", "--y", 0, "--force", 1), "'--x': Input should be a valid number"),
        (("echo",), "Missing argument 'topic'"),
        (("echo", "contact/palm/x", "--timeout", 0.1), "no frame of"),
        (("compare", "--seconds", "soon"), "'--seconds': Input should be"),
        (("replay", "nothing.mcap"), "nothing.mcap"),
        (("import", "nothing.npz", "out.mcap"), "nothing.npz"),
        (("reconstruct", "nothing.npz", "out.npz", "--skin", "square16"), "nothing.npz"),
        (("register", "nothing.npz"), "nothing.npz"),
        (("reconstruct", "touch.mcap", "out.npz", "--skin", "square16"), "`skin replay touch.mcap --fast"),
        (("reconstruct", "touch.mcap"), "`skin replay touch.mcap --fast"),
        (("golden", "nothing.mcap"), "no file nothing.mcap: expected a recording"),
        (("golden", __file__), "test_newcomers_mistakes.py is no recording: expected FILE.mcap"),
        (("top",), "the output is no terminal, expected one to draw on: give --once"),
        (("record", "a.mcap", "--seconds", -1), "'--seconds'"),
        (("compare", "--seconds", -3), "'--seconds'"),
        (("replay", "a.mcap", "--from", "inf"), "--from: found inf, expected a finite number"),
        (("limits", "--snr", -5), "--snr: found '-5', expected a finite number above 0, or inf"),
        (("limits", "--radius", 0.06), "no touch of radius 60 mm fits on skin 'square16'"),
        (("calibrate", "force", "--csv", "nothing.csv"), "nothing.csv"),
        (("bench", "acuracy"), "accuracy"),
        (("limits", "--skin", "hexagon"), "hexagon"),
        (("doctor", "--config", "nothing.toml"), "nothing.toml"),
        (("up", "--config", "nothing.toml"), "nothing.toml"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_mistakes_are_answered(skin, tmp_path, monkeypatch, arguments, says) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    ran = skin(*arguments)
    assert ran.code not in (0, 130) and says in ran.err, ran.err


def test_options_are_added_and_taken_away_again() -> None:
    seen = []

    def command(number: int, word: str = "a") -> None:
        seen.append((number, word))

    of_service(command)(3, word="b", config=None, runtime=None)
    assert seen == [(3, "b")]


def test_the_table_of_commands_counts_the_faults() -> None:
    ones = ("", "-one", "-two", "-three", "-four", "-five", "-six", "-seven", "-eight", "-nine")
    words = {20 + k: f"twenty{one}" for k, one in enumerate(ones)}
    commands = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    assert f"{words[len(FAULTS)]} faults" in commands
    table = (ROOT / "firmware_stub" / "README.md").read_text(encoding="utf-8")
    for name, row in FAULTS.items():
        assert f"| `{name}`{' (sticky)' if row.sticky else ''} |" in table


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(seed=1)


@pytest.mark.parametrize("electrode", ["left", 16, -1, 3.5])
def test_a_wrong_electrode_is_called_as_it_was_typed(rig: Rig, electrode: object) -> None:
    """Not np.str_('left')."""
    with pytest.raises(ValueError) as said:
        rig.fault("electrode_open", {"electrode": electrode}, 0.0)
    assert str(said.value) == f"fault electrode_open: electrode {electrode!r}, expected 0 to 15"


def test_release_ends_the_scene_and_says_what_goes_on(rig: Rig) -> None:
    rig.play("two", 0.0)
    rig.press({"x": 0.01, "y": 0.0, "force": 2.0}, 5.0)
    rig.fault("brown_out", {}, 5.0)
    answer = rig.release(5.5)
    assert answer == {"released": 1, "scene_ended": "two", "faults": {"brown_out": {"silent": False}}}
    assert rig.status(6.0)["touches"] == 0
    assert rig.release(6.0)["scene_ended"] is None


def test_a_fault_says_whether_it_is_sticky(rig: Rig) -> None:
    assert rig.fault("wrong_chip_id", {}, 10.0)["sticky"] is True
    assert rig.fault("hang", {}, 10.0, 2.0) | {"sticky": False, "seconds": 2.0} == rig.fault("hang", {}, 10.0, 2.0)


def test_from_beyond_the_end_says_how_long_the_recording_is(tmp_path: Path) -> None:
    from services.recordings.importing import import_arrays
    from services.recordings.recording import RecordingReader

    rows = np.random.default_rng(0).uniform(1, 2, (40, 120))
    import_arrays({"measurements": rows, "untouched": rows}, Path("x"), tmp_path / "a.mcap", "square16", 10.0)
    reader = RecordingReader(tmp_path / "a.mcap")
    assert len(list(steps(reader, 7.0))) == 10
    with pytest.raises(ReplayError, match=r"found --from 9, but .*a.mcap is only 7.9 s long"):
        list(steps(reader, 9.0))


WITHOUT = """
import importlib.abc, importlib.metadata, runpy, sys
class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {hidden}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
found = importlib.metadata.distribution
def distribution(name):
    if name in {hidden}:
        raise importlib.metadata.PackageNotFoundError(name)
    return found(name)
importlib.metadata.distribution = distribution
sys.argv = {arguments}
if {module!r}:
    runpy.run_module({module!r}, run_name="__main__", alter_sys=True)
else:
    runpy.run_path("skin", run_name="__main__")
"""
OFFLINE = ("matplotlib", "torch", "pyeit", "joblib", "onnx", "dask", "zenoh")


@pytest.mark.parametrize(
    ("module", "arguments", "package", "extra"),
    [
        ("bench.picture", ["bench.picture"], "matplotlib", "plots"),
        ("models.build", ["models.build"], "(torch|onnx|joblib)", "train"),
        ("models.average", ["models.average"], "torch", "train"),
        ("", ["skin", "bench", "accuracy"], "pyeit", "peers"),
        ("", ["skin", "info", "tests/recording/golden/faults.mcap", "--png", "/nowhere/a.png"], "matplotlib", "plots"),
    ],
)
def test_what_make_up_does_not_install_is_named(module: str, arguments: list[str], package: str, extra: str) -> None:
    program = WITHOUT.format(hidden=OFFLINE, arguments=arguments, module=module)
    ran = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ran.returncode in (1, 2) and len(ran.stderr.splitlines()) == 1, ran.stderr
    assert re.search(f"needs the Python package '{package}'.*`make venv EXTRAS={extra}`", ran.stderr), ran.stderr
