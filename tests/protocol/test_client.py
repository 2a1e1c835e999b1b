"""What a controller gets: new contacts, or Stale."""

import threading
import time

import pytest

from protocol.client import ContactSubscriber, NotValid, Stale
from protocol.frames import Contact, ContactFrame
from protocol.sockets import Publisher

from .test_sockets import run, subscribed, until

pytestmark = pytest.mark.live

RESTARTED = (
    "import time; from protocol.sockets import Publisher; from protocol.frames import ContactFrame\n"
    "p = Publisher('publisher'); print('ready', flush=True)\n"
    "while True:\n"
    "    p.send(ContactFrame(skin='palm', valid=True, valid_for_s=0.2, stamps={'sample': time.monotonic_ns()}))\n"
    "    time.sleep(0.01)"
)
"""A publisher in a process of its own, to be killed."""


@pytest.fixture
def publisher(runtime, context):
    return Publisher("publisher", context)


@pytest.fixture
def elsewhere(monkeypatch):
    """The publisher's frames come from another host, whose clock says nothing here."""
    monkeypatch.setattr("protocol.publishing.host_id", lambda: "another")


def frame(**fields):
    return ContactFrame(**{"skin": "palm", "valid": True, "valid_for_s": 5.0, "stamps": ago(0.0), **fields})


def ago(seconds):
    """Stamps of a frame that was measured so long ago, and read and published just now."""
    now = time.monotonic_ns()
    return {"sample": now - int(seconds * 1e9), "read": now, "publish": now}


def test_new_contacts_and_stale_ones(publisher):
    with ContactSubscriber("palm") as skin:
        with pytest.raises(Stale, match="no contact frame of palm yet") as caught:
            skin.latest(wait_s=0.0)
        assert caught.value.age_s is None
        subscribed(publisher)
        publisher.send(frame())
        assert skin.latest(max_age=0.5, wait_s=1.0).seq == 0
        time.sleep(0.1)
        with pytest.raises(Stale, match="expected at most 0.050 s") as caught:
            skin.latest(max_age=0.05)
        assert 0.1 <= caught.value.age_s < 1.0
        assert skin.latest(max_age=5.0).seq == 0


def test_a_frame_is_stale_once_its_own_time_is_over(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid_for_s=0.01, stamps=ago(0.02)))
        with pytest.raises(Stale, match="expected at most 0.010 s"):
            skin.latest(max_age=5.0, wait_s=0.3)


def test_a_frame_that_says_nothing_of_its_age_or_how_long_it_holds_is_stale(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(stamps={"publish": time.monotonic_ns()}))
        with pytest.raises(Stale, match="does not say when it was measured"):
            skin.latest()
        publisher.send(frame(valid_for_s=0.0))

        def refused():
            with pytest.raises(Stale) as caught:
                skin.latest(max_age=5.0)
            return "expected at most 0.000 s" in str(caught.value)

        until(refused)


def test_latest_waits_for_the_first_frame_only_and_takes_the_frame_s_own_bound(publisher):
    """Right after connecting there is none yet; later nothing may hold up a controller."""
    with ContactSubscriber("palm") as skin, ContactSubscriber("none") as nobody:
        sending = threading.Timer(0.3, lambda: (subscribed(publisher), publisher.send(frame(valid_for_s=0.5))))
        sending.start()
        try:
            first = skin.latest(valid=True)
        finally:
            sending.join()
        assert first.seq == 0
        until(lambda: is_stale(skin, None))
        began = time.monotonic()
        for _ in range(20):
            with pytest.raises(Stale, match="expected at most 0.500 s"):
                skin.latest(valid=True)
        assert time.monotonic() - began < 0.5, "20 questions, none of which waited"
        with pytest.raises(Stale, match="yet"):
            nobody.latest()
        began = time.monotonic()
        for _ in range(20):
            with pytest.raises(Stale, match="yet"):
                nobody.latest()
        assert time.monotonic() - began < 0.5, "1 s in all, not each time"


def test_next_frame_waits_as_long_as_the_newest_one_holds(publisher):
    """Of a slow board a frame every 0.4 s is no silence."""
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid_for_s=30.0))
        assert skin.next_frame().seq == 0
        sending = threading.Timer(0.4, lambda: publisher.send(frame(valid_for_s=0.3)))
        sending.start()
        assert skin.next_frame(valid=True).seq == 1
        sending.join()
        began = time.monotonic()
        with pytest.raises(Stale):
            skin.next_frame()
        assert 0.25 <= time.monotonic() - began < 10.0


def test_age_counts_from_when_the_skin_was_measured(publisher):
    """However lately it was published."""
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid_for_s=0.25, stamps=ago(0.9)))
        with pytest.raises(Stale, match=r"is [01]\.\d+ s old, expected at most 0.250 s") as caught:
            skin.latest(valid=True)
        assert caught.value.age_s >= 0.9
        publisher.send(frame(source="board", valid_for_s=0.25, stamps=ago(0.9)))
        with pytest.raises(Stale):
            skin.next_frame(0.3)


def test_a_late_frame_that_says_so_is_told_at_once(publisher):
    """Who waits for a frame to act on does not wait for silence while invalid ones come."""
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid=False, reasons=["late"], valid_for_s=0.25, stamps=ago(0.9)))
        with pytest.raises(NotValid, match="late"):
            skin.next_frame(20.0, valid=True)


def test_a_replayed_frame_counts_from_when_it_was_read(publisher):
    with ContactSubscriber("palm", replay=True) as skin:
        subscribed(publisher)
        stamps = {"sample": 5_000_000, "read": time.monotonic_ns()}
        publisher.send(frame(source="replay", stamps=stamps))
        assert skin.latest(valid=True).seq == 0
        publisher.send(frame(source="replay", stamps=stamps | {"read": time.monotonic_ns() - 6 * 10**9}))
        until(lambda: is_stale(skin, None))
        with pytest.raises(Stale, match=r"is \d+\.\d+ s old, expected at most 5.000 s") as caught:
            skin.latest()
        assert caught.value.age_s >= 6.0


def test_the_end_of_a_touch_that_was_never_told_of_is_left_out(publisher):
    def contacts(*states):
        return [Contact(id=n, state=state, position=[0.0, 0.0, 0.0]) for n, state in states]

    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        for sent, told in (
            ([(7, "end"), (8, "hold")], [(8, "hold")]),
            ([(9, "begin"), (8, "hold")], [(9, "begin"), (8, "hold")]),
            ([(8, "end"), (9, "hold")], [(8, "end"), (9, "hold")]),
            ([(9, "end"), (3, "end")], [(9, "end")]),
        ):
            publisher.send(frame(contacts=contacts(*sent)))
            assert [(c.id, c.state) for c in skin.next_frame(5.0).contacts] == told
        publisher.renew()
        publisher.send(frame(contacts=contacts((9, "end"))))
        assert skin.next_frame(5.0).contacts == [], "the ids of another session are other touches"


def test_a_frame_that_is_not_valid_is_given_only_to_who_does_not_ask_for_a_valid_one(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid=False, reasons=["saturated", "gap"]))
        assert skin.latest(max_age=5.0, wait_s=1.0).reasons == ["saturated", "gap"]
        with pytest.raises(Stale, match="not valid: saturated, gap") as caught:
            skin.latest(max_age=5.0, valid=True)
        assert isinstance(caught.value, NotValid) and caught.value.frame.seq == 0
        publisher.send(frame(valid=False))
        with pytest.raises(NotValid, match="no reason given"):
            skin.next_frame(5.0, valid=True)
        publisher.send(frame())
        assert skin.latest(max_age=5.0, wait_s=1.0, valid=True).seq == 2


def test_a_stamp_from_the_future_does_not_keep_a_frame_new(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(stamps=ago(-60)))
        assert skin.latest(max_age=0.5, wait_s=1.0).seq == 0
        time.sleep(0.1)
        with pytest.raises(Stale):
            skin.latest(max_age=0.05)


def test_from_another_host_a_frame_that_lay_in_the_socket_is_old(publisher, elsewhere):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(stamps={"sample": 0, "publish": 0}))
        assert skin.latest(max_age=0.5, wait_s=1.0).host == "another", "waited for: its age is known"
        publisher.send(frame())
        time.sleep(0.3)
        with pytest.raises(Stale) as caught:
            skin.latest(max_age=0.2)
        assert caught.value.age_s >= 0.3
        publisher.send(frame())
        time.sleep(0.3)
        with pytest.raises(Stale):
            skin.next_frame(0.2)
        publisher.send(frame())
        assert skin.next_frame(1.0).seq == 3


def test_replayed_frames_are_ignored_unless_asked_for(publisher):
    with ContactSubscriber("palm") as live, ContactSubscriber("palm", replay=True) as told:
        subscribed(publisher, count=2)
        publisher.send(frame(source="replay"))
        assert told.latest(max_age=5.0, wait_s=1.0).source == "replay"
        with pytest.raises(Stale, match=r"1 replayed ones were ignored \(replay=True"):
            live.latest(max_age=5.0, wait_s=0.2)
        assert live.replayed == 1


def test_what_is_no_frame_is_named(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.socket.send(b"contact/palm\0\x80")
        with pytest.raises(Stale, match="1 malformed ones were dropped, the last because .*schema"):
            skin.latest(wait_s=0.3)


def test_iterating_gives_each_new_frame_once_and_ends_with_silence(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        frames = iter(skin)
        for seq in range(3):
            publisher.send(frame(valid_for_s=0.25))
            assert next(frames).seq == seq
        with pytest.raises(Stale, match="is .* s old, expected at most 0.250 s"):
            next(frames)
        publisher.send(frame())
        assert next(iter(skin)).seq == 3, "and can be begun anew"


def test_old_frames_are_not_iterated_over(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid_for_s=0.25, stamps=ago(1.0)))
        with pytest.raises(Stale, match="expected at most 0.250 s"):
            next(iter(skin))


def test_a_service_killed_and_started_again_is_found_again(runtime):
    sessions = set()
    with ContactSubscriber("palm") as skin:
        for _ in range(2):
            process = run(RESTARTED)
            try:
                until(lambda: not is_stale(skin))
                sessions.add(skin.latest(max_age=1.0).session)
            finally:
                process.kill()
                process.communicate()
            until(lambda: is_stale(skin))
    assert len(sessions) == 2


def is_stale(skin, max_age=0.1):
    try:
        skin.latest(max_age, wait_s=0.0)
    except Stale:
        return True
    return False


def test_run_calls_one_of_the_two_and_ends_with_their_exceptions(publisher):
    told = []

    def on_contact(got):
        told.append(got.seq)
        if got.seq == 2:
            raise ZeroDivisionError("no contact to divide by")

    def on_stale(why):
        told.append(type(why))
        publisher.send(frame(valid=len(told) != 2))

    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame())
        with pytest.raises(ZeroDivisionError):
            skin.run(on_contact, on_stale, max_age=0.3)
    assert told == [0, Stale, NotValid, 2]
