"""What the example controllers make of frames, known beforehand: no service needed."""

import math
import re
import time

import pytest

from bench.speed.simulated_host import SimulatedHost
from examples.follow_the_finger import DAMPING, FASTEST, answer, follow, push
from examples.guarded_move import guarded_move
from examples.reflex import Arm, told_s
from examples.robot import Robot
from examples.stop_on_contact import stop_on_contact
from protocol.client import NotValid, Stale
from protocol.frames import Contact, ContactFrame
from protocol.runtime import host_id


class Skin:
    """Gives out the frames of a list; silence after them."""

    def __init__(self, *frames):
        self.frames = list(frames)

    def next_frame(self, max_age, *, valid):
        assert valid, "a controller asks for frames to act on"
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
    return ContactFrame(skin="palm", valid=valid, contacts=list(contacts))


def contact(x, y, force, state="hold"):
    return Contact(id=1, state=state, position=[x, y, 0.0], force_n=force)


STILL = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("last", "status"), [([frame(contact(0.0, 0.0, 0.1))], 0), ([], 1), ([frame(valid=False)], 1)])
def test_the_very_frame_stops_it(last, status, capsys):
    robot = Drive()
    assert stop_on_contact(robot, Skin(frame(), frame(), *last, frame()), 0.1) == status
    moved, stopped = robot.told[:-1], robot.told[-1]
    assert stopped == STILL and all(v[0] > 0 for v in moved)
    assert len(moved) == (2 if last else 3), "one command for each frame that allowed it"


def test_it_does_not_begin_to_move_before_the_skin_is_trusted():
    robot = Drive()
    assert stop_on_contact(robot, Skin(frame(valid=False)), 0.1) == 1
    assert robot.told == [STILL]


def test_guarded_move_stops_at_its_force_and_not_before():
    robot = Drive()
    skin = Skin(frame(), frame(contact(0.01, 0.0, 1.9)), frame(contact(0.01, 0, 9.0, "end")), frame(contact(0, 0, 2.1)))
    assert guarded_move(robot, skin, 2.0, 0.1) == 0
    assert [v[2] < 0 for v in robot.told] == [True, True, True, False] and robot.told[-1] == STILL


def test_guarded_move_says_how_long_ago_it_was_measured_what_it_stopped_for(capsys):
    reached = frame(contact(0.01, 0.0, 3.0))
    reached.host, reached.stamps = host_id(), {"sample": time.monotonic_ns() - 9_000_000}
    assert guarded_move(Drive(), Skin(frame(), reached), 2.0, 0.1) == 0
    said = re.search(r"force reached, stopped (\d+) ms after it was measured: \(\+10.0", capsys.readouterr().out)
    assert said and 9 <= int(said[1]) < 1000
    reached.host = "another"
    assert guarded_move(Drive(), Skin(reached), 2.0, 0.1) == 0
    assert "force reached: (" in capsys.readouterr().out


def test_with_rolling_scans_guarded_move_stops_within_20_ms_of_contact():
    """In simulated time: board, stages and 2 ms for sockets and scheduling."""
    host = SimulatedHost("rolling", snr_db=80.0, seed=3)
    host.until(5.0)
    for x, y, status in ((0.005, 0.01, 0), (-0.012, 0.008, 0), (0.03, -0.02, 2)):
        pressed, first = host.now, len(host.contacts) - 3
        host.press(x=x, y=y, force=2.0, radius=0.008, seconds=0.2)
        host.until(pressed + 0.1)
        given = []

        class Later(Skin):
            def next_frame(self, max_age, *, valid, given=given, seen=host.contacts[first:]):
                if len(given) == len(seen):
                    raise Stale("silence", 1.0)
                given.append(seen[len(given)])
                return given[-1][1]

        robot = Drive()
        assert guarded_move(robot, Later(), 1.0, 0.1) in (status, 1)
        stop = robot.told.index(STILL)
        assert stop > 2, "it moved before"
        assert 0 < given[stop][0] - pressed < 0.020
        host.until(host.now + 0.6)
    host.rig.close()


def test_an_arm_goes_on_until_it_is_told_and_then_brakes():
    assert Arm(0.5, 10.0, 2000.0).goes_on_m(0.02) == pytest.approx(0.5 * 0.02 + 0.0125)


def test_an_arm_is_told_by_the_first_frame_after_its_touch_that_has_a_contact():
    touch_ns, before, after = time.monotonic_ns(), frame(contact(0, 0, 1.0)), frame(contact(0, 0, 1.0, "end"))
    told = told_s(Skin(frame(), after, frame(contact(0.01, 0, 0.5))), touch_ns)
    assert told is not None and 0 < told < 0.3
    with pytest.raises(Stale):  # frames of before the touch tell nothing of it
        told_s(Skin(before), time.monotonic_ns() + 10**9)
    assert told_s(Skin(frame()), touch_ns - 10**9) is None
    with pytest.raises(Stale):
        told_s(Skin(frame(valid=False)), touch_ns)


@pytest.mark.parametrize("touch", [contact(0.04, 0.0, 0.2), contact(0.0, 0.0, None)])
def test_guarded_move_backs_off_or_stops_where_it_cannot_know(touch, monkeypatch):
    robot = Drive()
    ticks = iter(range(10_000))
    monkeypatch.setattr("examples.robot.time.monotonic", lambda: next(ticks) * 0.02)
    status = guarded_move(robot, Skin(*[frame()] * 2, *[frame(touch)] * 40), 2.0, 0.1)
    if touch.force_n is None:
        assert status == 0, "an unknown force counts as enough"
    else:
        assert status == 2 and robot.told[-2][2] > 0
    assert robot.told[-1] == STILL


def test_guarded_move_does_not_back_off_blindly():
    robot = Drive()
    assert guarded_move(robot, Skin(frame(contact(0.04, 0.0, 0.2))), 2.0, 0.1) == 1
    assert robot.told[-1] == STILL


def test_a_push_to_the_side_moves_to_that_side_and_away():
    x, y, z = push([contact(0.03, -0.02, 3.0)])
    assert x > 0 and z < 0 and y / x == pytest.approx(-2 / 3)
    assert push([contact(0.001, 0.002, 3.0)])[:2] == (0.0, 0.0), "dead band of position"
    assert push([contact(0.03, 0.0, 0.2)]) == (0.0, 0.0, 0.0), "dead band of force"
    assert push([contact(0.03, 0.0, None)]) == push([contact(0.03, 0.0, 3.0, "end")]) == (0.0, 0.0, 0.0)


def test_the_answer_has_the_mass_the_damping_and_the_limit():
    v = STILL
    for _ in range(100):
        v = answer(v, (2.0, 0.0, 0.0), 0.05)
    assert v == pytest.approx((2.0 / DAMPING, 0.0, 0.0), rel=1e-6), "D v = F in the end"
    assert answer(STILL, (2.0, 0.0, 0.0), 0.1)[0] == pytest.approx((1 - math.exp(-1)) * 2.0 / DAMPING)
    for _ in range(100):
        v = answer(v, (40.0, 30.0, 0.0), 0.05)
    assert math.hypot(*v) == pytest.approx(FASTEST) and v[1] / v[0] == pytest.approx(0.75)
    for _ in range(100):
        v = answer(v, STILL, 0.05)
    assert v == STILL, "and it comes to rest"


def test_following_holds_still_as_soon_as_the_skin_is_not_trusted(monkeypatch, capsys):
    ticks = iter(range(10_000))
    monkeypatch.setattr("examples.follow_the_finger.time.monotonic", lambda: next(ticks) * 0.02)
    robot, touch = Drive(), frame(contact(0.03, 0.0, 3.0))
    follow(robot, Skin(touch, touch, frame(valid=False), touch), 0.1, 0.3)
    assert [any(v) for v in robot.told[:5]] == [True, True, False, True, False]
    assert "holding still" in capsys.readouterr().out


def test_following_says_from_the_first_moment_whether_it_can(monkeypatch, capsys):
    ticks = iter(range(10_000))
    monkeypatch.setattr("examples.follow_the_finger.time.monotonic", lambda: next(ticks) * 0.02)
    follow(Drive(), Skin(frame(valid=False), frame(valid=False), frame(), frame()), 0.1, 0.4)
    said = [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()]
    assert said == ["holding still", "following", "holding still"]


def test_a_robot_that_is_told_nothing_more_stops_by_itself(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("examples.robot.time.monotonic", lambda: now[0])
    robot = Robot()
    robot.move((1.0, 0.0, 0.0))
    now[0] = 0.2
    assert robot.position[0] == pytest.approx(0.2)
    now[0] = 60.0
    assert robot.position[0] == pytest.approx(0.5)
