"""Publishing and subscribing: one part per message, counted subscribers, readers that are never behind or never miss
one.

A reader survives anything that arrives: messages that are not frames are counted, logged once per source, and dropped.
Sockets are not thread-safe: each belongs to the thread that uses it.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import zmq

from . import transport
from .control import ControlClient, ControlError, ControlServer, clock_offset
from .frames import DeltaFrame, Frame, FrameError, ImageFrame, PartFrame, unpack
from .logs import foreign
from .publishing import Publisher
from .reconnecting import Connections
from .topics import TOPIC_OF, TOPICS, wire_topic
from .transport import Context, Socket

__all__ = [
    "AllReader", "ControlClient", "ControlError", "ControlServer", "NewestReader", "Publisher", "StageReader",
    "clock_offset",
]  # fmt: skip

ALL_QUEUE = 10_000
"""Messages held in a reader of all."""

GARBAGE_AT_ONCE = 1000
"""Malformed messages dropped in one call, after which a flood of them cannot hold the reader."""

log = logging.getLogger(__name__)


class _Reader:
    """What both readers share: receiving until a frame comes, and handling messages that are not frames."""

    def __init__(self, where: str, socket: Socket, addresses: Mapping[str, str]) -> None:
        self.socket = socket
        self._connections = Connections(socket, addresses)
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
                self.mind()
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
                        "dropped a malformed message from %s (further ones are only counted): %s",
                        self._where,
                        foreign(bad),
                    )
        return None

    def mind(self) -> None:
        """Connect anew where ZeroMQ has given up. To be called now and then by who waits for the socket himself."""
        self._connections.mind()

    def close(self) -> None:
        """Close the socket."""
        self._connections.close()
        self.socket.close(0)


class _SkippingReader(_Reader):
    """Topics of one skin, each from its one producer; frames that were not read are counted."""

    def __init__(
        self,
        topics: Sequence[str],
        skin: str,
        addresses: Mapping[str, str],
        context: Context | None,
        options: dict[int, int],
    ) -> None:
        socket = transport.connect(context or zmq.Context.instance(), zmq.SUB, addresses, options)
        super().__init__(", ".join(addresses.values()), socket, addresses)
        self.skipped = 0
        """Frames that were overtaken by newer ones before we read them (or lost on the way)."""
        self._names = [wire_topic(topic, skin) + b"\0" for topic in topics]
        self._last: dict[type[Frame], tuple[str, int]] = {}
        self.listen(True)

    def listen(self, on: bool) -> None:
        """Subscribe, or no longer."""
        for name in self._names:
            (self.socket.subscribe if on else self.socket.unsubscribe)(name)

    def _count(self, frame: Frame) -> None:
        """Count what is missing between the last frame of its topic and this one."""
        last = self._last.get(type(frame))
        if last is not None and last[0] == frame.session and frame.seq > last[1]:
            self.skipped += frame.seq - last[1] - 1
        self._last[type(frame)] = frame.session, frame.seq


class NewestReader(_SkippingReader):
    """The newest frame of one topic of one skin; older ones are skipped.

    CONFLATE, because a high-water mark bounds neither the age of what is queued nor the kernel's buffers; one topic
    and skin per socket, because a conflating socket holds one message, whatever its topic. About one frame in a million
    is lost although it is the newest: where it arrives while we look (libzmq 4.3.5, dbuffer_t::write). The next one
    makes up for it.
    """

    def __init__(self, topic: str, skin: str, endpoint: str | None = None, context: Context | None = None) -> None:
        producers = TOPICS[topic].producers
        if endpoint is None and len(producers) > 1:
            raise ValueError(f"{topic} has several producers: name an endpoint, or read it with AllReader")
        addresses = {producers[0]: endpoint or transport.current().data_address(producers[0])}
        self.topic, self.skin = topic, skin
        super().__init__([topic], skin, addresses, context, {zmq.CONFLATE: 1})

    def recv(self, timeout_s: float = 0.0) -> Frame | None:
        """The newest frame not yet read, waiting up to `timeout_s` for one; None when there is none. Never raises on
        bad input.
        """
        got = self.recv_message(timeout_s)
        return got[0] if got else None

    def recv_message(self, timeout_s: float = 0.0) -> tuple[Frame, bytes] | None:
        """The newest frame not yet read together with its message, for who forwards it."""
        got = self._receive(timeout_s)
        if got is not None:
            self._count(got[0])
        return got


STAGE_QUEUE = 200
"""Messages held in a stage's reader, from each producer: nine seconds of whole scans, about one of parts."""


class StageReader(_SkippingReader):
    """What a stage reads of one skin: the newest raw, delta or image frame; beside images the newest part after it.
    Older ones are skipped, but not the one whose reconstruction or image a newer one holds: that comes first. A part
    comes after the image of the scan that it names, whichever of the two arrives first; one that names none at once.

    A queue that is emptied at every call, and not CONFLATE, which loses a frame now and then (see NewestReader):
    nothing makes up for one of a replay, whose next frame waits for what becomes of it.
    """

    def __init__(self, topic: str, skin: str, context: Context | None = None) -> None:
        topics = ("image", "part") if topic == "image" else (topic,)
        producers = {TOPICS[each].producers[0] for each in topics}
        addresses = {name: transport.current().data_address(name) for name in sorted(producers)}
        super().__init__(topics, skin, addresses, context, {zmq.RCVHWM: STAGE_QUEUE})
        self._whole: list[Frame] = []  # that wait: the newest, and before it the one that it holds
        self._part: PartFrame | None = None
        self._after = -1  # scan of the image frame that was read last

    def ask_again(self) -> None:
        """Subscribe anew, so that upstream sends its latched values and held image again."""
        self.listen(False)
        self.listen(True)

    @property
    def more(self) -> bool:
        """Whether another frame is here already, whatever the socket says."""
        return bool(self._whole) or (self._part is not None and self._part.after in (self._after, 0))

    def recv(self, timeout_s: float = 0.0) -> Frame | None:
        """The next frame, waiting up to `timeout_s` for one; None when there is none. Never raises on bad input."""
        for n in range(STAGE_QUEUE):  # more come with the next call: a flood of them cannot hold us
            got = self._receive(0.0 if n or self.more else timeout_s)
            if got is None:
                break
            self._count(got[0])
            self._enqueue(got[0])
        if self._whole:
            frame = self._whole.pop(0)
            self._after = frame.scan
            if self._part is not None and self._part.after < frame.scan:
                self._part, self.skipped = None, self.skipped + 1  # of before that image
            return frame
        if not self.more:
            return None
        part, self._part = self._part, None
        return part

    def _enqueue(self, frame: Frame) -> None:
        """Let a frame wait to be read, in place of those that it makes old."""
        if isinstance(frame, PartFrame):
            self.skipped += self._part is not None
            self._part = frame
            return
        held = [each for each in self._whole[:1] if _holds(frame, each)]
        self.skipped += len(self._whole) - len(held)
        self._whole = [*held, frame]


def _holds(frame: Frame, older: Frame) -> bool:
    """Whether a frame says no more than that all is as in an older one, which its reader needs."""
    if not (isinstance(frame, DeltaFrame | ImageFrame) and isinstance(older, DeltaFrame | ImageFrame)):
        return False
    own, theirs = (each.averaged if isinstance(each, DeltaFrame) else each.image.size for each in (frame, older))
    return frame.held and frame.reconstructed == older.reconstructed and theirs > 0 and not own


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
        socket = transport.connect(context or zmq.Context.instance(), zmq.SUB, addresses, {zmq.RCVHWM: ALL_QUEUE})
        super().__init__(endpoint or ", ".join(addresses), socket, addresses)
        self.gaps = 0
        """Frames that are missing between those received."""
        self.lost: Counter[str] = Counter()
        """The same, by "topic/skin"."""
        self.repeated = 0
        """Frames received again (latched values sent for others), and dropped."""
        self._last: dict[tuple[str, str, str], int] = {}
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
