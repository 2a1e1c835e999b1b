"""Ages by this host's clock: of frames from here, from another host, and from before this host slept."""

import threading
import time

import pytest

from protocol import ages
from protocol.ages import Ages
from protocol.client import ContactSubscriber, Stale
from protocol.control import ControlClient, ControlError, ControlServer, clock_offset
from protocol.runtime import host_id
from protocol.sockets import Publisher

from .test_client import ago, frame
from .test_sockets import subscribed, until

pytestmark = pytest.mark.live

AHEAD_NS = 7_000 * 10**9
"""Of the other host's clock: it has been up for longer."""


@pytest.fixture
def asked_often(monkeypatch):
    monkeypatch.setattr(ages, "ASK_AGAIN_S", 0.05)


@pytest.fixture
def hosts(runtime, context):
    """Starts processes that say that they run on this and that host, with clocks of their own."""
    ending, threads = threading.Event(), []

    def start(process, host, ahead_ns):
        def serve():
            clock = lambda _: {"monotonic_ns": time.monotonic_ns() + ahead_ns, "host": host}  # noqa: E731
            server = ControlServer(process, {"clock": clock}, context=context)
            while not ending.is_set():
                server.serve_once(0.05)
            server.close()

        threads.append(threading.Thread(target=serve))
        threads[-1].start()

    yield start
    ending.set()
    for thread in threads:
        thread.join()


def there(**fields):
    """A frame of another host, `sample` by its clock."""
    return frame(host="another", **fields)


def stamps_there(age_s):
    return {key: stamp + AHEAD_NS for key, stamp in ago(age_s).items()}


def test_a_clock_is_asked_of_the_right_host_only(hosts):
    hosts("publisher", "another", AHEAD_NS)
    client = ControlClient("publisher", 5.0)
    offset, uncertainty = clock_offset(client, host="another")
    assert abs(offset - AHEAD_NS) <= uncertainty
    with pytest.raises(ControlError, match="another host than third") as caught:
        clock_offset(client, host="third")
    assert caught.value.kind == "other_host"


def test_another_hosts_frames_are_aged_by_its_own_clock(hosts, asked_often):
    """The publisher's clock is not that of the board's host: the one that the frames name counts."""
    hosts("publisher", "third", -AHEAD_NS)
    hosts("acquisition", "another", AHEAD_NS)
    watch = Ages()
    try:
        until(lambda: age(watch, there(stamps=stamps_there(0.9))) >= 0.9)
        assert age(watch, there(stamps=stamps_there(0.9))) < 5.0
        assert age(watch, there(stamps=stamps_there(0.0))) < 0.9
        assert age(watch, frame(host="fourth", stamps=stamps_there(0.9))) < 2.0, "reception, and what the stamps prove"
    finally:
        watch.close()


def age(watch, of):
    now = time.monotonic_ns()
    measured = watch.measured_ns(of, now)
    assert measured is not None
    return watch.age_s(measured)


def test_without_its_clock_a_frame_is_as_old_as_its_own_stamps_prove(runtime):
    watch = Ages()
    try:
        assert 0.9 <= age(watch, there(stamps=stamps_there(0.9))) < 5.0
        assert age(watch, there(stamps={"sample": 5})) < 5.0
        assert watch.measured_ns(there(stamps={"publish": 5}), 0) is None
    finally:
        watch.close()


def test_a_late_frame_of_another_host_is_stale_although_it_has_just_come(runtime, context, hosts, asked_often):
    hosts("publisher", "another", AHEAD_NS)
    publisher = Publisher("publisher", context)
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)

        def refused():
            stamps = {"sample": time.monotonic_ns() + AHEAD_NS - 900_000_000}  # proves nothing of its latency
            publisher.send(there(valid_for_s=0.5, stamps=stamps))
            try:
                skin.next_frame(2.0)
            except Stale as why:
                return why.age_s is not None and why.age_s >= 0.9
            return False

        until(refused)


def test_a_frame_keeps_the_host_that_it_was_measured_on(runtime, context):
    publisher = Publisher("publisher", context)
    mine, theirs = frame(), there()
    publisher.send(mine)
    publisher.send(theirs)
    assert (mine.host, theirs.host) == (host_id(), "another")


def test_a_host_that_slept_counts_the_time(monkeypatch):
    """Its monotonic clock did not; CLOCK_BOOTTIME did."""
    slept = [5 * 10**9]
    monkeypatch.setattr(ages, "_slept_ns", lambda: slept[0])
    watch = Ages()
    before = watch.measured_ns(frame(), time.monotonic_ns())
    assert watch.age_s(before) < 5.0 and not watch.look()
    slept[0] += 60 * 10**9
    assert watch.age_s(before) >= 60.0
    after = watch.measured_ns(frame(), time.monotonic_ns())
    assert watch.age_s(after) < 5.0
    slept[0] += 60 * 10**9
    assert watch.look() and not watch.look()
    assert watch.age_s(after) >= 60.0 and watch.age_s(before) >= 120.0


def test_what_a_client_got_before_its_host_slept_is_stale(runtime, context, monkeypatch):
    publisher, slept = Publisher("publisher", context), [0]
    monkeypatch.setattr(ages, "_slept_ns", lambda: slept[0])
    with ContactSubscriber("palm") as skin:
        subscribed(publisher)
        publisher.send(frame(valid_for_s=30.0))
        assert skin.latest(valid=True).seq == 0
        slept[0] = 60 * 10**9
        with pytest.raises(Stale, match=r"is [6-9]\d\.\d+ s old"):
            skin.latest(valid=True)
