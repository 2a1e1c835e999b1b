"""A producer's data socket: it sends frames, counts subscribers, and cuts off those that flood it."""

from __future__ import annotations

import os
import secrets
import time
from collections import Counter
from collections.abc import Callable

import zmq

from . import transport
from .frames import SCHEMA, Frame, pack
from .gate import peer_of
from .listening import Listening
from .runtime import host_id
from .topics import TOPIC_OF, wire_topic
from .transport import Context, Socket

SEND_QUEUE = 100
"""Messages held for a subscriber that does not read (100 images: 4 MB); its further ones are dropped, nobody else's."""

RECEIVE_QUEUE = 4
"""Subscriptions held that we have not yet taken in, for each subscriber; it waits with its further ones. With 100
libzmq took in a whole flood at one call, before we could count it: 100 MB instead of 20. With 1 readers did not come
back after the socket was opened anew.
"""

MAX_SUBSCRIPTION = 640
"""Longest subscription in bytes (a topic has 50 at most, a handshake with keys some 400); who sends more is cut off."""

MOST_PREFIXES = 4096
"""Different subscriptions at one time; beyond, the peer with most of them is disconnected. 64 skins have about 600."""

MOST_BYTES = 256 * 1024
"""The same for all their lengths together: libzmq takes some 50 bytes of memory for each byte of a subscription."""

EVENTS_AT_ONCE = 1000
"""Subscriptions taken in by one call of `Publisher.poll`, after which a flood of them cannot hold the producer."""

RETURN_S = 1.0
"""How long the subscriptions of before count after the socket was opened anew: their owners are on their way back."""


class Publisher:
    """A producer's data socket.

    It is an XPUB socket that is told of every subscription and counts them itself. By default ZeroMQ hides a second
    subscription: a late joiner would not get latched values, and `wanted` could not be known. `session` is new with
    each Publisher unless given.
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
        self._holders: dict[bytes, dict[int, int]] = {}  # of each prefix: descriptor -> inode of connections
        self._first_subscriber: dict[bytes, str] = {}  # who first subscribed to each prefix
        self._before: tuple[float, Counter[bytes]] = (0.0, Counter())  # until when, and what was subscribed to
        self._bytes = 0  # of all different subscriptions
        self._flooded_by: str | None = None
        self._listening = Listening(
            context or zmq.Context.instance(),
            zmq.XPUB,
            address or transport.current().data_address(producer),
            {zmq.XPUB_VERBOSER: 1, zmq.SNDHWM: SEND_QUEUE, zmq.RCVHWM: RECEIVE_QUEUE, zmq.MAXMSGSIZE: MAX_SUBSCRIPTION},
        )

    @property
    def socket(self) -> Socket:
        """The socket in use; another one after `mind` has mended something."""
        return self._listening.socket

    @property
    def problems(self) -> list[str]:
        """What status should say of the socket."""
        return self._listening.problems

    def mind(self) -> bool:
        """Check that the socket is still reachable as configured and that nobody floods it, and mend it where needed;
        returns whether `socket` is another one now. Call it at least once a second. Latched values are kept, and so are
        the subscriptions until their owners have come back.
        """
        peer, self._flooded_by = self._flooded_by, None
        if peer is not None:
            self._listening.shed(peer, f"too many subscriptions (at most {MOST_PREFIXES}, {MOST_BYTES} bytes)")
        elif not self._listening.mind():
            return False
        self._before = (time.monotonic() + RETURN_S, Counter(dict(self._subscriptions.most_common(MOST_PREFIXES))))
        if peer is not None:
            flood = {prefix for prefix, who in self._first_subscriber.items() if who == peer}
            self._before = (self._before[0], Counter({p: n for p, n in self._before[1].items() if p not in flood}))
        self._subscriptions.clear()
        self._holders.clear()
        self._first_subscriber.clear()
        self._bytes = 0
        return True

    def _most(self) -> str:
        """The peer whose subscriptions are longest, all together."""
        sizes: Counter[str] = Counter()
        for prefix, peer in self._first_subscriber.items():
            sizes[peer] += 1 + len(prefix)
        return sizes.most_common(1)[0][0]

    def send(self, frame: Frame) -> bytes:
        """Publish a frame; its schema, session and seq are set here, and host and time_ns where it has none yet: the
        stamps of one that came from elsewhere are of that host's clock. Returns the message. Never blocks. Raises
        FrameError.
        """
        topic = TOPIC_OF[type(frame)]
        name = wire_topic(topic.name, frame.skin)
        key = name.decode()
        frame.schema, frame.session, frame.seq = SCHEMA, self.session, self.sent[key]
        if not frame.host:
            frame.host = host_id()
        if not frame.time_ns and frame.host == host_id() and frame.source != "replay" and "sample" in frame.stamps:
            frame.time_ns = frame.stamps["sample"] + time.time_ns() - time.monotonic_ns()
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
        until, before = self._before
        return max(_covering(head, self._subscriptions), _covering(head, before) if time.monotonic() < until else 0)

    def poll(self) -> None:
        """Take in new and ended subscriptions, and send latched values to who has just come. Call it at least once a
        second.

        A latched value goes to all who subscribe to it, not only to the newcomer: readers know it by its seq. Takes in
        EVENTS_AT_ONCE at most; the rest waits for the next call.
        """
        newcomers: list[bytes] = []
        for _ in range(EVENTS_AT_ONCE):
            if self._flooded_by is not None:  # until `mind`
                break
            if not int(self.socket.get(zmq.EVENTS)) & zmq.POLLIN:  # cheaper than an exception with every frame
                break
            newcomers += self._take(self.socket.recv(zmq.NOBLOCK, copy=False))
        if not newcomers:
            return
        for message in self._latched.values():
            if message.startswith(tuple(newcomers)):
                self.socket.send(message, zmq.NOBLOCK)

    def _take(self, received: zmq.Frame) -> list[bytes]:
        """Takes in one subscription that begins or ends; returns the prefix of one that begins."""
        event, prefix = received.bytes[:1], received.bytes[1:]
        if event == b"\0" and prefix in self._subscriptions:
            self._leave(prefix, received)
        if event != b"\1":
            return []
        self._join(prefix, received)
        if self.on_join is not None:
            self.on_join(prefix)
        return [prefix]

    def _join(self, prefix: bytes, received: zmq.Frame) -> None:
        holders, descriptor = self._holders.setdefault(prefix, {}), _descriptor(received)
        inode = _inode(descriptor)
        if not inode or holders.get(descriptor) != inode:
            self._subscriptions[prefix] += 1
        holders[descriptor] = inode
        if prefix not in self._first_subscriber:
            self._first_subscriber[prefix] = peer_of(received, self._listening.secured)
            self._bytes += len(prefix)
        if len(self._first_subscriber) > MOST_PREFIXES or self._bytes > MOST_BYTES:
            self._flooded_by = self._most()

    def _leave(self, prefix: bytes, received: zmq.Frame) -> None:
        """A subscription ends with its connection, of which nothing is known then, or by a word of its holder. Others
        say that word too: a conflating reader's pipe holds one message, so of one that changes its mind before it is
        connected nothing else comes. So the count never falls below the connections that hold it and are still there.
        """
        holders, descriptor = self._holders[prefix], _descriptor(received)
        if descriptor >= 0 and holders.pop(descriptor, None) is None:
            return
        there = sum(inode > 0 and _inode(each) == inode for each, inode in holders.items())
        self._subscriptions[prefix] = max(self._subscriptions[prefix] - 1, there)
        if not self._subscriptions[prefix]:
            del self._subscriptions[prefix], self._holders[prefix]
            self._bytes -= len(prefix)
            self._first_subscriber.pop(prefix, None)

    def close(self) -> None:
        """Close the socket; what is not yet sent is dropped."""
        self._listening.close()


def covers(prefix: bytes, head: bytes) -> bool:
    """Whether a subscription to `prefix` gets the messages that begin with `head`: "" and b"contact/" get those of
    b"contact/palm\0" too.
    """
    return head.startswith(prefix) or prefix.startswith(head)


def _descriptor(event: zmq.Frame) -> int:
    """Of the connection that an event comes from; -1 where that is lost."""
    try:
        return int(event.get(zmq.SRCFD))
    except zmq.ZMQError:
        return -1


def _inode(descriptor: int) -> int:
    """Tells connections apart that had the same descriptor one after the other; 0 of one that is closed."""
    try:
        return os.fstat(descriptor).st_ino
    except OSError:
        return 0


def _covering(head: bytes, subscriptions: Counter[bytes]) -> int:
    return sum(n for prefix, n in subscriptions.items() if covers(prefix, head))
