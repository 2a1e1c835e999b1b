"""docs/your-skin.md, word by word: every command in its order, in a copy of the checkout, as somebody who follows it.

All of it is slow (-m slow): once without training (no network in the bundle), with few presses, without registering;
once with those. Quick, and in one process: tests/services/test_other_skins.py.
"""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.frames import ContactFrame
from protocol.sockets import NewestReader
from tests import needs
from tests.docs.snippets import FENCE, ROOT
from tests.docs.world import START_S, Ran, World, world

pytestmark = pytest.mark.live

PAGE = "docs/your-skin.md"
SKIN_UP = "./skin up --config mine.toml"
GLOVE = """<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">
<path d="M 0 0 H 50 V 50 H 100 V 100 H 0 Z"/></svg>"""
WAIT = ("frames came so far: wait", "did not answer tare within")
"""What a service says that has only just started, on a busy machine: one waits and types it again."""
SHORTER = {
    "make train SKIN=my-skin QUICK=1": ".venv/bin/python -m models.build --skin my-skin --no-network --jobs 1",
    "./skin collect presses.npz --stub 40": "./skin collect presses.npz --stub 6",
    "./skin register presses.npz --skin my-skin --out my-registered": "",
    "make train SKIN=my-registered MINUTES=10": "",
}
LIVE = {  # with a sensor and somebody who presses: tests/cli/test_calibrate_live.py
    "./skin calibrate --live --skin mine --tip 0.005 --save small.csv --out mine-force.json": "",
    "./skin calibrate --live --skin mine --tip 0.012 --csv small.csv --out mine-force.json": "",
}
BUILD = ".venv/bin/python -m models.build --anyway --skin"
TRAINED = {
    "make train SKIN=my-skin QUICK=1": f"{BUILD} my-skin --minutes 2",
    "make train SKIN=my-registered MINUTES=10": f"{BUILD} my-registered --minutes 1",
}


def blocks() -> list[tuple[str, str]]:
    """Language and text of each block of the page, in order."""
    return [(b[1], b[2]) for b in FENCE.finditer((ROOT / PAGE).read_text(encoding="utf-8"))]


def commands() -> list[str]:
    lines = [line for kind, text in blocks() if kind == "sh" for line in text.splitlines()]
    return [line.partition(" #")[0].strip() for line in lines if line.strip()]


class Reader:
    """Somebody who follows the page."""

    def __init__(self, place: World, instead: dict[str, str]) -> None:
        self.place, self.instead = place, instead
        self.said: dict[str, Ran] = {}

    def write(self, text: str) -> None:
        name = re.match(r"# (\S+\.toml)\n", text)
        assert name, f"a block of TOML begins with its file's name: {text}"
        (self.place.checkout / name[1]).write_text(text)

    def type(self, command: str) -> None:
        typed = self.instead.get(command, command)
        if typed:
            end = time.monotonic() + START_S
            ran = self.place.ends(typed, timeout_s=1800)
            while any(said in ran.out for said in WAIT) and time.monotonic() < end:
                time.sleep(2.0)
                ran = self.place.ends(typed)
            self.said[command] = ran
            assert ran.code == 0 and "Traceback" not in ran.out, f"`{typed}` exit {ran.code}:\n{ran.out}"

    @contextlib.contextmanager
    def serving(self, config: str, skin: str) -> Iterator[NewestReader]:
        """`./skin up --config CONFIG`, once frames come."""
        with self.place.started(f"./skin up --config {config}") as process:
            reader = NewestReader("contact", skin, f"ipc://{self.place.folder}/xdg/eitskin/publisher.ipc")
            try:
                end = time.monotonic() + START_S
                while not isinstance(reader.recv(0.5), ContactFrame):
                    assert time.monotonic() < end and process.poll() is None, f"no frames with {config}"
                yield reader
            finally:
                reader.close()
                process.terminate()
                said, _ = process.communicate(timeout=30)
                assert "Traceback" not in said, said


def contact_of(reader: NewestReader) -> ContactFrame:
    """The next valid frame with one contact that has begun by then."""
    end = time.monotonic() + 60
    while True:
        frame = reader.recv(0.5)
        if isinstance(frame, ContactFrame) and frame.valid and [c.state for c in frame.contacts] == ["hold"]:
            return frame
        assert time.monotonic() < end, f"no valid contact: {frame}"


def follow(place: World, instead: dict[str, str]) -> Reader:
    """The whole page. The service starts where the page starts it, and again where mine.toml has changed."""
    somebody = Reader(place, instead)
    (place.checkout / "glove.svg").write_text(GLOVE)
    before, after = commands()[: commands().index(SKIN_UP)], commands()[commands().index(SKIN_UP) + 1 :]
    files = [text for kind, text in blocks() if kind == "toml"]
    for command in before:
        somebody.type(command)
    somebody.write(files[0])
    with somebody.serving("mine.toml", "mine"):
        for command in after:
            if "register" not in command:
                somebody.type(command)
    somebody.write(files[1])
    with somebody.serving("mine.toml", "mine") as reader:
        press(somebody, "mine")
        frame = contact_of(reader)
        assert frame.force_calibrated and frame.contacts[0].force_n == pytest.approx(3.0, rel=0.5)
    somebody.write(files[2])
    with somebody.serving("arm.toml", "arm") as reader:
        press(somebody, "arm")
        frame = contact_of(reader)
    (contact,) = frame.contacts
    x, y, z = contact.position
    assert frame.frame_id == "forearm"
    assert (x**2 + y**2) ** 0.5 == pytest.approx(0.04) and z == pytest.approx(0.12 - 0.008, abs=3e-3)
    assert contact.normal == pytest.approx([x / 0.04, y / 0.04, 0.0], abs=1e-6)
    for command in after:
        if "register" in command:
            somebody.type(command)
    return somebody


def press(somebody: Reader, skin: str) -> None:
    pressing = next(c for c in commands() if c.startswith("./skin press"))
    somebody.type("./skin tare")
    somebody.type(f"{pressing} --seconds 120")


def check(somebody: Reader, most_mm: float) -> None:
    compared = somebody.said["./skin compare --seconds 5"].out
    found = re.search(r"position error: median ([0-9.]+) mm", compared)
    assert found and float(found[1]) < most_mm, compared
    assert "mine" in somebody.said["./skin echo contact -n 5"].out
    assert "12 electrodes" in somebody.said["./skin new my-skin --disc 0.06 --electrodes 12"].out
    shown = Path(somebody.place.checkout, "mine-force.json")
    assert json.loads(shown.read_text())


@pytest.mark.release
def test_the_page_is_followed_without_training() -> None:
    needs.TRAIN.here()  # the program that makes bundles is the one that trains
    with world() as place:
        check(follow(place, SHORTER | LIVE), most_mm=2.0)


@pytest.mark.release
def test_the_page_is_followed_with_a_training() -> None:
    needs.TRAIN.here()
    with world() as place:
        somebody = follow(place, TRAINED | LIVE)
        check(somebody, most_mm=2.0)
        assert "verdict: " in somebody.said["make train SKIN=my-skin QUICK=1"].out
        (register,) = (each for each in somebody.said if each.startswith("./skin register"))
        assert "each found without itself: median" in somebody.said[register].out
