"""`skin calibrate --live` from outside: the stub is pressed as the command asks, a stranger's scale says the force."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.control import ControlClient
from protocol.frames import ContactFrame, ReferenceFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader, NewestReader
from services.calibration.reference import ReferenceForce
from tests.conftest import serving

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
PUBLISHER = Path(__file__).with_name("reference_publisher.py")
STIFFER = 1.4  # this skin's foam needs so much more force than the shipped one
SCALE = {"scale": STIFFER, "offset": -7.0, "noise": 0.02, "delay_s": 0.03, "drop": 0.1, "silent_s": 0.6}
TIP_M = 0.01
PATIENCE_S = 240


class Program:
    """A program whose lines are read as they come."""

    def __init__(self, *command: object, **environment: str) -> None:
        self.process = subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )
        self.lines: queue.Queue[str] = queue.Queue()
        self.said: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line)
            self.lines.put(line)
        self.lines.put("")

    def line(self) -> str:
        """The next one; "" at the end."""
        return self.lines.get(timeout=PATIENCE_S)

    def until(self, text: str) -> str:
        while text not in (line := self.line()):
            assert line, f"it ended without {text!r}: {self.said}"
        return line

    def tell(self, **how: Any) -> None:
        assert self.process.stdin is not None
        print(json.dumps(how), file=self.process.stdin, flush=True)

    def close(self) -> str:
        self.process.terminate()
        out, _ = self.process.communicate(timeout=30)
        return out


@contextlib.contextmanager
def program(*command: object) -> Iterator[Program]:
    made = Program(*command)
    try:
        yield made
    finally:
        if made.process.poll() is None:
            made.process.kill()
        made.process.wait(30)


def stub(command: str, **args: Any) -> None:
    ControlClient("stub", 10.0).call(command, skin="palm", **args)


def place(rng: np.random.Generator, tip: float = TIP_M, newtons: tuple[float, float] = (0.8, 4.5)) -> dict[str, float]:
    x, y = rng.uniform(-0.033, 0.033, 2)
    return {"x": x, "y": y, "radius": tip, "force": rng.uniform(*newtons), "seconds": 60.0}


def calibrating(folder: Path, *more: object) -> contextlib.AbstractContextManager[Program]:
    command = sys.executable, ROOT / "skin", "calibrate", "--live", "--out", folder / "palm.json", "--json", *more
    return program(*command)


def config(folder: Path, more: str = "") -> Path:
    path = folder / "skin.toml"
    path.write_text(f'[skins.palm]\nport = "stub"\nbundle = "square16"\n{more}')
    return path


@pytest.mark.release
def test_twenty_presses_teach_the_law_to_three_percent(runtime: Path) -> None:
    rng = np.random.default_rng(7)
    with (
        serving(runtime, "--config", str(config(runtime))),
        program(sys.executable, PUBLISHER, runtime, json.dumps(SCALE)),
        calibrating(runtime, "--presses", 20, "--tip", TIP_M) as skin,
    ):
        while line := skin.line():
            if line.startswith("press one place"):
                stub("press", **place(rng))
            elif line.startswith("release"):
                stub("release")
        out, _ = skin.process.communicate(timeout=30)
        print("".join(skin.said), out)
        assert skin.process.returncode == 0
        print("".join(skin.said), out)
    report = json.loads(out)
    assert report["presses"] <= 20 and report["error"]["law"] < 0.03
    with serving(runtime, "--config", str(config(runtime, f'calibration = "{runtime}/palm.json"\n'))):
        ratios = [said / STIFFER for said in said_over_pressed(rng, 16)]
    print(ratios)
    assert float(np.median(ratios)) == pytest.approx(1.0, abs=0.03)


TIPS = {0.005: (0.5, 2.0), 0.012: (0.8, 4.5)}  # m: newtons


@pytest.mark.release
def test_presses_of_two_tips_teach_a_law_that_covers_both(runtime: Path) -> None:
    """The second run goes on from the presses of the first and ends by itself; what it claims is one standard error, of
    which three are allowed: by two, one run of ten would fail by chance.
    """
    rng, kept, more = (
        np.random.default_rng(11),
        runtime / "small.csv",
        ["--presses", 10, "--save", runtime / "small.csv"],
    )
    with (
        serving(runtime, "--config", str(config(runtime))),
        program(sys.executable, PUBLISHER, runtime, json.dumps(SCALE)),
    ):
        for tip, newtons in TIPS.items():
            with calibrating(runtime, "--tip", tip, *more) as skin:
                while line := skin.line():
                    if line.startswith("press one place"):
                        stub("press", **place(rng, tip, newtons))
                    elif line.startswith("release"):
                        stub("release")
                out, _ = skin.process.communicate(timeout=30)
                assert skin.process.returncode == 0, skin.said
            more = ["--csv", kept, "--presses", 30]
    report = json.loads(out)
    claim = report["error"]["law"]
    assert report["presses"] >= 20 and claim < 0.03, report
    with serving(runtime, "--config", str(config(runtime, f'calibration = "{runtime}/palm.json"\n'))):
        for tip, newtons in TIPS.items():
            ratios = [said / STIFFER for said in said_over_pressed(rng, 12, tip, newtons)]
            print(tip, claim, report["presses"], ratios)
            ours = 1.25 * np.std(ratios) / len(ratios) ** 0.5  # standard error of the median that it is held against
            assert float(np.median(ratios)) == pytest.approx(1.0, abs=3 * float(np.hypot(claim, ours)))


def said_over_pressed(
    rng: np.random.Generator, presses: int, tip: float = TIP_M, newtons: tuple[float, float] = (0.8, 4.5)
) -> Iterator[float]:
    """Said over the shipped foam's force, of presses at other places."""
    reader = NewestReader("contact", "palm")
    for _ in range(presses):
        pressed = place(rng, tip, newtons)
        stub("press", **pressed)
        begun, said, seen = time.monotonic(), [], set()
        while (held := time.monotonic() - begun) < 1.5 or (not said and held < 10):
            frame = reader.recv(0.2)
            if isinstance(frame, ContactFrame) and frame.valid and len(frame.contacts) == 1:
                said.append(frame.contacts[0].force_n or 0.0)
            elif isinstance(frame, ContactFrame):
                seen.add((frame.valid, len(frame.contacts), *frame.reasons))
        stub("release")
        time.sleep(0.5)
        assert said, (pressed, seen)
        yield said[-1] / pressed["force"]
    reader.close()


@pytest.mark.release
def test_a_reference_that_says_nothing_sure_makes_no_press(runtime: Path) -> None:
    """Each is told, none is a press; once it is mended the next press counts."""
    press = {"x": 0.02, "y": -0.01, "radius": 0.01, "force": 2.0, "seconds": 60.0}
    with (
        serving(runtime, "--config", str(config(runtime))),
        calibrating(runtime, "--presses", 1, "--tip", 0.01, "--save", runtime / "kept.csv") as skin,
    ):
        skin.until("no message of reference/palm has come")
        with program(sys.executable, PUBLISHER, runtime, json.dumps({"say": "nan"})) as scale:
            skin.until("found a force of nan N in the reference, expected a number")
            scale.tell(say=None, late_s=0.8)
            skin.until("after its stamp `sample`, expected 0.5 s at most")
            scale.tell(late_s=0.0, silent_s=10.0)
            skin.until("the reference has been silent")
            for wrong, why in (
                ({"silent_s": 0.0, "turn": -1}, "the reference fell while the skin was pressed"),
                ({"turn": 1, "delay_s": 0.8, "late_s": 0.0}, "s late, expected 0.5 s at most"),
                ({"delay_s": 0.0, "say": 3.0}, "does not follow the press"),
            ):
                scale.tell(**wrong)
                skin.until("press one place")
                stub("press", **press)
                skin.until("release")
                stub("release")
                assert "this press does not count" in skin.until(why)
            scale.tell(say=None)
            skin.until("press one place")
            stub("press", **press)
            skin.until("release")
            stub("release")
            assert skin.until(" N at (").startswith("  1: 2.0")
        assert skin.process.wait(30) == 2
        assert "1 presses: at least 5 are needed" in skin.until("presses: ") + "".join(skin.said)
    assert not (runtime / "palm.json").exists()
    kept = (runtime / "kept.csv").read_text().splitlines()
    assert len(kept) == 2 and kept[1].startswith("2.0") and kept[1].endswith(",0.01")


def test_the_program_of_the_page_is_a_reference(runtime: Path) -> None:
    """docs/your-skin.md's, as it is printed, in this runtime folder."""
    text = (ROOT / "docs" / "your-skin.md").read_text()
    code = re.search(r"```python\n(import secrets.*?)```", text, re.DOTALL)
    assert code is not None
    ours = code[1].replace("/tmp/eitskin-1000", str(runtime))
    sensor = "import time\ndef your_sensor():\n    while True:\n        time.sleep(0.02)\n        yield 2.5\n"
    reference, reader = ReferenceForce("mine"), AllReader(["reference"], "mine")
    with program(sys.executable, "-c", sensor + ours):
        for _ in range(3):
            frame = reader.recv(30.0)
            assert isinstance(frame, ReferenceFrame), reader.last_error
            assert (frame.force_n, frame.valid, frame.host) == (2.5, True, host_id())
            reference.take(frame, time.monotonic())
            assert reference.trouble(time.monotonic()) == ""
    reader.close()
    reference.close()
