"""What a controller gets: new contacts, or Stale."""

import time

import pytest

from protocol.client import ContactSubscriber, Stale
from protocol.frames import ContactFrame
from protocol.sockets import Publisher

from .test_sockets import subscribed


@pytest.fixture
def publisher(runtime, context):
    return Publisher("publisher", context)


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


def test_replayed_frames_are_ignored_unless_asked_for(publisher):
    with ContactSubscriber("palm") as live, ContactSubscriber("palm", replay=True) as told:
        subscribed(publisher, count=2)
        publisher.send(frame(source="replay"))
        assert told.latest(max_age=5.0, wait_s=1.0).source == "replay"
        with pytest.raises(Stale):
            live.latest(max_age=5.0, wait_s=0.2)
        assert live.replayed == 1


def test_iterating(publisher):
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        for seq, got in zip(range(3), publishing(publisher, skin), strict=False):
            assert got.seq == seq


def publishing(publisher, skin):
    frames = iter(skin)
    while True:
        publisher.send(frame())
        yield next(frames)
