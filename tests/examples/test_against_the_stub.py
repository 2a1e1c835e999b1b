"""The examples as they are, against the running service: real processes, the stub board, a press by its control socket.

Python's three controllers and the C++ subscriber share one service that scans whole, and one that scans in parts.
"""

from __future__ import annotations

import ast
import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from protocol.client import ContactSubscriber, Stale
from protocol.control import ControlClient
from protocol.frames import Contact, ContactFrame
from protocol.sockets import AllReader
from tests.docs.snippets import snippets
from tests.examples.compiled import ROOT, cpp_subscriber
from tests.processes import pid_of

__all__ = ["cpp_subscriber"]
SIGMAS = 3.44  # of a place: as few of a plane's lie beyond as beyond three of a line's
PATIENT_S = "1.5"  # what counts as silence here: a busy machine that runs tests is no fault of the skin

pytestmark = [
    pytest.mark.live,
    pytest.mark.usefixtures("untouched"),
    pytest.mark.parametrize("service_that_nobody_hears", ["full", "rolling"], indirect=True),
]
Start = Callable[..., subprocess.Popen[str]]


def stub(command: str, **args: object) -> None:
    ControlClient("stub", 5.0).call(command, **args)


def press(x: float, y: float, newtons: float) -> None:
    stub("press", x=x, y=y, force=newtons, seconds=60.0)


@pytest.fixture
def untouched(service_that_nobody_hears: Path) -> None:
    release()


def release() -> int:
    """Nothing touches, and the skin says so; gives the number of the last frame."""
    stub("release")
    end, quiet = time.monotonic() + 30, 0
    with ContactSubscriber("palm") as skin:
        while True:
            assert time.monotonic() < end, "no untouched frames"
            try:
                frame = skin.next_frame(1.0, valid=True)
            except Stale:
                quiet = 0
                continue
            quiet = 0 if frame.contacts else quiet + 1
            if quiet == 5:
                return frame.seq


@pytest.fixture
def start() -> Iterator[Start]:
    """Start an example as a user would."""
    running: list[subprocess.Popen[str]] = []

    def begin(*command: str) -> subprocess.Popen[str]:
        running.append(subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True))
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def example(name: str, max_age: str = PATIENT_S) -> tuple[str, ...]:
    return sys.executable, "-m", f"examples.{name}", "--max-age", max_age


def line_with(process: subprocess.Popen[str], words: str) -> str:
    """Read on until a line holds the words; empty where the process ends before."""
    assert process.stdout is not None
    return next((line for line in process.stdout if words in line), "")


def moved_until_pressed(start: Start, at: tuple[float, float, float], *command: str) -> tuple[int, str, int]:
    """Start an example, press (x, y, newtons) once it moves: its exit status, what it printed then, and the last frame
    before. Begun anew where a busy machine loses frames, for which it rightly stops.
    """
    for _ in range(5):
        before = release()
        robot = start(*command)
        if line_with(robot, "robot moves"):
            press(*at)
        printed = robot.communicate(timeout=60)[0]
        if robot.returncode != 1:
            return robot.returncode, printed, before
    raise AssertionError(f"five times: {printed}")


def test_the_newest_frame_is_there_right_after_connecting() -> None:
    """As README has it. A busy machine may be late once in a while; a client that asks for too much always was."""
    good = 0
    for _ in range(8):
        with ContactSubscriber("palm") as skin, contextlib.suppress(Stale):
            good += skin.latest(valid=True).valid
    assert good >= 4


def test_the_ten_lines_of_readme_read_a_touch(start: Start) -> None:
    """Whole scans and parts alike: who has none of our code."""
    program = next(each.text for each in snippets() if each.kind == "python" and "import msgpack" in each.text)
    client = start(sys.executable, "-u", "-c", program)
    assert line_with(client, "True []"), "an untouched frame to act on"
    press(0.02, -0.01, 3.0)
    position, newtons = ast.literal_eval(line_with(client, "True [([").partition(" True ")[2])[0]
    assert position == pytest.approx([0.02, -0.01, 0.0], abs=0.004) and newtons > 0


def test_who_comes_late_is_told_of_no_beginning_and_no_end() -> None:
    """Nobody subscribes while the touch comes, so that the publisher sleeps; nor while it goes."""

    def first(count: int) -> list[list[str]]:
        found: list[list[str]] = []
        with ContactSubscriber("palm") as skin:
            while len(found) < count:
                with contextlib.suppress(Stale):
                    found.append([c.state for c in skin.next_frame(1.0, valid=True).contacts])
        return found

    def asleep() -> None:
        control, end = ControlClient("publisher", 5.0), time.monotonic() + 30
        while not control.call("status")["idle"]:
            assert time.monotonic() < end, "somebody subscribes"
            time.sleep(0.05)

    asleep()
    press(0.02, -0.01, 3.0)
    time.sleep(1.0)
    states = first(5)
    assert set(sum(states, [])) == {"hold"}
    asleep()
    stub("release")
    time.sleep(1.0)
    assert sum(first(5), []) == []


def test_stop_on_contact_stops_with_the_first_frame_that_has_one(start: Start) -> None:
    every = AllReader(["contact"], "palm")
    status, printed, before = moved_until_pressed(start, (0.02, -0.01, 3.0), *example("stop_on_contact"))
    assert status == 0 and "robot stands" in printed
    stopped = re.search(r"stopped by frame (\d+): contact at \(([-+.\d]+), ([-+.\d]+)\) mm", printed)
    assert stopped
    touched = [f for f in frames_until(every, int(stopped[1])) if f.seq > before and f.contacts]
    assert len(touched) in (1, 2), "one frame later at most, where the machine let it be overtaken"
    said = touched[-1].contacts[0].position_sigma  # the press has only begun: 2 to 5 mm
    assert said is not None and said[0] < 6e-3
    assert np.hypot(float(stopped[2]) - 20, float(stopped[3]) + 10) < SIGMAS * 1e3 * said[0]
    every.close()


def test_stop_on_contact_stops_when_the_service_falls_silent(start: Start) -> None:
    robot = start(*example("stop_on_contact", "0.4"))
    assert line_with(robot, "robot moves")
    publisher = pid_of("services.publisher")
    os.kill(publisher, signal.SIGSTOP)
    try:
        assert line_with(robot, "robot stands")
        assert re.search(r"the newest contact frame of palm is \S+ s old", line_with(robot, "cannot be trusted"))
        assert robot.wait(10) == 1
    finally:
        os.kill(publisher, signal.SIGCONT)


def test_reflex_says_how_far_an_arm_goes_on(start: Start) -> None:
    """Begun anew where a busy machine loses frames while the arm moves, for which it rightly stops."""
    for _ in range(5):
        arm = start(*example("reflex"), "--speeds", "0.25", "--touches", "3", "--deceleration", "5")
        printed, _ = arm.communicate(timeout=90)
        if arm.returncode != 1:
            break
    assert arm.returncode == 0, printed
    said = re.search(r"^ +0\.25 +(\d+), +(\d+) +([.\d]+), +([.\d]+) +([.\d]+)$", printed, re.MULTILINE)
    assert said, printed
    typical_ms, latest_ms, typical_mm, most_mm, brakes_mm = map(float, said.groups())
    assert 0 < typical_ms <= latest_ms and brakes_mm == pytest.approx(6.2, abs=0.1)
    assert typical_mm == pytest.approx(6.25 + 0.25 * typical_ms, abs=0.2) and typical_mm <= most_mm


def test_guarded_move_reaches_its_force(start: Start) -> None:
    status, printed, _ = moved_until_pressed(start, (0.0, 0.0, 4.0), *example("guarded_move"), "--newtons", "2")
    assert status == 0 and re.search(r"force reached, stopped \d+ ms after it was measured: \(", printed)


def test_guarded_move_backs_off_where_no_contact_is_expected(start: Start) -> None:
    status, printed, _ = moved_until_pressed(start, (0.035, 0.0, 3.0), *example("guarded_move"), "--newtons", "20")
    assert status == 2 and "contact where none is expected" in printed and "backed off by 10 mm" in printed


def test_follow_the_finger_follows_holds_still_and_goes_on(start: Start) -> None:
    robot = start(*example("follow_the_finger", "0.4"))
    press(0.03, -0.02, 3.0)
    moves = re.search(r"moves at \(([-+.\d]+), ([-+.\d]+), ([-+.\d]+)\) mm/s", line_with(robot, "robot moves"))
    assert moves
    x, y, z = map(float, moves.groups())
    assert x > 0 > y and z < 0 and x * x + y * y + z * z <= 100.5**2
    publisher = pid_of("services.publisher")
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
        assert any(len(skin.next_frame(5.0).contacts) == 2 for _ in range(500))
    every = AllReader(["contact"], "palm")
    assert isinstance(every.recv(5.0), ContactFrame)
    program = start(str(cpp_subscriber), "palm", "30", "20")
    printed = program.communicate(timeout=60)[0]
    assert program.returncode == 0
    blocks = re.findall(r"^frame (\d+) (\w+)(.*)\n((?:  .*\n)*)", printed, re.MULTILINE)
    blocks = [block for block in blocks if block[1] != "STALE"]  # the machine was too slow for it to be acted on
    assert len(blocks) == 30
    sent = {f.seq: f for f in frames_until(every, int(blocks[-1][0]))}
    for seq, word, reasons, contacts in blocks:
        frame = sent[int(seq)]
        assert (word, reasons.split()) == ("valid" if frame.valid else "INVALID", frame.reasons)
        assert contacts == "".join(map(as_printed, frame.contacts))
    assert any(contacts.count("\n") == 2 for *_, contacts in blocks)
    every.close()


def frames_until(every: AllReader, seq: int) -> Iterator[ContactFrame]:
    while isinstance(frame := every.recv(5.0), ContactFrame):
        yield frame
        if frame.seq >= seq:
            return
    raise AssertionError(f"no frame {seq}")


def as_printed(contact: Contact) -> str:
    x, y, z = contact.position
    force = "unknown" if contact.force_n is None else f"{contact.force_n:.6f} +- {contact.force_sigma_n:.6f} N"
    return f"  contact {contact.id} {contact.state} at {x:+.6f} {y:+.6f} {z:+.6f} m force {force}\n"


def test_the_cpp_subscriber_survives_what_is_no_frame_and_tells_of_silence(
    cpp_subscriber: Path, runtime: Path, start: Start
) -> None:
    topic, _, body = (ROOT / "protocol" / "vectors" / "frames" / "contact_empty.bin").read_bytes().partition(b"\0")
    vector = topic + b"\0" + msgpack.packb(msgpack.unpackb(body) | {"host": "another"})
    with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
        publisher.bind(f"ipc://{runtime}/publisher.ipc")
        program = start(str(cpp_subscriber), "palm", "2", "20")
        end = time.monotonic() + 30
        while program.poll() is None and time.monotonic() < end:
            for message in (b"contact/palm\0\xc1", b"contact/palm\0\x80", b"contact/palm\0", vector):
                publisher.send(message)
                time.sleep(0.02)
        assert (
            program.communicate(timeout=10)[0].splitlines()
            == ["frame 41 INVALID stale_baseline uncalibrated_force"] * 2
        )
        assert program.returncode == 0
        silent = start(str(cpp_subscriber), "palm", "2")
        assert silent.communicate(timeout=30)[0] == "" and silent.returncode == 1
