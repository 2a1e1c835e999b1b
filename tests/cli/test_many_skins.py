"""`port = "stub"` for any skin, any bundle, any name, and several at once: real processes, two skins.

The second skin is the one that skin.toml shows in its comments; $EITSKIN_TRAINED names another bundle to try instead.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.sockets import NewestReader
from services.runtime.config import ConfigError, load
from services.runtime.supervision import programs, stub_arguments

pytestmark = [pytest.mark.live, pytest.mark.release]
ROOT = Path(__file__).resolve().parents[2]


def two_skins() -> str:
    """skin.toml with the second skin of its comments."""
    text = (ROOT / "skin.toml").read_text(encoding="utf-8")
    example = re.search(r"^# \[skins\.sole\]\n(?:# \S+ = .*\n)+", text, re.MULTILINE)
    assert example, "skin.toml shows a second skin in its comments"
    text = text.replace(example[0], example[0].replace("# ", ""))
    trained = os.environ.get("EITSKIN_TRAINED")
    return text.replace('"disc16"', f'"{Path(trained).resolve()}"') if trained else text


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """The runtime folder of a service with two skins, both on the stub."""
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as name:
        folder = Path(name)
        (folder / "two.toml").write_text(two_skins())
        command = [sys.executable, str(ROOT / "skin"), "up", "--config", "two.toml", "--runtime", name]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("EITSKIN_")}
        with open(folder / "log.txt", "wb") as log:
            process = subprocess.Popen(command, cwd=name, stdout=log, stderr=log, env=environment)
        try:
            for name in ("palm", "sole"):
                reader = NewestReader("contact", name, f"ipc://{folder}/publisher.ipc")
                end, taring = time.monotonic() + 120, time.monotonic() + 15
                while (frame := reader.recv(0.5)) is None or not frame.valid:
                    assert time.monotonic() < end and process.poll() is None, (folder / "log.txt").read_text()
                    # A bundle that cannot tell a touch at the start wants one tare: docs/operations.md.
                    if frame is not None and "stale_baseline" in frame.reasons and time.monotonic() > taring:
                        skin(folder, "tare", "--skin", name, check=False)
                        taring = time.monotonic() + 5
                reader.close()
            yield folder
        finally:
            process.terminate()
            process.wait(10)


def skin(folder: Path, *arguments: object, check: bool = True) -> subprocess.CompletedProcess[str]:
    """`skin ... --runtime FOLDER`, in another folder than the configuration's, with nothing said in the environment."""
    command = [sys.executable, str(ROOT / "skin"), *map(str, arguments), "--runtime", str(folder)]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("EITSKIN_")}
    ran = subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=60, env=environment)
    assert "Traceback" not in ran.stderr
    assert not check or ran.returncode == 0, ran.stderr
    return ran


def test_each_skin_feels_its_own_presses(folder: Path) -> None:
    for name, x in (("palm", 0.02), ("sole", -0.01)):
        skin(folder, "press", "--x", x, "--y", 0.01, "--force", 4, "--seconds", 120, "--skin", name)
    for name, x in (("palm", 0.02), ("sole", -0.01)):
        rows = [
            json.loads(line)
            for line in skin(folder, "compare", "--skin", name, "-n", 20, "--seconds", 30, "--json").stdout.splitlines()
        ]
        summary = rows[-1]["summary"]
        assert summary["frames"] == 20 and summary["seen"] >= 15, summary
        assert {row["x"] for row in rows[:-1]} == {x} and summary["position_error_mm"]["median"] < 8
    assert "1 of your presses released" in skin(folder, "release", "--skin", "sole").stdout
    assert json.loads(skin(folder, "release", "--json").stdout)["released"] == 1  # palm, the first, kept its own


def test_scenes_and_faults_are_one_skins(folder: Path) -> None:
    said = skin(folder, "scene", "two", "--skin", "sole").stdout
    assert said.startswith("playing two") and "skin release" in said
    said = skin(folder, "fault", "wrong_chip_id", "--skin", "sole").stdout
    assert "sticky, it does not end by itself: it lasts until `skin fault power_cycle`" in said
    assert json.loads(skin(folder, "fault", "--json").stdout)["faults"] == {}
    listed = skin(folder, "fault", "--skin", "sole").stdout
    assert "in force now: wrong_chip_id" in listed and "(sticky)" in listed
    said = skin(folder, "release", "--skin", "sole").stdout
    assert "scene two ended" in said and "faults that go on: wrong_chip_id" in said
    skin(folder, "fault", "power_cycle", "--skin", "sole")
    end = time.monotonic() + 10
    while json.loads(skin(folder, "fault", "--json", "--skin", "sole").stdout)["faults"]:
        assert time.monotonic() < end, "a power cycle ends what is sticky"


def test_a_mistyped_skin_is_told_which_there_are(folder: Path) -> None:
    for command in (("top", "--once"), ("echo", "contact"), ("compare",), ("tare",)):
        ran = skin(folder, *command, "--skin", "plam", check=False)
        assert ran.returncode == 2 and "no skin 'plam'" in ran.stderr and "palm, sole" in ran.stderr, command
    for command in (("press", "--x", 0, "--y", 0, "--force", 1), ("release",), ("scene", "two"), ("fault", "hang")):
        ran = skin(folder, *command, "--skin", "plam", check=False)
        assert ran.returncode == 1 and "expected one of palm, sole" in ran.stderr, command


def test_echo_and_compare_call_a_frame_by_the_same_number(folder: Path) -> None:
    echo = subprocess.Popen(
        [sys.executable, str(ROOT / "skin"), "echo", "contact", "--timeout", "60", "--runtime", str(folder)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert echo.stdout is not None and re.search(r"scan +\d+", echo.stdout.readline())  # it listens
    skin(folder, "press", "--x", 0.01, "--y", 0.01, "--force", 3, "--seconds", 60)
    rows = skin(folder, "compare", "-n", 5, "--json").stdout.splitlines()
    skin(folder, "release")
    echo.terminate()
    compared = {row["scan"] for row in map(json.loads, rows) if "scan" in row}
    shown = {int(n) for n in re.findall(r"scan +(\d+)", echo.communicate(timeout=60)[0])}
    assert len(compared) == 5 and compared <= shown


def test_the_doctor_looks_at_what_the_service_runs(folder: Path) -> None:
    found = json.loads(skin(folder, "doctor", "--json", check=False).stdout)
    levels: dict[str, set[str]] = {}
    for finding in found:
        levels.setdefault(finding["what"], set()).add(finding["level"])
    assert {"palm: acquisition", "sole: publisher", "palm: baseline", "sole: baseline"} <= set(levels)
    assert str(folder / "two.toml") in found[0]["text"] and not any({"OK", "FAIL"} <= v for v in levels.values())
    other = skin(folder, "doctor", "--config", str(ROOT / "skin.toml"), check=False).stdout
    assert f"the service runs {folder / 'two.toml'}" in other and "FAIL" not in other


def test_the_doctor_names_a_bundle_and_a_calibration_changed_since(folder: Path) -> None:
    config = folder / "two.toml"
    before = config.read_text()
    (folder / "palm.json").write_text('{"newtons_per_siemens": 8.5}')
    changed = before.replace('bundle = "square16"', 'bundle = "disc16"\ncalibration = "palm.json"')
    (folder / "changed.toml").write_text(changed)
    elsewhere = skin(folder, "doctor", "--config", str(folder / "changed.toml"), check=False)
    assert f"the service runs {config}" in elsewhere.stdout and "restart the service:" not in elsewhere.stdout
    assert "FAIL" not in elsewhere.stdout and re.search(r"SKIP +palm: contacts", elsewhere.stdout)
    config.write_text(changed)
    try:
        said = skin(folder, "doctor", check=False)
    finally:
        config.write_text(before)
    assert said.returncode == 1
    assert re.search(r"FAIL +palm: runs +bundle square16 \(\w{12}\), not disc16 \(\w{12}\): restart", said.stdout)
    assert re.search(r"FAIL +palm: runs +calibration no calibration, expected .*palm.json", said.stdout)


def test_the_doctor_never_calls_a_port_both_well_and_ill(folder: Path) -> None:
    """Unplugged while the service runs: the port and acquisition are both a failure."""
    skin(folder, "fault", "unplug", "--seconds", 120)
    time.sleep(1.0)
    found = json.loads(skin(folder, "doctor", "--json", check=False).stdout)
    levels = {f["what"]: f["level"] for f in found}
    assert levels["palm: port"] == levels["palm: acquisition"] == "FAIL", found
    assert levels["sole: port"] == levels["sole: acquisition"] == "OK"
    skin(folder, "fault", "--clear")


def test_the_supervisor_gives_each_skin_its_bundle(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "manifest.json").write_text("{}")
    (tmp_path / "skin.toml").write_text(
        '[skins.a]\nport = "stub"\nbundle = "disc16"\n[skins.b]\nport = "/dev/ttyACM0"\nbundle = "square16"\n'
        '[skins.c]\nport = "stub"\nbundle = "mine"\n'
    )
    config = load(tmp_path / "skin.toml")
    told = stub_arguments(config)
    assert told == ("--skin", f"a={ROOT / 'models/bundles/disc16'}", "--skin", f"c={tmp_path / 'mine'}")
    assert [p.arguments for p in programs(config) if p.name == "stub"] == [told]


def test_the_supervisor_tells_the_stub_by_what_a_sheet_differs_from_its_bundle(tmp_path: Path) -> None:
    file = tmp_path / "skin.toml"
    file.write_text('[skins.a]\nport = "stub"\nbundle = "disc16"\n[skins.b]\nport = "stub"\nbundle = "disc16"\n')
    assert "--mismatch" not in stub_arguments(load(file))
    file.write_text(file.read_text() + 'mismatch = "mild"\n')
    assert stub_arguments(load(file))[-2:] == ("--mismatch", "b=mild")
    file.write_text(file.read_text().replace('mismatch = "mild"', 'world = "creep"'))
    assert stub_arguments(load(file))[-2:] == ("--world", "b=creep")
    file.write_text(file.read_text() + 'mismatch = "mild"\n')
    with pytest.raises(ConfigError, match="a world has a sheet of its own"):
        load(file)
    file.write_text('[skins.a]\nport = "/dev/ttyACM0"\nbundle = "disc16"\nworld = "creep"\n')
    with pytest.raises(ConfigError, match="a real skin is in its own"):
        load(file)
    file.write_text('[skins.a]\nport = "/dev/ttyACM0"\nbundle = "disc16"\nmismatch = "mild"\n')
    with pytest.raises(ConfigError, match='port = "stub" alone: a real skin has its own'):
        load(file)
