"""Publishing and subscribing, of bytes and live; sockets that are robbed, deleted or flooded: it is said and mended."""

import contextlib
import itertools
import logging
import os
import shutil
import socket
import stat
from collections import deque
from pathlib import Path

import numpy as np
import pytest
import zmq

from protocol import reconnecting, transport
from protocol.frames import ContactFrame, DeltaFrame, ImageFrame, InfoFrame, PartFrame, RawFrame, StatusFrame, pack
from protocol.publishing import MOST_BYTES, MOST_PREFIXES
from protocol.runtime import endpoint, host_id
from protocol.sockets import AllReader, NewestReader, Publisher, StageReader
from protocol.transport import MAX_MESSAGE, PATIENCE_MS, TransportError
from tests.waiting import until

from .line import Clock
from .peers import another, free_port, subscribed


class Arrived:
    """A reader's socket in which some messages are."""

    def __init__(self):
        self.messages, self.seqs = deque(), {}

    def send(self, frame):
        key = type(frame), frame.skin, frame.session
        self.seqs[key] = frame.seq = frame.seq or self.seqs.get(key, -1) + 1
        self.messages.append(pack(frame))

    def recv(self, _):
        if not self.messages:
            raise zmq.Again
        return self.messages.popleft()

    def poll(self, _):
        return 0

    def told(self, reader):
        found = []
        while (frame := reader.recv()) is not None:
            found.append(frame)
            if not getattr(reader, "more", True):
                break
        return found


@pytest.fixture
def arrived(runtime):
    return Arrived()


@pytest.fixture
def reading(context, arrived):
    made = []

    def make(kind, *args):
        made.append((reader := kind(*args, context=context), reader.socket))
        reader.socket = arrived
        return reader

    yield make
    for reader, own in made:
        reader.socket = own
        reader.close()


@pytest.mark.parametrize("topic", ["delta", "image"])
def test_a_slow_stage_has_what_the_newest_frame_holds(reading, arrived, topic):
    """Without it, nothing could be said of a touch until it changes."""
    reader = reading(StageReader, topic, "palm")

    def told(*sent):
        for scan, *held_from in sent:
            kind = DeltaFrame if topic == "delta" else ImageFrame
            frame = kind(skin="palm", valid=True, scan=scan, touched=True, held=bool(held_from))
            frame.reconstructed = (held_from or [scan])[0]
            if not held_from and topic == "delta":
                frame.averaged = 1
            elif not held_from:
                frame.image = np.ones((2, 2), np.float32)
            arrived.send(frame)
        return [frame.scan for frame in arrived.told(reader)], reader.skipped

    assert told((10,), (20, 10), (30, 10)) == ([10, 30], 1)
    assert told((40, 10), (50, 10)) == ([50], 2), "it has that of 10"
    assert told((60,), (70, 60), (80,)) == ([80], 4), "nothing stands on 60 any more"
    assert told((90,), (95, 60)) == ([95], 5), "it does not hold that of 90"
    raws = reading(StageReader, "raw", "palm")
    for scan in (1, 2, 3):
        arrived.send(RawFrame(skin="palm", scan=scan, z=np.ones(1, "c8"), status=np.zeros(1, "u1")))
    assert [frame.scan for frame in arrived.told(raws)] == [3] and raws.skipped == 2


def test_a_part_comes_after_the_image_that_it_names_whichever_arrives_first(reading, arrived):
    reader = reading(StageReader, "image", "palm")

    def told(*sent):
        for scan, *after in sent:
            part = {"after": after[0]} if after else {}
            arrived.send((PartFrame if after else ImageFrame)(skin="palm", valid=True, scan=scan, **part))
        return [(type(frame).__name__[0], frame.scan) for frame in arrived.told(reader)]

    assert told((1, 0)) == [("P", 1)], "it names none"
    assert told((11, 10), (12, 10)) == [], "of an image that is still to come"
    assert told((10,)) == [("I", 10), ("P", 12)] and reader.skipped == 1
    assert told((13, 10)) == [("P", 13)]
    assert told((14, 10), (20,)) == [("I", 20)] and reader.skipped == 2, "older than the image that came with it"
    assert told((21, 20), (31, 30), (25,), (30,)) == [("I", 30), ("P", 31)] and reader.skipped == 4


def test_readers_of_all_count_what_is_missing_once_and_drop_what_comes_again(reading, arrived):
    reader = reading(AllReader, ["contact", "status"], None)
    for text in "palm a 5,palm a 6,palm a 14,palm a 14,palm a 6,back a 1,palm b 3,back a 2".split(","):
        skin, session, seq = text.split()
        arrived.send(ContactFrame(skin=skin, session=16 * session, seq=int(seq)))
    arrived.send(StatusFrame(skin="palm", process="stub", seq=7))
    assert [frame.seq for frame in arrived.told(reader)] == [5, 6, 14, 1, 3, 2, 7], "a new session is no gap"
    assert (reader.gaps, dict(+reader.lost), reader.repeated) == (7, {"contact/palm": 7}, 2)


@pytest.mark.parametrize("kind", [NewestReader, AllReader])
def test_garbage_is_counted_logged_once_and_dropped(reading, arrived, caplog, kind):
    reader = reading(kind, "contact" if kind is NewestReader else ["contact"], "palm")
    kinds = [b"contact/palm\0", b"contact/palm\0\xc1", b"contact/palm\0\x80", b"contact/palm\0" + os.urandom(50), b"x"]
    with caplog.at_level(logging.WARNING):
        arrived.messages.extend(kinds * 200)  # they cannot hold it
        assert reader.recv() is None and reader.malformed == 1000 and reader.last_error is not None
    assert 1 <= len(caplog.records) <= 3, "once each: no msgpack, a field missing, no topic"
    arrived.send(ContactFrame(skin="palm"))
    assert reader.recv() is not None


@pytest.mark.live
def test_the_newest_frame_of_its_skin_comes_and_older_ones_are_skipped(publisher, context):
    reader, marker = NewestReader("contact", "palm", context=context), AllReader(["contact"], None, context=context)
    subscribed(publisher, count=2)
    mine, theirs = ContactFrame(skin="palm"), ContactFrame(skin="palm", host="another")
    for frame in (*(ContactFrame(skin="palm") for _ in range(50)), mine, theirs, ContactFrame(skin="palm2")):
        publisher.send(frame)
    assert (mine.host, theirs.host) == (host_id(), "another"), "the stamps are of that host's clock"
    until(lambda: (got := marker.recv(1.0)) is not None and got.skin == "palm2")
    got = []
    until(lambda: (frame := reader.recv(0.1)) is not None and (got.append(frame) or frame.seq == 51))
    assert len(got) < 10 and reader.skipped == sum(b.seq - a.seq - 1 for a, b in itertools.pairwise(got))
    assert got[-1].session == publisher.session and reader.recv() is None


@pytest.mark.live
def test_subscribers_are_counted_by_prefix_also_the_second_of_the_same(publisher, context):
    assert not publisher.wanted("force", "palm")
    sockets = []
    for n, prefix in enumerate([b"force/palm\0", b"force/palm\0", b"force/", b""]):
        sockets.append(context.socket(zmq.SUB))
        sockets[-1].connect(endpoint("publisher"))
        sockets[-1].subscribe(prefix)
        subscribed(publisher, "force", "palm", n + 1)
    assert (publisher.subscribers("force", "other"), publisher.subscribers("contact", "palm")) == (2, 1)
    for n, each in enumerate(sockets):
        each.close(0)
        subscribed(publisher, "force", "palm", 3 - n)
    assert not publisher.wanted("force", "palm")
    stage, acquisition = StageReader("raw", "palm", context), Publisher("acquisition", context)
    subscribed(acquisition, "raw")
    hasty, heard = NewestReader("raw", "palm", context=context), []
    hasty.listen(False)  # before it is connected: its pipe holds one message, and this is sent alone
    leave, acquisition._leave = acquisition._leave, lambda *of: heard.append(leave(*of))
    until(lambda: acquisition.poll() or heard)
    assert acquisition.subscribers("raw", "palm") == 1, "what another reader holds is not ended by that"
    stage.listen(False)
    subscribed(acquisition, "raw", count=0)
    stage.ask_again()
    subscribed(acquisition, "raw")
    stage.close()


@pytest.mark.live
def test_every_late_joiner_is_given_the_latched_value_and_repeats_are_no_gaps(runtime, context):
    publisher, readers = Publisher("preprocessing", context), []
    for skin, n in (("palm", 1), ("palm", 2), ("other", 3)):
        publisher.send(InfoFrame(skin=skin, info={"n": n}))
    for n in range(3):
        readers.append(AllReader(["info"], "palm", context=context))
        subscribed(publisher, "info", "palm", n + 1)
        assert readers[n].recv(60.0).info == {"n": 2}
    publisher.send(InfoFrame(skin="palm", info={"n": 4}))
    for reader in readers:
        assert reader.recv(60.0).info == {"n": 4} and (reader.gaps, reader.malformed) == (0, 0)
    assert readers[0].repeated >= 1


@pytest.mark.live
def test_a_peer_that_breaks_the_protocol_leaves_no_reader_deaf(runtime, context, monkeypatch):
    """libzmq never connects again after a breach, not even to the rightful publisher that comes later."""
    monkeypatch.setattr(reconnecting, "time", clock := Clock())
    impostor, address = context.socket(zmq.XPUB), endpoint("publisher")
    impostor.xpub_verboser = 1
    impostor.bind(address)
    readers = NewestReader("contact", "palm", context=context), AllReader(["contact"], "palm", context=context)
    assert {impostor.recv() for _ in readers} == {b"\1contact/palm\0"}
    impostor.send(b"contact/palm\0" + bytes(MAX_MESSAGE + 1))
    assert {impostor.recv() for _ in readers} == {b"\0contact/palm\0"}  # they have left
    impostor.close(0)
    Path(address.removeprefix("ipc://")).unlink(missing_ok=True)
    rightful, heard = Publisher("publisher", context), set()

    def both_hear(later_s):
        clock.go(later_s)
        rightful.mind()  # closing, the impostor's socket may take the file of ours with it
        rightful.poll()
        rightful.send(ContactFrame(skin="palm", valid=True))
        heard.update(reader for reader in readers if reader.recv(0.01) is not None)
        return len(heard) == 2

    until(lambda: both_hear(0.3))
    renewed = [reader._connections.renewed for reader in readers]
    rightful.close()
    rightful = Publisher("publisher", context)
    heard.clear()
    until(lambda: both_hear(0.0))
    for _ in range(10):  # ZeroMQ has connected again by itself: making it anew would lose what is sent meanwhile
        both_hear(0.4)
        [reader.mind() for reader in readers]
    assert renewed == [reader._connections.renewed for reader in readers] and any(renewed)
    for each in (*readers, rightful):
        each.close()


def test_a_peer_over_tcp_that_says_nothing_for_a_while_is_looked_for_anew(runtime, context):
    """Host gone, cable out: without heartbeats a reader, which never sends, would wait for it for ever."""
    reader = NewestReader("contact", "palm", f"tcp://127.0.0.1:{free_port()}", context)
    options = zmq.HEARTBEAT_IVL, zmq.HEARTBEAT_TIMEOUT, zmq.CONNECT_TIMEOUT
    asked_ms, patience_ms, connecting_ms = map(reader.socket.get, options)
    assert 0 < asked_ms < patience_ms == connecting_ms == PATIENCE_MS
    reader.close()


FLOOD = Path(__file__).with_name("flood.py")


def step(publisher, reader=None):
    """A turn of the runner; the frame that came through."""
    publisher.mind()
    publisher.poll()
    publisher.send(ContactFrame(skin="palm"))
    return reader and reader.recv(0.01)


HOLDS = """
import sys, time, zmq
socket = zmq.Context.instance().socket(zmq.PUB)
socket.bind(sys.argv[1])
print("ready", flush=True)
time.sleep(600)
"""


@pytest.mark.live
@pytest.mark.parametrize(
    ("harm", "says"),
    [("deleted", "publisher.ipc was deleted"), ("given to all", "expected 0700"), ("a thief", "put its own socket")],
)
def test_what_is_deleted_or_taken_is_there_again_and_nobody_is_forgotten(publisher, context, runtime, harm, says):
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, reader))
    with contextlib.ExitStack() as thieves:
        if harm == "a thief":  # it takes the file over, as ZeroMQ does
            thief = thieves.enter_context(another("-c", HOLDS, address := f"ipc://{runtime}/publisher.ipc"))
            assert transport.listener(address) == thief.pid
            says = f"process {thief.pid} {says}"
        else:
            shutil.rmtree(runtime)
        if harm == "given to all":
            runtime.mkdir()
            runtime.chmod(0o777)
        until(publisher.mind)
        assert says in " ".join(publisher.problems)
        assert publisher.wanted("contact", "palm")  # while its readers come back
        runtime.chmod(0o700 if harm == "given to all" else stat.S_IMODE(runtime.stat().st_mode))
        since = publisher.sent["contact/palm"]
        until(lambda: (frame := step(publisher, reader)) and frame.seq >= since)
        until(lambda: step(publisher) or publisher.subscribers("contact", "palm") == 1)
        assert stat.S_IMODE(runtime.stat().st_mode) == 0o700
        assert transport.listener(f"ipc://{runtime}/publisher.ipc") == os.getpid()


@pytest.mark.live
def test_an_address_that_is_taken_or_cannot_be_is_refused_and_a_dead_ones_file_is_no_hindrance(context, runtime):
    with another("-c", HOLDS, f"ipc://{runtime}/stub.ipc") as first:
        with pytest.raises(TransportError, match=f"process {first.pid} does already"):
            Publisher("stub", context)
    assert os.path.exists(f"{runtime}/stub.ipc")
    Publisher("stub", context).close()
    with socket.create_server(("127.0.0.1", port := free_port())):
        with pytest.raises(TransportError, match="another program uses it"):
            Publisher("inference", context, address=f"tcp://127.0.0.1:{port}")
    with pytest.raises(TransportError, match="expected ipc://PATH or tcp://HOST:PORT"):
        NewestReader("contact", "palm", endpoint="somewhere", context=context)
    with pytest.raises(ValueError, match="AllReader"):
        NewestReader("status", "palm", context=context)  # of which each process is a producer


@pytest.mark.live
@pytest.mark.parametrize(("length", "count"), [(20, 50_000), (600, 4000)])  # too many; too many bytes
def test_a_flood_of_subscriptions_is_shed_named_and_kept_out(publisher, context, runtime, length, count):
    """Half a million by hand: `python tests/protocol/flood.py ipc://... 500000`."""
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: step(publisher, reader))
    with another(FLOOD, f"ipc://{runtime}/publisher.ipc", count, length) as flood:
        until(lambda: step(publisher) or publisher.problems)
        said = " ".join(publisher.problems)
        assert f"process {flood.pid}" in said
        assert f"too many subscriptions (at most {MOST_PREFIXES}, {MOST_BYTES} bytes)" in said
        own, since = publisher.socket, publisher.sent["contact/palm"]
        until(lambda: (frame := step(publisher, reader)) and frame.seq >= since)
        for _ in range(100):
            publisher.mind()
            publisher.send(ContactFrame(skin="palm"))
            assert reader.recv(60.0) is not None
        assert publisher.socket is own, "it is kept out: no second time"
        assert publisher.subscribers("contact", "palm") == 1
