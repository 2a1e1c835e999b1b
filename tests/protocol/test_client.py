"""What a controller gets: new contacts, or Stale."""

import time

import pytest

from protocol.client import ContactSubscriber, NotValid, Stale
from protocol.frames import ContactFrame
from protocol.sockets import Publisher

from .test_sockets import run, subscribed, until

RESTARTED = (
    "import time; from protocol.sockets import Publisher; from protocol.frames import ContactFrame\n"
    "p = Publisher('publisher'); print('ready', flush=True)\n"
    "while True:\n"
    "    p.send(ContactFrame(skin='palm', valid=True, valid_for_s=0.2, stamps={'publish': time.monotonic_ns()}))\n"
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
    return ContactFrame(
        **{"skin": "palm", "valid": True, "valid_for_s": 5.0, "stamps": {"publish": time.monotonic_ns()}, **fields}
    )


def test_new_contacts_and_stale_ones(publisher):
    with ContactSubscriber("palm") as skin:
        with pytest.raises(Stale, match="no contact frame of palm yet") as caught:
            skin.latest()
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
        publisher.send(frame(valid_for_s=0.01, stamps={"publish": time.monotonic_ns() - 20_000_000}))
        with pytest.raises(Stale, match="expected at most 0.010 s"):
            skin.latest(max_age=5.0, wait_s=0.3)


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
        publisher.send(frame(stamps={"publish": time.monotonic_ns() + 60_000_000_000}))
        assert skin.latest(max_age=0.5, wait_s=1.0).seq == 0
        time.sleep(0.1)
        with pytest.raises(Stale):
            skin.latest(max_age=0.05)


def test_from_another_host_a_frame_that_lay_in_the_socket_is_old(publisher, elsewhere):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(stamps={"publish": 0}))
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
            publisher.send(frame())
            assert next(frames).seq == seq
        with pytest.raises(Stale, match="is .* s old, expected at most 0.250 s"):
            next(frames)
        publisher.send(frame())
        assert next(iter(skin)).seq == 3, "and can be begun anew"


def test_old_frames_are_not_iterated_over(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(stamps={"publish": time.monotonic_ns() - 1_000_000_000}))
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


def is_stale(skin):
    try:
        skin.latest(max_age=0.1)
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
        publisher.send(frame(valid=len(told) != 2, stamps={"publish": time.monotonic_ns()}))

    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame())
        with pytest.raises(ZeroDivisionError):
            skin.run(on_contact, on_stale, max_age=0.3)
    assert told == [0, Stale, NotValid, 2]
