"""Publishing and subscribing over real sockets, with real processes killed and stopped."""

import itertools
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zmq

from protocol.frames import (
    ContactFrame,
    DeltaFrame,
    ForceFrame,
    ImageFrame,
    InfoFrame,
    PartFrame,
    RawFrame,
    StatusFrame,
)
from protocol.reconnecting import GRACE_S
from protocol.runtime import endpoint
from protocol.sockets import AllReader, NewestReader, Publisher, StageReader
from protocol.transport import MAX_MESSAGE

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]


def until(condition, timeout_s=5.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def subscribed(publisher, topic="contact", skin="palm", count=1):
    def check():
        publisher.poll()
        return publisher.subscribers(topic, skin) == count

    until(check)


def run(code):
    """A process of our code that says "ready" once."""
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    return process


@pytest.fixture
def publisher(runtime, context):
    return Publisher("publisher", context)


@pytest.fixture
def publisher_of_images(runtime, context):
    return Publisher("inference", context)


def told_by(reader):
    time.sleep(0.2)
    found = []
    while (frame := reader.recv()) is not None:
        found.append(frame.scan)
        if not reader.more:
            break
    return found


@pytest.mark.parametrize("topic", ["delta", "image"])
def test_a_slow_reader_has_what_the_newest_frame_holds(runtime, context, topic):
    """Without it, nothing could be said of a touch until it changes."""
    producer = Publisher("preprocessing" if topic == "delta" else "inference", context)
    reader = StageReader(topic, "palm", context)
    subscribed(producer, topic)

    def send(scan, held_from=None):
        kind = DeltaFrame if topic == "delta" else ImageFrame
        frame = kind(skin="palm", valid=True, scan=scan, touched=True, held=held_from is not None)
        frame.reconstructed = scan if held_from is None else held_from
        if held_from is None and topic == "delta":
            frame.averaged = 1
        elif held_from is None:
            frame.image = np.ones((2, 2), np.float32)
        producer.send(frame)

    send(10)
    send(20, held_from=10)
    send(30, held_from=10)
    assert told_by(reader) == [10, 30] and reader.skipped == 1
    send(40, held_from=10)
    send(50, held_from=10)
    assert told_by(reader) == [50] and reader.skipped == 2, "it has that of 10"
    send(60)
    send(70, held_from=60)
    send(80)
    assert told_by(reader) == [80] and reader.skipped == 4, "nothing stands on 60 any more"
    reader.close()
    producer.close()


def test_a_slow_stage_reads_the_newest_raw_frame(runtime, context):
    producer, reader = Publisher("acquisition", context), StageReader("raw", "palm", context)
    subscribed(producer, "raw")

    def send(scan):
        producer.send(
            RawFrame(skin="palm", valid=True, scan=scan, z=np.ones(1, np.complex64), status=np.zeros(1, np.uint8))
        )

    for scan in (1, 2, 3):
        send(scan)
    assert told_by(reader) == [3] and reader.skipped == 2
    send(4)
    assert told_by(reader) == [4] and reader.skipped == 2
    reader.close()
    producer.close()


def test_a_part_comes_after_the_image_that_it_names_whichever_arrives_first(publisher_of_images, context):
    parts, reader = Publisher("preprocessing", context), StageReader("image", "palm", context)
    subscribed(publisher_of_images, "image")
    subscribed(parts, "part")

    def image(scan):
        publisher_of_images.send(ImageFrame(skin="palm", valid=True, scan=scan))

    def part(scan, after):
        parts.send(PartFrame(skin="palm", valid=True, scan=scan, after=after))

    def told():
        time.sleep(0.2)
        found = []
        while (frame := reader.recv()) is not None:
            found.append((type(frame).__name__, frame.scan))
            if not reader.more:
                break
        return found

    part(11, after=10)
    part(12, after=10)
    assert told() == [], "of an image that is still to come"
    image(10)
    assert told() == [("ImageFrame", 10), ("PartFrame", 12)] and reader.skipped == 1
    part(13, after=10)
    assert told() == [("PartFrame", 13)]
    part(14, after=10)
    image(20)
    assert told() == [("ImageFrame", 20)] and reader.skipped == 2, "older than the image that came with it"
    part(21, after=20)
    part(31, after=30)
    image(25)
    image(30)
    assert told() == [("ImageFrame", 30), ("PartFrame", 31)] and reader.skipped == 4
    reader.listen(False)
    deadline = time.monotonic() + 10
    while parts.subscribers("part", "palm") and time.monotonic() < deadline:
        parts.poll()
        time.sleep(0.01)
    assert not parts.subscribers("part", "palm")
    reader.close()
    parts.close()


def test_the_newest_frame_comes_and_older_ones_are_skipped(publisher, context):
    reader = NewestReader("contact", "palm", context=context)
    subscribed(publisher)
    for _ in range(50):
        publisher.send(ContactFrame(skin="palm", valid=True))
    time.sleep(0.2)
    frame = reader.recv(1.0)
    assert (frame.seq, frame.session) == (49, publisher.session)
    assert reader.recv(0.0) is None
    publisher.send(ContactFrame(skin="palm"))
    assert reader.recv(1.0).seq == 50 and reader.skipped == 0


def test_a_reader_takes_its_skin_only(publisher, context):
    reader = NewestReader("contact", "palm", context=context)
    subscribed(publisher)
    publisher.send(ContactFrame(skin="palm2"))
    publisher.send(ForceFrame(skin="palm"))
    assert reader.recv(0.1) is None


def test_subscribers_are_counted_by_prefix_also_the_second_of_the_same(publisher, context):
    assert not publisher.wanted("force", "palm")
    sockets = []
    for n, prefix in enumerate([b"force/palm\0", b"force/palm\0", b"force/", b""]):
        socket = context.socket(zmq.SUB)
        socket.connect(endpoint("publisher"))
        socket.subscribe(prefix)
        sockets.append(socket)
        subscribed(publisher, "force", "palm", n + 1)
    assert publisher.subscribers("force", "other") == 2
    assert publisher.subscribers("contact", "palm") == 1
    for n, socket in enumerate(sockets):
        socket.close(0)
        subscribed(publisher, "force", "palm", 3 - n)
    assert not publisher.wanted("force", "palm")


def test_a_flood_of_subscriptions_does_not_hold_the_publisher(publisher, context, monkeypatch):
    monkeypatch.setattr("protocol.publishing.EVENTS_AT_ONCE", 3)  # libzmq has up to 8 for us, and then the next ones
    socket = context.socket(zmq.SUB)
    socket.connect(endpoint("publisher"))
    for n in range(35):
        socket.subscribe(b"contact/palm\0%d" % n)
    time.sleep(0.3)
    counts = [0]

    def all_taken_in():
        publisher.poll()
        counts.append(publisher.subscribers("contact", "palm"))
        return counts[-1] == 35

    until(all_taken_in)
    assert max(later - before for before, later in itertools.pairwise(counts)) == 3
    socket.close(0)


def test_a_killed_subscriber_is_no_longer_counted(publisher, runtime):
    code = (
        "import time; from protocol.sockets import NewestReader; r = NewestReader('force', 'palm')\n"
        "print('ready', flush=True); time.sleep(60)"
    )
    process = run(code)
    subscribed(publisher, "force", "palm", 1)
    process.kill()
    process.communicate()
    subscribed(publisher, "force", "palm", 0)


def test_every_late_joiner_is_given_the_latched_value_and_repeats_are_no_gaps(runtime, context):
    publisher = Publisher("preprocessing", context)
    publisher.send(InfoFrame(skin="palm", info={"n": 1}))
    publisher.send(InfoFrame(skin="palm", info={"n": 2}))
    publisher.send(InfoFrame(skin="other", info={"n": 3}))
    readers = []
    for n in range(3):
        readers.append(AllReader(["info"], "palm", context=context))
        subscribed(publisher, "info", "palm", n + 1)
        assert readers[n].recv(1.0).info == {"n": 2}
    publisher.send(InfoFrame(skin="palm", info={"n": 4}))
    for reader in readers:
        assert reader.recv(1.0).info == {"n": 4}
        assert reader.recv(0.05) is None
        assert (reader.gaps, reader.malformed) == (0, 0)
    assert readers[0].repeated >= 1


def test_all_readers_get_all_and_count_what_is_missing(publisher, context):
    reader = AllReader(["contact"], None, context=context)
    subscribed(publisher)
    for _ in range(500):
        publisher.send(ContactFrame(skin="palm"))
        if publisher.sent["contact/palm"] % 50 == 0:
            time.sleep(0.01)
    assert [reader.recv(1.0).seq for _ in range(500)] == list(range(500))
    publisher.sent["contact/palm"] += 7
    publisher.send(ContactFrame(skin="palm"))
    assert reader.recv(1.0).seq == 507
    assert (reader.gaps, dict(reader.lost)) == (7, {"contact/palm": 7})


def test_status_comes_from_every_process(runtime, context):
    publishers = [Publisher(name, context) for name in ("acquisition", "inference")]
    reader = AllReader(["status"], "palm", context=context)
    for publisher in publishers:
        subscribed(publisher, "status")
        publisher.send(StatusFrame(skin="palm", process=publisher.producer))
    assert {reader.recv(1.0).process for _ in publishers} == {"acquisition", "inference"}
    with pytest.raises(ValueError, match="AllReader"):
        NewestReader("status", "palm", context=context)


@pytest.mark.parametrize("kind", [NewestReader, AllReader])
def test_garbage_is_counted_logged_once_and_dropped(publisher, context, caplog, kind):
    reader = kind("contact" if kind is NewestReader else ["contact"], "palm", context=context)
    subscribed(publisher)
    kinds = [b"contact/palm\0", b"contact/palm\0\xc1", b"contact/palm\0\x80", b"contact/palm\0" + os.urandom(50)]
    with caplog.at_level(logging.WARNING):
        for n, bad in enumerate(kinds * 3):
            publisher.socket.send(bad)
            until(lambda n=n: reader.recv(0.05) is None and reader.malformed == n + 1)
        publisher.socket.send_multipart([b"contact/palm\0", b"\x80"])  # a conflating socket loses these by itself
        until(lambda: reader.recv(0.05) is None and (kind is NewestReader or reader.malformed == 14))
    assert 1 <= len(caplog.records) <= 3, "once each: no msgpack, a field missing, no topic"
    publisher.send(ContactFrame(skin="palm"))
    assert reader.recv(1.0) is not None


def test_a_stopped_subscriber_hurts_neither_the_others_nor_memory(runtime, context):
    publisher = Publisher("inference", context)
    stopped = run(
        "import time; from protocol.sockets import NewestReader; r = NewestReader('image', 'palm')\n"
        "print('ready', flush=True)\nwhile True: r.recv(1.0)"
    )
    reader = NewestReader("image", "palm", context=context)
    try:
        subscribed(publisher, "image", count=2)
        os.kill(stopped.pid, signal.SIGSTOP)
        before, worst, image = memory_kb(), 0.0, np.zeros((96, 96), "f4")
        for n in range(500):  # 18 MB
            began = time.monotonic()
            publisher.send(ImageFrame(skin="palm", image=image))
            worst = max(worst, time.monotonic() - began)
            if n % 50 == 49:
                assert reader.recv(1.0) is not None
        assert worst < 0.1, "send blocked"
        assert memory_kb() - before < 9_000
    finally:
        stopped.kill()
        stopped.communicate()


def memory_kb():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def test_a_killed_publisher_comes_back_and_its_readers_find_it(runtime, context):
    code = (
        "import time; from protocol.sockets import Publisher; from protocol.frames import ContactFrame\n"
        "p = Publisher('publisher'); print('ready', flush=True)\n"
        "while True: p.send(ContactFrame(skin='palm')); time.sleep(0.01)"
    )
    reader = NewestReader("contact", "palm", context=context)
    every = AllReader(["contact"], "palm", context=context)
    sessions = []
    for _ in range(2):
        process = run(code)
        try:
            began = time.monotonic()
            until(
                lambda: (
                    (f := reader.recv(0.05)) is not None
                    and f.session not in sessions
                    and not sessions.append(f.session)
                )
            )
            assert time.monotonic() - began < 1.0
        finally:
            process.kill()
            process.communicate()
    assert len(set(sessions)) == 2
    while every.recv(0.05):
        pass
    assert every.gaps == 0, "a new session is no gap"


def test_an_address_that_is_no_address_is_an_error_for_humans(runtime, context):
    from protocol.transport import TransportError

    with pytest.raises(TransportError, match="expected ipc://PATH or tcp://HOST:PORT"):
        NewestReader("contact", "palm", endpoint="somewhere", context=context)
    with pytest.raises(TransportError, match="cannot listen at"):
        Publisher("publisher", context, address="ipc:///nowhere/at/all.ipc")


@pytest.mark.parametrize("kind", ["ipc", "tcp"])
@pytest.mark.parametrize("breach", ["a message beyond all limits", "bytes that are none of ZeroMQ's"])
def test_a_peer_that_breaks_the_protocol_leaves_no_reader_deaf(runtime, context, kind, breach):
    """libzmq never connects again after a breach, not even to the rightful publisher that comes later."""
    address = endpoint("publisher") if kind == "ipc" else "tcp://127.0.0.1:47631"
    newest = NewestReader("contact", "palm", address, context)
    every = AllReader(["contact"], "palm", address, context)
    if breach.startswith("a message"):
        impostor = context.socket(zmq.XPUB)
        impostor.xpub_verboser = 1
        impostor.bind(address)
        assert {impostor.recv() for _ in range(2)} == {b"\1contact/palm\0"}
        impostor.send(b"contact/palm\0" + bytes(MAX_MESSAGE + 1))
        time.sleep(0.2)
        impostor.close(0)
    else:
        with socket.socket(socket.AF_UNIX if kind == "ipc" else socket.AF_INET) as impostor:
            impostor.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            impostor.bind(address.removeprefix("ipc://") if kind == "ipc" else ("127.0.0.1", 47631))
            impostor.listen()
            peers = [impostor.accept()[0] for _ in range(2)]
            for peer in peers:
                peer.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL" + bytes(48) + 50 * b"\4\xff")
            time.sleep(0.2)
            for peer in peers:
                peer.close()
    time.sleep(0.2)
    if kind == "ipc":
        Path(address.removeprefix("ipc://")).unlink(missing_ok=True)
    rightful = Publisher("publisher", context, address=address)
    heard = set()

    def both_hear():
        rightful.poll()
        rightful.send(ContactFrame(skin="palm", valid=True))
        heard.update(reader for reader in (newest, every) if reader.recv(0.01) is not None)
        return len(heard) == 2

    until(both_hear, 8.0)
    newest.close()
    every.close()
    rightful.close()


def test_a_connection_that_only_was_silent_is_left_alone(runtime, context, publisher):
    """Making it anew would lose what is sent meanwhile; and one that ZeroMQ has made again by itself needs it not."""
    reader = NewestReader("contact", "palm", context=context)
    subscribed(publisher)

    def look_for_longer_than_zeromq_needs(publisher):
        end = time.monotonic() + 2 * GRACE_S
        while time.monotonic() < end:
            reader.recv(0.05)
            publisher.poll()
        return publisher.subscribers("contact", "palm") == 1

    assert look_for_longer_than_zeromq_needs(publisher)
    publisher.close()
    again = Publisher("publisher", context)
    until(lambda: not again.mind() and look_for_longer_than_zeromq_needs(again), 20.0)
    assert reader._connections.renewed == 0
    reader.close()
    again.close()
