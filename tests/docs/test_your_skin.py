"""docs/your-skin.md, word by word: every command in its order, in a copy of the checkout."""

import re

import pytest

from protocol.sockets import NewestReader
from tests import needs
from tests.docs.snippets import FENCE, ROOT
from tests.docs.world import World, world
from tests.waiting import until

pytestmark = [pytest.mark.live, pytest.mark.release]

BLOCKS = FENCE.findall((ROOT / "docs" / "your-skin.md").read_text("utf-8"))
FILES = [text for language, text in BLOCKS if language == "toml"]
LINES = [line.partition(" #")[0].strip() for language, text in BLOCKS if language == "sh" for line in text.splitlines()]
COMMANDS = [line for line in LINES if line]
PRESS = next(line for line in COMMANDS if line.startswith("./skin press"))
GLOVE = """<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">
<path d="M 0 0 H 50 V 50 H 100 V 100 H 0 Z"/></svg>"""
BUILD = ".venv/bin/python -m models.build --anyway --skin"
SHORTER = {  # what is typed instead
    "make train SKIN=my-skin QUICK=1": f"{BUILD} my-skin --minutes 2",
    "make train SKIN=my-registered MINUTES=10": f"{BUILD} my-registered --minutes 1",
}


class Reader:
    def __init__(self, place: World) -> None:
        self.place, self.said = place, dict[str, str]()

    def type(self, *commands: str) -> None:
        for command in commands:
            self.said[command] = until(lambda command=command: self._said(SHORTER.get(command, command)))

    def _said(self, typed: str) -> str:
        """Nothing yet where the service has only just started: one types it again."""
        try:
            return self.place.ends(typed) + "\n"
        except AssertionError as why:
            if re.search("frames came so far: wait|did not answer tare within", str(why)):
                return ""
            raise

    def pressed(self, reader: NewestReader):
        """Tare and press again; the next valid frame with one contact that has begun by then."""
        self.type("./skin tare", f"{PRESS} --seconds 600")
        return until(lambda: (f := reader.recv(0.5)) and f.valid and [c.state for c in f.contacts] == ["hold"] and f)


def test_the_page_is_followed() -> None:
    needs.TRAIN.here()
    begin = COMMANDS.index("./skin up --config mine.toml")
    later = [command for command in COMMANDS[begin + 1 :] if not command.startswith("./skin calibrate --live")]
    registering = [command for command in later if "register" in command]
    with world() as place:
        somebody = Reader(place)
        (place.checkout / "glove.svg").write_text(GLOVE)
        somebody.type(*COMMANDS[:begin])
        (place.checkout / "mine.toml").write_text(FILES[0])
        with place.serving("./skin up --config mine.toml", "mine"):
            somebody.type(*(command for command in later if command not in registering))
        (place.checkout / "mine.toml").write_text(FILES[1])
        with place.serving("./skin up --config mine.toml", "mine") as reader:
            frame = somebody.pressed(reader)
            assert frame.force_calibrated and frame.contacts[0].force_n == pytest.approx(3.0, rel=0.5)
        (place.checkout / "arm.toml").write_text(FILES[2])
        with place.serving("./skin up --config arm.toml", "arm") as reader:
            frame = somebody.pressed(reader)
        (contact,) = frame.contacts
        x, y, z = contact.position
        assert frame.frame_id == "forearm"
        assert (x**2 + y**2) ** 0.5 == pytest.approx(0.04) and z == pytest.approx(0.12 - 0.008, abs=6e-3)
        assert contact.normal == pytest.approx([x / 0.04, y / 0.04, 0.0], abs=1e-6)
        somebody.type(*registering)
    found = re.search(r"position error: median ([0-9.]+) mm", somebody.said["./skin compare --seconds 5"])
    assert found and float(found[1]) < 4.0
