"""`skin calibrate`: --live from outside, as a stranger's scale says the force; from files of solved presses."""

import contextlib
import itertools
import json
import re
import subprocess
import sys
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models.forward import shared
from models.shapes import Shape
from protocol.control import ControlClient
from protocol.frames import ContactFrame, ReferenceFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader, NewestReader
from services.calibration.reference import ReferenceForce
from tests.conftest import serving
from tests.needs import ROOT
from tests.waiting import WAIT_S, end, until

pytestmark = pytest.mark.live

STIFFER = 1.4  # this skin's foam needs so much more force than the shipped one
SCALE = json.dumps({"scale": STIFFER, "offset": -7.0, "noise": 0.02, "delay_s": 0.03, "drop": 0.1, "silent_s": 0.6})
PUBLISHER = sys.executable, Path(__file__).with_name("reference_publisher.py")
LIGHT, FIRM = (0.5, 2.0), (0.8, 4.5)  # N


class Program:
    def __init__(self, *command: object) -> None:
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(list(map(str, command)), text=True, **pipes)
        self.said: list[str] = []

    def until(self, *texts: str) -> str:
        """The next line with one of the texts; "" at the end."""
        while (line := self.process.stderr.readline()) and not any(text in line for text in texts):
            self.said.append(line)
        assert line or "" in texts, f"it ended without {texts}: {self.said}"
        return line

    def tell(self, **how: object) -> None:
        print(json.dumps(how), file=self.process.stdin, flush=True)

    def press_as_it_asks(self, places) -> str:
        """To its end; gives what it printed."""
        while line := self.until("press one place", "release", ""):
            stub("press", **next(places)) if line.startswith("press one place") else stub("release")
        assert self.process.wait(WAIT_S) == 0, self.said
        return self.process.stdout.read()


@contextlib.contextmanager
def program(*command: object):
    made = Program(*command)
    try:
        yield made
    finally:
        end(made.process)


def stub(command: str, **args: object) -> None:
    ControlClient("stub", WAIT_S).call(command, skin="palm", **args)


def places(rng: np.random.Generator, tip_m: float, newtons: tuple[float, float]):
    while True:
        x, y = rng.uniform(-0.033, 0.033, 2)
        yield {"x": x, "y": y, "radius": tip_m, "force": rng.uniform(*newtons), "seconds": 60.0}


def calibrating(folder: Path, *more: object):
    return program(sys.executable, ROOT / "skin", "calibrate", "--live", "--out", folder / "palm.json", "--json", *more)


def serving_with(folder: Path, more: str = ""):
    (folder / "skin.toml").write_text(f'[skins.palm]\nport = "stub"\nbundle = "square16"\n{more}')
    return serving(folder, "--config", str(folder / "skin.toml"))


TIPS = [({0.01: FIRM}, (20,), 16), ({0.005: LIGHT, 0.012: FIRM}, (10, 30), 12)]


@pytest.mark.release
@pytest.mark.parametrize(("tips", "presses", "others"), TIPS, ids=["percent", "two_tips"])
def test_presses_teach_a_law_that_holds_for_others(runtime: Path, tips, presses, others) -> None:
    """docs/your-skin.md's figures, within six standard errors. While the scale says nothing sure, no press counts."""
    rng, kept, more = np.random.default_rng(7), runtime / "kept.csv", ()
    with serving_with(runtime), program(*PUBLISHER, runtime, SCALE) as sensor:
        for (tip, newtons), most in zip(tips.items(), presses, strict=True):
            sensor.tell(say="nan")
            with calibrating(runtime, "--tip", tip, "--presses", most, "--save", kept, *more) as skin:
                skin.until("found a force of nan N in the reference, expected a number")
                sensor.tell(say=3.0)
                skin.until("press one place")
                stub("press", **next(places(rng, tip, newtons)))
                skin.until("release")
                stub("release")
                assert "this press does not count" in skin.until("does not follow the press")
                sensor.tell(say=None)
                report = json.loads(skin.press_as_it_asks(places(rng, tip, newtons)))
            more = "--csv", kept
    claim = report["error"]["law"]
    assert report["presses"] <= max(presses) and claim < 0.03, report
    with serving_with(runtime, f'calibration = "{runtime}/palm.json"\n'):
        for tip, newtons in tips.items():
            tried = itertools.islice(places(rng, tip, newtons), others)
            print(ratios := [said_over_pressed(press) / STIFFER for press in tried])
            ours = 1.25 * np.std(ratios) / len(ratios) ** 0.5  # standard error of the median that it is held against
            assert np.median(ratios) == pytest.approx(1.0, abs=6 * float(np.hypot(claim, ours)))


def said_over_pressed(press: dict[str, float]) -> float:
    """Said over the shipped foam's force."""
    reader, said, began = NewestReader("contact", "palm"), [], time.monotonic()
    stub("press", **press)
    while (held := time.monotonic() - began) < 1.5 or (not said and held < WAIT_S):
        frame = reader.recv(0.2)
        if isinstance(frame, ContactFrame) and frame.valid and len(frame.contacts) == 1:
            said.append(frame.contacts[0].force_n or 0.0)
    stub("release")
    until(lambda: (frame := reader.recv(1.0)) is not None and not frame.contacts)
    reader.close()
    return said[-1] / press["force"]


def test_the_program_of_the_page_is_a_reference(runtime: Path) -> None:
    """docs/your-skin.md's, as it is printed, in this runtime folder."""
    (code,) = re.findall(r"```python\n(import secrets.*?)```", (ROOT / "docs/your-skin.md").read_text(), re.DOTALL)
    sensor = "import time\ndef your_sensor():\n    while True:\n        time.sleep(0.02)\n        yield 2.5\n"
    reference, reader = ReferenceForce("mine"), AllReader(["reference"], "mine")
    with program(sys.executable, "-c", sensor + code.replace("/tmp/eitskin-1000", str(runtime))):
        for _ in range(3):
            frame = reader.recv(WAIT_S)
            assert isinstance(frame, ReferenceFrame), reader.last_error
            assert (frame.force_n, frame.valid, frame.host) == (2.5, True, host_id())
            reference.take(frame, time.monotonic())
            assert reference.trouble(time.monotonic()) == ""
    reader.close()
    reference.close()


PLACES = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.5)]
LAW = 14.0  # N per S/m: this foam is stiffer than its kind's 10


@cache
def solved():
    model = shared("square16", "stub")
    z0 = np.abs(model.solve(1.0).impedances())
    touches = [Shape("circle", *at, 0.3, drop) for at, drop in zip(PLACES * 2, np.linspace(0.1, 0.5, 12), strict=True)]
    z = [np.abs(model.solve(model.touched([t])).impedances()) for t in touches]
    noise = 1 + 1e-4 * np.random.default_rng(0).standard_normal((64, len(z0)))
    return {"measurements": np.array(z), "untouched": z0 * noise}, [LAW * t.drop for t in touches]


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    arrays, forces = solved()
    np.savez(tmp_path / "presses.npz", **arrays)
    rows = "".join(f"{force:.3f},{k}\n" for k, force in enumerate(forces))
    (tmp_path / "presses.csv").write_text(f"force_n,row\n{rows}")
    (tmp_path / "skin.toml").write_text('[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def calibrated(skin, *more):
    files = "--csv", "presses.csv", "--measurements", "presses.npz"
    return skin("calibrate", "force", *files, "--out", "palm.json", *more)


def test_presses_become_a_law_that_the_skin_uses(skin, workplace, monkeypatch):
    ran = calibrated(skin, "--save", "kept.csv", "--json")
    assert ran.code == 0, ran.err
    report = json.loads(ran.out)
    assert report["presses"] == 12 and report["error"]["left_out_rms"] < 0.12
    assert report["most_n"] == pytest.approx(LAW * 0.5)
    monkeypatch.setattr("services.calibration.live.PATIENCE_S", 0.2)
    ran = skin("calibrate", "--live", "--csv", "kept.csv", "--out", "b.json")  # nothing runs, nobody presses any more
    assert ran.code == 0 and "no image came" in ran.err and "the law is that of the 12 presses until then" in ran.err
    config = workplace / "skin.toml"
    config.write_text(config.read_text() + 'calibration = "palm.json"\n')
    doctor = skin("doctor", "--config", config)
    assert "palm.json:" in doctor.out and "to 7 N" in doctor.out
    ran = skin("reconstruct", "presses.npz", "out.npz", "--skin", "palm", "--age", "0")
    assert ran.code == 0, ran.err
    with np.load(workplace / "out.npz") as out:
        assert out["force"][:, 0] == pytest.approx(solved()[1], rel=0.04)
        assert (out["force_sigma"][:, 0] > 0).all()


@pytest.mark.parametrize("row", ["2,99", "2,1"])
def test_what_is_wrong_with_the_presses_is_one_line(skin, workplace, row):
    (workplace / "presses.csv").write_text(f"force_n,row\n1,0\n{row}\n")
    ran = calibrated(skin)
    says = "line 3, column row: found 99" if row == "2,99" else "2 presses: at least 5"
    assert ran.code == 2 and says in ran.err and not (workplace / "palm.json").exists()
