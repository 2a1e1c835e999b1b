"""Contacts by callback: nothing that goes wrong stays unsaid."""

import logging
import time

import pytest

from protocol.client import NotValid, Stale
from protocol.listener import ContactListener
from protocol.sockets import Publisher

from .test_client import RESTARTED, frame
from .test_sockets import run, subscribed, until

pytestmark = pytest.mark.live


@pytest.fixture
def publisher(runtime, context):
    return Publisher("publisher", context)


class Controller:
    """Notes what it is told."""

    def __init__(self):
        self.seen, self.stale = [], []

    def on_contact(self, got):
        self.seen.append(got)

    def on_stale(self, why):
        self.stale.append(why)


def test_contacts_silence_and_what_is_not_valid(publisher):
    robot = Controller()
    with ContactListener("palm", robot.on_contact, robot.on_stale, max_age=0.2):
        until(lambda: len(robot.stale) >= 2)
        assert "no contact frame of palm yet" in str(robot.stale[1]), "told again and again"
        subscribed(publisher)
        for seq in range(3):
            publisher.send(frame())
            until(lambda seq=seq: [f.seq for f in robot.seen] == list(range(seq + 1)))
        robot.stale.clear()
        publisher.send(frame(valid=False, reasons=["saturated"]))
        until(lambda: robot.stale)
        assert isinstance(robot.stale[0], NotValid) and robot.stale[0].frame.reasons == ["saturated"]
        until(lambda: type(robot.stale[-1]) is Stale)
    assert len(robot.seen) == 3, "on_contact is for frames that may be acted on"
    calls = len(robot.stale)
    time.sleep(0.3)
    assert len(robot.stale) == calls, "closed: no more calls"


def test_a_controller_that_fails_is_stopped_and_the_exception_comes_out(publisher, caplog):
    robot = Controller()

    def broken(got):
        robot.seen.append(got)
        raise KeyError("elbow")

    listener = ContactListener("palm", broken, robot.on_stale, max_age=0.2)
    subscribed(publisher)
    robot.stale.clear()
    with caplog.at_level(logging.ERROR):
        publisher.send(frame())
        until(lambda: any(isinstance(why.__cause__, KeyError) for why in robot.stale))
    assert "on_contact failed at frame 0" in caplog.text and "elbow" in caplog.text
    robot.stale.clear()
    publisher.send(frame())
    until(lambda: len(robot.stale) >= 2)
    assert all(isinstance(why.__cause__, KeyError) for why in robot.stale), "also of silence afterwards"
    assert len(robot.seen) == 1
    with pytest.raises(KeyError, match="elbow"):
        listener.close()


def test_a_stop_that_fails_is_called_again_and_comes_out(runtime, caplog):
    calls = []

    def broken(why):
        calls.append(why)
        raise OSError("no route to the robot")

    with pytest.raises(OSError, match="no route"), ContactListener("palm", print, broken, max_age=0.1):
        until(lambda: len(calls) >= 3)
    assert caplog.text.count("no route to the robot") >= 3


def test_a_listener_that_breaks_itself_says_so(runtime, monkeypatch):
    robot = Controller()
    monkeypatch.setattr("protocol.sockets.NewestReader.recv", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError), ContactListener("palm", robot.on_contact, robot.on_stale):
        until(lambda: robot.stale)
    assert "listener ended" in str(robot.stale[0])


def test_it_may_be_closed_from_its_own_callback(publisher):
    robot = Controller()
    listener = ContactListener("palm", robot.on_contact, lambda why: (robot.on_stale(why), listener.close()), 0.1)
    until(lambda: robot.stale)
    time.sleep(0.3)
    assert len(robot.stale) == 1
    listener.close()


def test_a_killed_service_is_silence_until_it_is_back(runtime):
    robot = Controller()
    with ContactListener("palm", robot.on_contact, robot.on_stale, max_age=0.2):
        for sessions in (1, 2):
            process = run(RESTARTED)
            try:
                until(lambda n=sessions: len({f.session for f in robot.seen}) == n)
                robot.stale.clear()
            finally:
                process.kill()
                process.communicate()
            until(lambda: robot.stale)
