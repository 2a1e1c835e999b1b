"""Publishing and subscribing: one part per message, counted subscribers, readers that are never behind or never miss
one.

A reader survives anything that arrives: what is no frame is counted, logged once per source, and dropped. Sockets are
not thread-safe: each belongs to the thread that uses it.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterable

import zmq

from . import transport
from .control import ControlClient, ControlError, ControlServer, clock_offset
from .frames import SCHEMA, Frame, FrameError, pack, unpack
from .runtime import host_id
from .topics import TOPIC_OF, TOPICS, wire_topic
from .transport import Context, Socket

__all__ = ["AllReader", "ControlClient", "ControlError", "ControlServer", "NewestReader", "Publisher", "clock_offset"]

SEND_QUEUE = 100
"""Messages held for a subscriber that does not read (100 images: 4 MB); its further ones are dropped, nobody else's."""
ALL_QUEUE = 10_000
"""Messages held in a reader of all."""

EVENTS_AT_ONCE = 1000
"""Subscriptions taken in by one call of `Publisher.poll`, after which a flood of them cannot hold the producer."""

GARBAGE_AT_ONCE = 1000
"""Malformed messages dropped in one call, after which a flood of them cannot hold the reader."""

log = logging.getLogger(__name__)


def covers(prefix: bytes, head: bytes) -> bool:
    """Whether a subscription to `prefix` gets the messages that begin with `head`: "" and b"contact/" get those of
    b"contact/palm\0" too.
    """
    return head.startswith(prefix) or prefix.startswith(head)


class Publisher:
    """A producer's data socket.

    XPUB that is told of every subscription and counts them itself: by default ZeroMQ hides the second one, so that a
    late joiner would not get latched values and `wanted` could not be known. `session` is new with each Publisher
    unless given.
    """

    def __init__(
        self, producer: str, context: Context | None = None, *, address: str | None = None, session: str | None = None
    ):
        self.producer = producer
        self.session = session or secrets.token_hex(8)
        self.sent: Counter[str] = Counter()
        """Messages sent, by "topic/skin"."""
        self.on_join: Callable[[bytes], None] | None = None
        """Called in `poll` with each new subscription's prefix."""
        self._subscriptions: Counter[bytes] = Counter()
        self._latched: dict[bytes, bytes] = {}
        self.socket: Socket = transport.bind(
            context or zmq.Context.instance(),
            zmq.XPUB,
            address or transport.current().data_address(producer),
            {zmq.XPUB_VERBOSER: 1, zmq.SNDHWM: SEND_QUEUE},
        )

    def send(self, frame: Frame) -> bytes:
        """Publish a frame; its schema, session and seq are set here, and its host where it has none yet: the stamps of
        one that came from elsewhere are of that host's clock. Returns the message. Never blocks. Raises FrameError.
        """
        topic = TOPIC_OF[type(frame)]
        name = wire_topic(topic.name, frame.skin)
        key = name.decode()
        frame.schema, frame.session, frame.seq = SCHEMA, self.session, self.sent[key]
        frame.host = frame.host or host_id()
        message = pack(frame)
        self.poll()
        self.socket.send(message, zmq.NOBLOCK)
        self.sent[key] += 1
        if topic.latched:
            self._latched[name] = message
        return message

    def renew(self) -> None:
        """Begin a new session: frames count from 0 again."""
        self.session = secrets.token_hex(8)
        self.sent.clear()

    def wanted(self, topic: str, skin: str) -> bool:
        """Whether anybody subscribes to it, as of the last `poll` or `send`."""
        return self.subscribers(topic, skin) > 0

    def subscribers(self, topic: str, skin: str) -> int:
        """How many subscriptions cover the topic."""
        head = wire_topic(topic, skin) + b"\0"
        return sum(n for prefix, n in self._subscriptions.items() if covers(prefix, head))

    def poll(self) -> None:
        """Take in new and ended subscriptions, and send latched values to who has just come. Call it at least once a
        second.

        A latched value goes to all who subscribe to it, not only to the newcomer: readers know it by its seq. Takes in
        EVENTS_AT_ONCE at most; the rest waits for the next call.
        """
        newcomers = []
        for _ in range(EVENTS_AT_ONCE):
            if not int(self.socket.get(zmq.EVENTS)) & zmq.POLLIN:  # cheaper than an exception with every frame
                break
            event = self.socket.recv(zmq.NOBLOCK)
            if event[:1] == b"\1":
                self._subscriptions[event[1:]] += 1
                newcomers.append(event[1:])
                if self.on_join is not None:
                    self.on_join(event[1:])
            elif event[:1] == b"\0" and event[1:] in self._subscriptions:
                self._subscriptions[event[1:]] -= 1
                if self._subscriptions[event[1:]] <= 0:
                    del self._subscriptions[event[1:]]
        if newcomers:
            for message in self._latched.values():
                if any(message.startswith(prefix) for prefix in newcomers):
                    self.socket.send(message, zmq.NOBLOCK)

    def close(self) -> None:
        """Close the socket; what is not yet sent is dropped."""
        self.socket.close(0)


class _Reader:
    """What both readers share: receiving until a frame comes, and what to do with what is none."""

    socket: Socket

    def __init__(self, where: str) -> None:
        self.malformed = 0
        """Messages dropped because they were no frames."""
        self.last_error: FrameError | None = None
        self._where = where
        self._logged: set[tuple[str, str]] = set()

    def _receive(self, timeout_s: float) -> tuple[Frame, bytes] | None:
        """The next frame and its message; None when none came within `timeout_s` (0: what is there now)."""
        deadline = time.monotonic() + timeout_s
        for _ in range(GARBAGE_AT_ONCE):
            try:
                message = self.socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                left = deadline - time.monotonic()
                if left <= 0 or not self.socket.poll(max(1, int(left * 1000 + 0.5))):
                    return None
                continue
            try:
                return unpack(message), message
            except FrameError as bad:
                self.malformed += 1
                self.last_error = bad
                source = (bad.topic, bad.field)
                if source not in self._logged and len(self._logged) < 100:
                    self._logged.add(source)
                    log.warning(
                        "dropped a malformed message from %s (further ones are only counted): %s", self._where, bad
                    )
        return None

    def close(self) -> None:
        """Close the socket."""
        self.socket.close(0)


class NewestReader(_Reader):
    """The newest frame of one topic of one skin; older ones are skipped.

    CONFLATE, because a high-water mark bounds neither the age of what is queued nor the kernel's buffers; one topic
    and skin per socket, because a conflating socket holds one message, whatever its topic.
    """

    def __init__(self, topic: str, skin: str, endpoint: str | None = None, context: Context | None = None) -> None:
        producers = TOPICS[topic].producers
        if endpoint is None and len(producers) > 1:
            raise ValueError(f"{topic} has several producers: name an endpoint, or read it with AllReader")
        address = endpoint or transport.current().data_address(producers[0])
        super().__init__(address)
        self.topic, self.skin = topic, skin
        self.skipped = 0
        """Frames that were overtaken by newer ones before we read them (or lost on the way)."""
        self._last: tuple[str, int] | None = None
        self.socket = transport.connect(
            context or zmq.Context.instance(), zmq.SUB, {producers[0]: address}, {zmq.CONFLATE: 1}
        )
        self.socket.subscribe(wire_topic(topic, skin) + b"\0")

    def recv(self, timeout_s: float = 0.0) -> Frame | None:
        """The newest frame not yet read, waiting up to `timeout_s` for one; None when there is none. Never raises on
        bad input.
        """
        got = self._receive(timeout_s)
        if got is None:
            return None
        frame = got[0]
        if self._last is not None and self._last[0] == frame.session and frame.seq > self._last[1]:
            self.skipped += frame.seq - self._last[1] - 1
        self._last = (frame.session, frame.seq)
        return frame


class AllReader(_Reader):
    """Every frame of some topics, of one skin or of all (None); missing ones are counted.

    `endpoint` overrides the address for all producers; by default it connects to each producer of the topics.
    """

    def __init__(
        self,
        topics: Iterable[str],
        skin: str | None = None,
        endpoint: str | None = None,
        context: Context | None = None,
    ) -> None:
        topics = tuple(topics)
        names = sorted({producer for topic in topics for producer in TOPICS[topic].producers})
        addresses = {name: endpoint or transport.current().data_address(name) for name in names}
        if endpoint:
            addresses = dict(list(addresses.items())[:1])
        super().__init__(endpoint or ", ".join(addresses))
        self.gaps = 0
        """Frames that are missing between those received."""
        self.lost: Counter[str] = Counter()
        """The same, by "topic/skin"."""
        self.repeated = 0
        """Frames received again (latched values sent for others), and dropped."""
        self._last: dict[tuple[str, str, str], int] = {}
        self.socket = transport.connect(context or zmq.Context.instance(), zmq.SUB, addresses, {zmq.RCVHWM: ALL_QUEUE})
        for topic in topics:
            self.socket.subscribe(wire_topic(topic, skin) + b"\0" if skin else wire_topic(topic, ""))

    def recv(self, timeout_s: float = 0.0) -> Frame | None:
        """The next frame, waiting up to `timeout_s` for it; None when none came. Never raises on bad input."""
        got = self.recv_message(timeout_s)
        return got[0] if got else None

    def recv_message(self, timeout_s: float = 0.0) -> tuple[Frame, bytes] | None:
        """The next frame together with its message, for who stores or forwards it."""
        deadline = time.monotonic() + timeout_s
        while got := self._receive(max(0.0, deadline - time.monotonic())):
            if self._is_new(got[0]):
                return got
        return None

    def _is_new(self, frame: Frame) -> bool:
        topic = f"{TOPIC_OF[type(frame)].name}/{frame.skin}"
        key = (topic, frame.session, frame.host)
        last = self._last.pop(key, None)
        self._last[key] = frame.seq if last is None else max(last, frame.seq)
        while len(self._last) > 1000:  # sessions of processes long gone
            del self._last[next(iter(self._last))]
        if last is None:
            return True
        if frame.seq <= last:
            self.repeated += 1
            return False
        self.gaps += frame.seq - last - 1
        self.lost[topic] += frame.seq - last - 1
        return True
