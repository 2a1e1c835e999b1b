"""What a controller gets: new contacts, or Stale. In simulated time, of the client that blocks and of asyncio's."""

import asyncio
import logging
import threading

import pytest

from protocol import ages, aio, client, freshness
from protocol.ages import OtherClocks
from protocol.aio import AsyncContactSubscriber
from protocol.client import ContactSubscriber, NotValid, Stale
from protocol.frames import Contact
from protocol.listener import ContactListener
from tests.waiting import until

from .line import AHEAD_NS, Clock, InALoop, S, simulated
from .peers import another


class KnownClocks:
    """Other hosts' clocks: one of them has told by how much it may be ahead."""

    def __init__(self, processes):
        assert set(processes) == {"acquisition", "publisher"}
        self.known = {"known": AHEAD_NS}
        self.ahead_ns, self.forget, self.close = self.known.get, self.known.clear, list


@pytest.fixture
def line(monkeypatch):
    monkeypatch.setattr(ages, "OtherClocks", KnownClocks)
    return simulated(monkeypatch, ages, aio, client, freshness)


@pytest.fixture(params=[ContactSubscriber, InALoop], ids=["blocking", "asyncio"])
def skin(request, line):
    own = request.param("palm", replay="fields" in request.fixturenames)
    yield own
    own.close()
    assert line.closed


def stale(call, *args, **options):
    with pytest.raises(Stale) as caught:
        call(*args, **options)
    return caught.value


def test_latest_waits_a_second_for_the_first_frame_and_gives_the_same_again_within_its_own_bound(line, skin):
    for _ in range(2):  # a second in all, not each time
        assert "no contact frame of palm yet" in str(why := stale(skin.latest)) and why.age_s is None
        assert line.clock.monotonic() == pytest.approx(1001.0, abs=0.01)
    line.send(valid_for_s=0.5)
    assert skin.latest().seq == 0
    line.clock.go(0.49)
    assert skin.latest().seq == 0
    line.clock.go(0.02)
    assert "is 0.510 s old, expected at most 0.500 s" in str(stale(skin.latest))
    assert line.clock.monotonic() == pytest.approx(1001.51, abs=0.01), "it did not wait"
    line.send(after_s=0.2)
    assert skin.latest(wait_s=0.3).seq == 1, "who asks for it waits for one that will do"


@pytest.mark.parametrize(("age_s", "fields", "max_age", "found"), [
    (0.1, {}, 0.05, 0.1),
    (0.1, {}, 0.11, None),
    (0.02, {"valid_for_s": 0.01}, 5.0, 0.02),
    (1e-3, {"valid_for_s": 0.0}, 5.0, 1e-3),
    (6.0, {"source": "replay", "stamps": {"sample": 5, "read": 994 * S, "publish": 1000 * S}}, None, 6.0),
    (60.0, {"source": "replay", "stamps": {"sample": 940 * S, "read": 999 * S}}, None, None),
    (0.9, {"host": "known", "valid_for_s": 0.5}, None, 0.9),
    (0.4, {"host": "known", "valid_for_s": 0.5}, None, None),
    (0.9, {"host": "known", "valid_for_s": 0.5, "stamps": {"sample": AHEAD_NS + 9991 * S // 10}}, None, 0.9),
    (0.9, {"host": "other", "valid_for_s": 0.5}, None, 0.9),  # reception, and what its own stamps prove
    (9.0, {"host": "other", "valid_for_s": 0.5, "stamps": {"sample": 5}}, None, None),
])  # fmt: skip
def test_a_frame_is_as_old_as_its_measurement_and_stale_beyond_a_bound(line, skin, age_s, fields, max_age, found):
    stale(skin.latest, wait_s=0.0)
    for seq, call in enumerate((skin.latest, skin.next_frame)):
        line.send(age_s=age_s, **fields)
        if found is None:
            assert call(max_age).seq == seq
        elif seq:
            stale(call, max_age)
        else:
            limit = min(max_age or 1e9, fields.get("valid_for_s", 5.0))
            assert f"is {found:.3f} s old, expected at most {limit:.3f} s" in str(why := stale(call, max_age))
            assert why.age_s == pytest.approx(found) and not isinstance(why, NotValid)


def test_a_frame_that_does_not_say_when_it_was_measured_is_stale_and_one_from_the_future_gets_older(line, skin):
    line.send(stamps={"publish": line.clock.ns})
    assert "does not say when it was measured" in str(why := stale(skin.latest)) and why.age_s is None
    line.send(age_s=-60.0)
    assert skin.latest(max_age=0.5).seq == 1
    line.clock.go(0.1)
    assert stale(skin.latest, max_age=0.05).age_s == pytest.approx(0.1)


def test_next_frame_waits_as_long_as_the_newest_one_holds(line, skin):
    """Of a slow board a frame every 0.4 s is no silence."""

    def waited(*args):
        began = line.clock.monotonic()
        stale(skin.next_frame, *args)
        return pytest.approx(line.clock.monotonic() - began, abs=0.01)

    assert waited() == 1.0, "for the first one"
    line.send(valid_for_s=30.0)
    assert skin.next_frame().seq == 0
    line.send(valid_for_s=0.4, after_s=20.0)
    assert skin.next_frame().seq == 1 and waited() == 0.4 and waited(0.05) == 0.05
    line.send(valid_for_s=0.1)
    skin.next_frame()
    assert waited() == 0.25, "at least"


def test_iterating_gives_each_new_frame_once_and_ends_with_silence(line, skin):
    frames = iter(skin)
    for seq in range(3):
        line.send(valid_for_s=0.25)
        assert next(frames).seq == seq
    assert "expected at most 0.250 s" in str(stale(next, frames))
    line.send()
    line.send()
    assert next(iter(skin)).seq == 4, "it can be begun anew, and gives the newest"


def test_a_frame_that_is_not_valid_is_given_only_to_who_asks_for_any(line, skin):
    line.send(valid=False, reasons=["saturated", "gap"])
    assert skin.latest(allow_invalid=True).reasons == ["saturated", "gap"]
    why = stale(skin.latest)
    assert isinstance(why, NotValid) and why.frame.seq == 0 and "palm is not valid: saturated, gap" in str(why)
    line.send(valid=False)
    assert skin.next_frame(allow_invalid=True).seq == 1
    line.send(valid=False)
    assert isinstance(stale(next, iter(skin)), NotValid), "a loop that moves a robot ends"
    line.send(valid=False, reasons=["late"], valid_for_s=0.25, age_s=0.9)
    now, why = line.clock.ns, stale(skin.next_frame, 20.0)
    assert isinstance(why, NotValid) and why.age_s == pytest.approx(0.9) and line.clock.ns == now, "told at once"
    assert str(stale(skin.latest)).endswith("; it is not valid either: late")
    line.send()
    assert skin.latest().seq == 4


def test_from_another_host_a_frame_that_lay_in_the_socket_is_old(line, skin):
    """Its clock is not known: it is only known to have come after the socket was last seen empty."""
    stale(skin.latest, wait_s=0.0)
    line.send(after_s=0.05, host="other")
    line.clock.go(0.3)
    assert stale(skin.latest, max_age=0.2).age_s == pytest.approx(0.3)
    line.send(after_s=0.05, host="other")
    assert skin.next_frame(0.02 + 0.05).seq == 1 == skin.latest(max_age=1e-3).seq, "waited for: it has come just now"
    line.send(after_s=0.05, host="other")
    line.held_up_s = 0.5  # stopped while it waited: what is there may have come long ago
    assert stale(skin.next_frame, 0.2).age_s == pytest.approx(0.5)
    line.send(host="other")
    line.clock.go(0.1)
    assert skin.next_frame(0.2).seq == 3


def test_what_came_before_this_host_slept_is_stale(line, skin):
    for seq, went_s in enumerate((1.0, 2.0)):
        line.send(valid_for_s=30.0)
        assert skin.latest().seq == seq
        line.clock.slept_ns += 60 * S
        line.clock.go(went_s)
        assert stale(skin.latest).age_s >= 60.0 + went_s


def test_what_another_host_told_of_its_clock_is_forgotten_once_ours_slept(line, skin):
    line.send(host="known", stamps={"sample": line.clock.ns + AHEAD_NS - 4 * S})
    assert stale(skin.latest, max_age=3.0).age_s == pytest.approx(4.0)
    line.clock.slept_ns += 60 * S
    stale(skin.latest)
    line.send(host="known", stamps={"sample": line.clock.ns + AHEAD_NS - 4 * S}, after_s=2.0)
    assert skin.next_frame(3.0).seq == 1, "it has come just now, and its stamps prove no more"


def test_what_has_ended_stands_apart_and_only_where_its_touch_was_told_of(line, skin):
    for sent, touch, ended, line.session in (
        ({7: "end", 8: "hold"}, [8], [], "a" * 16),
        ({9: "begin", 8: "hold"}, [9, 8], [], "a" * 16),
        ({8: "end", 9: "hold"}, [9], [8], "a" * 16),
        ({9: "end", 3: "end"}, [], [9], "a" * 16),
        ({5: "begin"}, [5], [], "a" * 16),
        ({5: "end"}, [], [], "b" * 16),  # the ids of another session are other touches
    ):
        line.send(contacts=[Contact(id=n, state=state, position=[0.0, 0.0, 0.0]) for n, state in sent.items()])
        frame = skin.next_frame()
        assert [c.id for c in frame.contacts] == touch and [c.id for c in frame.ended] == ended


def test_replayed_frames_are_ignored_unless_asked_for_and_what_is_no_frame_is_named(line, skin):
    line.send(source="replay")
    line.malformed, line.last_error = 1, "no schema"
    why = str(stale(skin.latest))
    assert "; 1 replayed ones were ignored (replay=True" in why and skin.replayed == 1
    assert why.endswith("; 1 malformed ones were dropped, the last because no schema")


class Controller:
    def __init__(self, *happens):
        self.seen, self.stale, self.happens, self.done = [], [], list(happens), threading.Event()

    def on_frame(self, got):
        self.seen.append(got.seq)
        (self.happens.pop(0) if self.happens else self.done.set)()

    def on_stale(self, why):
        self.stale.append(why)
        (self.happens.pop(0) if self.happens else self.done.set)()


def broken():
    raise OSError("no route to the robot")


def test_run_calls_one_of_the_two_for_each_frame_and_each_silence(line):
    robot = Controller(line.send, list, lambda: line.send(valid=False, reasons=["gap"]), line.send, broken)
    began = line.clock.monotonic()
    with ContactSubscriber("palm") as skin, pytest.raises(OSError, match="no route"):
        skin.run(robot.on_frame, robot.on_stale, max_age=0.3)
    assert robot.seen == [0, 2] and [type(why) for why in robot.stale] == [Stale, Stale, NotValid]
    assert "no contact frame of palm yet" in str(robot.stale[0])
    assert line.clock.monotonic() - began == pytest.approx(0.6, abs=0.01)


def ended(robot, *callbacks):
    listener = ContactListener("palm", *callbacks, max_age=0.2)
    until(robot.done.is_set)
    with pytest.raises(OSError, match="no route"):
        listener.close()


@pytest.mark.live
def test_a_controller_that_fails_is_stopped_and_the_exception_comes_out(line, caplog):
    robot = Controller(line.send, line.send, broken, list, line.send, list)
    with caplog.at_level(logging.ERROR):
        ended(robot, robot.on_frame, robot.on_stale)
    assert "on_frame failed at frame 1" in caplog.text and "no route" in caplog.text
    assert robot.seen == [0, 1], "it is not called again, though another frame came"
    assert type(robot.stale[0]) is Stale and len(robot.stale) >= 4
    assert all(isinstance(why.__cause__, OSError) for why in robot.stale[1:]), "also of silence afterwards"


@pytest.mark.live
@pytest.mark.parametrize("what", ["the stop", "the listener"])
def test_a_stop_that_fails_is_called_again_and_a_listener_that_breaks_says_so(line, caplog, monkeypatch, what):
    robot = Controller(*[broken] * (3 if what == "the stop" else 0))
    if what == "the listener":
        monkeypatch.setattr(line, "recv", lambda _: broken())
    ended(robot, print, robot.on_stale)
    assert caplog.text.count("no route to the robot") >= (3 if what == "the stop" else 1)
    assert ("listener ended" in str(robot.stale[0])) == (what == "the listener")


@pytest.mark.live
def test_a_listener_may_be_closed_from_its_own_callback_and_calls_no_more(line):
    made, begun = [], threading.Event()
    robot = Controller(lambda: begun.wait(60) and made[0].close())
    made.append(ContactListener("palm", robot.on_frame, robot.on_stale, 0.1))
    begun.set()
    until(lambda: not any(thread.name == "contacts of palm" for thread in threading.enumerate()))
    made[0].close()
    assert len(robot.stale) == 1


RESTARTED = (
    "import time; from protocol.sockets import Publisher; from protocol.frames import ContactFrame\n"
    "p = Publisher('publisher'); print('ready', flush=True)\n"
    "while True:\n"
    "    p.send(ContactFrame(skin='palm', valid=True, valid_for_s=0.3, stamps={'sample': time.monotonic_ns()}))\n"
    "    time.sleep(0.01)"
)


@pytest.mark.live
def test_a_service_killed_and_started_again_is_found_again_by_each_client(runtime):
    loop, heard, silent, sessions = asyncio.new_event_loop(), [], [], set()
    blocking, listening = ContactSubscriber("palm"), ContactListener("palm", heard.append, silent.append)
    waiting = AsyncContactSubscriber("palm")

    def session(call):
        try:
            return call().session
        except Stale:
            return None

    def by_loop():
        return loop.run_until_complete(waiting.next_frame())

    try:
        for _ in range(2):
            with another("-c", RESTARTED):
                sessions.add(until(lambda: session(blocking.next_frame)))
                assert until(lambda: session(by_loop)) in sessions
                until(lambda: sessions == {frame.session for frame in heard})
                silent.clear()
            until(lambda: session(blocking.latest) is None and session(by_loop) is None and silent)
        assert len(sessions) == 2
    finally:
        for each in (blocking, listening, waiting, loop):
            each.close()


@pytest.mark.live
def test_an_offset_is_overestimated_by_its_uncertainty_and_drift_and_forgotten_after_a_minute(monkeypatch):
    """Of the host that frames name, whichever process tells it."""
    hosts, clock = {"publisher": "third", "acquisition": "other"}, Clock()

    class Client:
        def __init__(self, process, timeout_s):
            self.call = lambda command: {"host": hosts[process]}

    monkeypatch.setattr(ages, "time", clock)
    monkeypatch.setattr(ages, "ControlClient", Client)
    monkeypatch.setattr(ages, "clock_offset", lambda _, host: {"other": (5 * S, 1000), "third": (-5 * S, 2000)}[host])
    clocks = OtherClocks(tuple(hosts))
    assert until(lambda: clocks.ahead_ns("other")) == 5 * S + 1000
    assert clocks.ahead_ns("third") == -5 * S + 2000 and clocks.ahead_ns("another") is None
    clock.go(10.0)
    assert clocks.ahead_ns("other") == 5 * S + 1000 + 2e-4 * 10 * S
    clock.go(60.0)
    assert clocks.ahead_ns("other") is None
    clocks.close()
