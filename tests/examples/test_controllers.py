"""What the example controllers make of frames, known beforehand: no service needed."""

import itertools
import math
import re
import time

import pytest

from examples.follow_the_finger import DAMPING, answer, follow, push
from examples.guarded_move import guarded_move
from examples.reflex import Arm, told_s
from examples.robot import Robot
from examples.stop_on_contact import stop_on_contact
from protocol.client import NotValid, Stale
from protocol.frames import Contact, ContactFrame
from protocol.runtime import host_id
from simulation.host import SimulatedHost

STILL = (0.0, 0.0, 0.0)


class Skin:
    """Gives out the frames of a list; silence after them."""

    def __init__(self, *frames):
        self.frames = list(frames)

    def next_frame(self, max_age):
        if not self.frames:
            raise Stale("silence", 1.0)
        frame = self.frames.pop(0)
        if not frame.valid:
            raise NotValid(frame, 0.0)
        return frame


class Drive(Robot):
    """A robot that counts its commands."""

    def __init__(self):
        super().__init__()
        self.told = []

    def move(self, velocity):
        self.told.append(velocity)
        super().move(velocity)


def frame(*contacts, valid=True):
    """As the client gives it out: what has ended stands apart."""
    return ContactFrame(skin="palm", valid=valid, contacts=[c for c in contacts if c.state != "end"])


def contact(x, y, force, state="hold"):
    return Contact(id=1, state=state, position=[x, y, 0.0], force_n=force)


@pytest.fixture
def ticking(monkeypatch):
    """A clock that goes on by 20 ms whenever somebody looks."""
    ticks = itertools.count()
    monkeypatch.setattr("time.monotonic", lambda: next(ticks) * 0.02)


def test_the_very_frame_stops_it():
    for last, status in (([frame(contact(0.0, 0.0, 0.1))], 0), ([], 1), ([frame(valid=False)], 1)):
        robot = Drive()
        assert stop_on_contact(robot, Skin(frame(), frame(), *last, frame()), 0.1) == status
        assert robot.told[-1] == STILL and [v[0] > 0 for v in robot.told] == [True] * (2 if last else 3) + [False]


def test_guarded_move_stops_at_its_force_and_not_before_and_says_how_old_it_was(capsys):
    robot, reached = Drive(), frame(contact(0.01, 0, 2.1))
    reached.host, reached.stamps = host_id(), {"sample": time.monotonic_ns() - 9_000_000}
    skin = Skin(frame(), frame(contact(0.01, 0.0, 1.9)), frame(contact(0.01, 0, 9.0, "end")), reached)
    assert guarded_move(robot, skin, 2.0, 0.1) == 0
    assert [v[2] < 0 for v in robot.told] == [True, True, True, False] and robot.told[-1] == STILL
    said = re.search(r"force reached, stopped (\d+) ms after it was measured: \(\+10.0", capsys.readouterr().out)
    assert said and 9 <= int(said[1]) < 1000


def test_with_rolling_scans_guarded_move_stops_within_20_ms_of_contact():
    """In simulated time: board, stages and 2 ms for sockets and scheduling."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.until(5.0)
    for x, y, status in ((0.005, 0.01, 0), (0.03, -0.02, 2)):
        pressed, first = host.now, len(host.contacts) - 3
        host.press(x=x, y=y, force=2.0, radius=0.008, seconds=0.2)
        host.until(pressed + 0.1)
        seen = host.contacts[first:]
        robot = Drive()
        assert guarded_move(robot, Skin(*(frame(*found.contacts) for _, found in seen)), 1.0, 0.1) in (status, 1)
        stop = robot.told.index(STILL)
        assert stop > 2, "it moved before"
        assert 0 < seen[stop][0] - pressed < 0.020
        host.until(host.now + 0.6)
    host.rig.close()


def test_an_arm_goes_on_until_the_first_frame_after_its_touch_that_has_a_contact():
    touch_ns, before, after = time.monotonic_ns(), frame(contact(0, 0, 1.0)), frame(contact(0, 0, 1.0, "end"))
    told = told_s(Skin(frame(), after, frame(contact(0.01, 0, 0.5))), touch_ns)
    assert told is not None and 0 < told < 0.3
    for skin, at_ns in ((Skin(before), time.monotonic_ns() + 10**9), (Skin(frame(valid=False)), touch_ns)):
        with pytest.raises(Stale):  # frames of before the touch tell nothing of it
            told_s(skin, at_ns)
    assert told_s(Skin(frame()), touch_ns - 10**9) is None
    assert Arm(0.5, 10.0, 2000.0).goes_on_m(0.02) == pytest.approx(0.5 * 0.02 + 0.0125), "then it brakes"


@pytest.mark.parametrize(("touch", "status"), [(contact(0.04, 0.0, 0.2), 2), (contact(0.0, 0.0, None), 0)])
def test_guarded_move_backs_off_or_stops_where_it_cannot_know(touch, status, ticking):
    robot, blind = Drive(), Drive()
    assert guarded_move(robot, Skin(*[frame()] * 2, *[frame(touch)] * 40), 2.0, 0.1) == status
    assert robot.told[-1] == STILL and (robot.told[-2][2] > 0) == (status == 2)
    assert guarded_move(blind, Skin(frame(contact(0.04, 0.0, 0.2))), 2.0, 0.1) == 1 and blind.told[-1] == STILL


def test_a_push_to_the_side_moves_to_that_side_and_away():
    x, y, z = push([contact(0.03, -0.02, 3.0)])
    assert x > 0 and z < 0 and y / x == pytest.approx(-2 / 3)
    assert push([contact(0.001, 0.002, 3.0)])[:2] == (0.0, 0.0), "dead band of position"
    assert push([contact(0.03, 0.0, 0.2)]) == push([contact(0.03, 0.0, None)]) == STILL, "dead band of force"


def test_the_answer_has_the_mass_the_damping_and_the_limit():
    def after(v, push, steps=100):
        for _ in range(steps):
            v = answer(v, push, 0.05)
        return v

    assert after(STILL, (2.0, 0.0, 0.0)) == pytest.approx((2.0 / DAMPING, 0.0, 0.0), rel=1e-6), "D v = F in the end"
    assert answer(STILL, (2.0, 0.0, 0.0), 0.1)[0] == pytest.approx((1 - math.exp(-1)) * 2.0 / DAMPING)
    v = after(STILL, (40.0, 30.0, 0.0))
    assert math.hypot(*v) == pytest.approx(0.1) and v[1] / v[0] == pytest.approx(0.75)
    assert after(v, STILL) == STILL, "and it comes to rest"


def test_following_holds_still_as_soon_as_the_skin_is_not_trusted_and_says_so(ticking, capsys):
    robot, touch = Drive(), frame(contact(0.03, 0.0, 3.0))
    follow(robot, Skin(touch, touch, frame(valid=False), touch), 0.1, 0.3)
    assert [any(v) for v in robot.told[:5]] == [True, True, False, True, False]
    assert "holding still" in capsys.readouterr().out
    follow(Drive(), Skin(frame(valid=False), frame(valid=False), frame(), frame()), 0.1, 0.4)
    said = [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()]
    assert said == ["holding still", "following", "holding still"], "from the first moment"


def test_a_robot_that_is_told_nothing_more_stops_by_itself(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("examples.robot.time.monotonic", lambda: now[0])
    robot = Robot()
    robot.move((1.0, 0.0, 0.0))
    for at, expected in ((0.2, 0.2), (60.0, 0.5)):
        now[0] = at
        assert robot.position[0] == pytest.approx(expected)
