"""The examples as they are, against the running service and the stub; whole scans in `make check-all` alone."""

import ast
import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from protocol.client import ContactSubscriber, Stale
from protocol.control import ControlClient
from protocol.frames import ContactFrame
from tests.docs.snippets import snippets
from tests.needs import ROOT
from tests.waiting import WAIT_S, until

SCANS = ["rolling", pytest.param("full", marks=pytest.mark.release)]
pytestmark = [
    pytest.mark.live,
    pytest.mark.usefixtures("untouched"),
    pytest.mark.parametrize("service_that_nobody_hears", SCANS, indirect=True),
]
Start = Callable[..., subprocess.Popen[str]]


def stub(command: str, **args: object) -> None:
    ControlClient("stub", WAIT_S).call(command, **args)


def press(x: float, y: float, newtons: float) -> None:
    stub("press", x=x, y=y, force=newtons, seconds=600.0)


def next_frame(skin: ContactSubscriber) -> ContactFrame | None:
    with contextlib.suppress(Stale):
        return skin.next_frame(1.0)
    return None


@pytest.fixture
def untouched(service_that_nobody_hears: Path) -> None:
    release()


def release() -> None:
    """Nothing touches, and the skin says so."""
    stub("release")
    with ContactSubscriber("palm") as skin:
        until(lambda: all((frame := next_frame(skin)) and not frame.contacts for _ in range(5)))


@pytest.fixture
def start() -> Iterator[Start]:
    """Its exit status, and what it printed after the press. Begun anew where a busy machine loses frames."""
    running: list[subprocess.Popen[str]] = []

    def begin(name: str, *options: str, max_age: str = "1.5") -> subprocess.Popen[str]:
        example = sys.executable, "-m", f"examples.{name}", "--max-age", max_age
        command = (*(example if "/" not in name else [name]), *options)
        running.append(subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True))
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def line_with(process: subprocess.Popen[str], words: str) -> str:
    """Read on until a line holds the words; empty where the process ends before."""
    assert process.stdout is not None
    return next((line for line in process.stdout if words in line), "")


def moved_until_pressed(start: Start, at: tuple[float, float, float], *command: str) -> tuple[int, str]:
    """Start an example, press (x, y, newtons) once it moves: its exit status, what it printed then. Begun anew where a
    busy machine loses frames, for which it rightly stops.
    """
    for _ in range(5):
        release()
        robot = start(*command)
        if line_with(robot, "robot moves"):
            press(*at)
        printed = robot.communicate(timeout=WAIT_S)[0]
        if robot.returncode != 1:
            return robot.returncode, printed
    raise AssertionError(f"five times: {printed}")


def test_the_ten_lines_of_readme_read_a_touch(start: Start) -> None:
    """Whole scans and parts alike: who has none of our code."""
    program = next(each.text for each in snippets() if each.kind == "python" and "import msgpack" in each.text)
    client = start(sys.executable, "-u", "-c", program)
    assert line_with(client, "True []"), "an untouched frame to act on"
    press(0.02, -0.01, 3.0)
    position, newtons = ast.literal_eval(line_with(client, "True [([").partition(" True ")[2])[0]
    assert position == pytest.approx([0.02, -0.01, 0.0], abs=0.01) and newtons > 0


def test_stop_on_contact_stops_with_the_first_frame_that_has_one(start: Start) -> None:
    status, printed = moved_until_pressed(start, (0.02, -0.01, 3.0), "stop_on_contact")
    assert status == 0 and "robot stands" in printed
    stopped = re.search(r"stopped by frame \d+: contact at \(([-+.\d]+), ([-+.\d]+)\) mm", printed)
    assert stopped and [float(each) for each in stopped.groups()] == pytest.approx([20, -10], abs=10)  # its first


def test_guarded_move_reaches_its_force(start: Start) -> None:
    status, printed = moved_until_pressed(start, (0.0, 0.0, 4.0), "guarded_move", "--newtons", "2")
    assert status == 0 and re.search(r"force reached, stopped \d+ ms after it was measured: \(", printed)


def test_follow_the_finger_follows_holds_still_and_goes_on(start: Start, service_that_nobody_hears: Path) -> None:
    robot = start("follow_the_finger", max_age="0.4")
    press(0.03, -0.02, 3.0)
    moves = re.search(r"moves at \(([-+.\d]+), ([-+.\d]+), ([-+.\d]+)\) mm/s", line_with(robot, "robot moves"))
    assert moves
    x, y, z = map(float, moves.groups())
    assert x > 0 > y and z < 0 and x * x + y * y + z * z <= 100.5**2
    publisher = int((service_that_nobody_hears / "publisher.lock").read_text())
    os.kill(publisher, signal.SIGSTOP)
    assert line_with(robot, "holding still")
    assert line_with(robot, "robot stands")
    os.kill(publisher, signal.SIGKILL)  # the service starts another one, and the controller finds it
    assert line_with(robot, "robot moves")
    stub("release")
    assert line_with(robot, "robot stands")


def test_the_cpp_subscriber_sees_the_same_contacts(cpp_subscriber: Path, start: Start) -> None:
    press(0.02, -0.01, 3.0)
    press(-0.025, 0.02, 4.0)
    with ContactSubscriber("palm") as skin:
        until(lambda: (frame := next_frame(skin)) is not None and len(frame.contacts) == 2)
    program = start(str(cpp_subscriber), "palm", "30", "20")
    printed = program.communicate(timeout=WAIT_S)[0]
    blocks = re.findall(r"^frame \d+ (\w+).*\n((?:  contact .* m force .* N\n)*)", printed, re.MULTILINE)
    assert program.returncode == 0 and len([word for word, _ in blocks if word != "STALE"]) == 30
    both = [contacts for word, contacts in blocks if word == "valid" and contacts.count("\n") == 2]
    places = re.findall(r" at (\S+) (\S+) \S+ m force (\S+) \+- \S+ N", both[-1])
    (x, y, newtons), (x2, y2, newtons2) = sorted([float(each) for each in place] for place in places)
    assert (x, y, x2, y2) == pytest.approx((-0.025, 0.02, 0.02, -0.01), abs=0.003)
    assert (newtons, newtons2) == pytest.approx((4.0, 3.0), abs=1.0)
