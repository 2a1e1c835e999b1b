"""The newest messages of one skin, read only while somebody looks."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from protocol.ages import Ages
from protocol.frames import Frame, ImageFrame, InfoFrame, StackFrame, StatusFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader, NewestReader
from protocol.topics import TOPIC_OF, TOPICS

NEWEST = ("contact", "image", "delta", "stack", "truth", "shape")
"""Topics that a viewer may ask for. Status and info come with any of them."""
LOOK_S = 0.1
"""How often all sockets are looked at. In between a scan's contacts have them looked at: what they were made of has
come before them, and being woken for each of it costs more than all the rest.
"""
GATHER_S = 0.003
"""How long contacts wait for the outlines that follow them, so that a scan is one message."""
ASK_AGAIN_S = 0.5

Reconstruction = tuple[str, int]
"""Which picture a frame shows: the session and scan that it was reconstructed from."""


@dataclass(frozen=True, slots=True)
class Latest:
    """The newest message of a topic. `measured_ns`: by this host's clock, None where that is not known."""

    version: int
    measured_ns: int | None
    message: bytes
    picture: Reconstruction | None = None


class SkinFeed:
    """Belongs to one event loop. `tell` is called when there is news for viewers, and whether contacts are among it."""

    def __init__(self, skin: str, tell: Callable[[bool], None], folder: Path | None = None) -> None:
        """folder: the runtime folder of a replay, whose sockets are not those of the service."""
        self.skin, self._tell, self._folder = skin, tell, folder
        self.latest: dict[str, Latest] = {}
        """By topic; of status by "status/PROCESS"."""
        self.pictures: dict[str, Latest] = {}
        """The frames of `image` and `stack` that brought the newest picture: those that hold it come without."""
        self.source = ""
        """Of the newest contact frame: board, stub, replay; "" while nobody looks, or nothing has come."""
        self._watched: Counter[str] = Counter()
        self._readers: dict[str, NewestReader | AllReader] = {}
        self._ages: Ages | None = None
        self._version = 0
        self._empty_ns = 0  # all sockets were empty then
        self._asked = 0.0
        self._look: asyncio.TimerHandle | None = None
        self._listening = False  # for contacts

    def watch(self, topics: Iterable[str]) -> None:
        """Somebody looks at these."""
        self._watched.update(topic for topic in topics if topic in NEWEST)
        self._adjust()

    def unwatch(self, topics: Iterable[str]) -> None:
        """He does no more."""
        self._watched.subtract(topic for topic in topics if topic in NEWEST)
        self._watched = +self._watched
        self._adjust()

    def _adjust(self) -> None:
        wanted = {*self._watched, "status"} if self._watched else set()
        for topic in wanted - self._readers.keys():
            self._open(topic)
        for topic in self._readers.keys() - wanted:
            self._close(topic)
        if not wanted:
            self._forget()
        elif self._look is None:
            self._empty_ns = time.monotonic_ns()
            self._looked()

    def _open(self, topic: str) -> None:
        producer = "preprocessing" if topic == "status" else TOPICS[topic].producers[0]
        address = None if self._folder is None else f"ipc://{self._folder}/{producer}.ipc"
        every = topic == "status"
        reader = AllReader(["status", "info"], self.skin, address) if every else NewestReader(topic, self.skin, address)
        self._readers[topic] = reader
        if topic == "contact":
            self._listen()

    def _close(self, topic: str) -> None:
        reader = self._readers.pop(topic)
        if topic == "contact":
            asyncio.get_running_loop().remove_reader(int(reader.socket.fileno()))
            self._listening = False
        reader.close()
        for known in (self.latest, self.pictures):
            for key in list(known):
                if key.partition("/")[0] == topic or (topic == "status" and key == "info"):
                    del known[key]

    def _forget(self) -> None:
        """Nobody looks: no socket, no timer, no thread."""
        if self._look is not None:
            self._look.cancel()
        self._look = None
        if self._ages is not None:
            self._ages.close()
            self._ages = None
        self.source = ""

    def _looked(self) -> None:
        """Take in what has come, all of it: ZeroMQ tells of it at the edge only."""
        looked_ns, heard = time.monotonic_ns(), set()
        for reader in tuple(self._readers.values()):
            while (got := reader.recv_message()) is not None:
                heard.add(self._take(*got, looked_ns))
        self._empty_ns = looked_ns
        if heard:
            self._tell("contact" in heard)
        self._listen()
        self._look_in(LOOK_S)

    def _look_in(self, seconds: float) -> None:
        if self._look is not None:
            self._look.cancel()
        self._look = asyncio.get_running_loop().call_later(seconds, self._looked)

    def _listen(self) -> None:
        """Be woken by the next contacts."""
        reader = self._readers.get("contact")
        if reader is not None and not self._listening:
            self._listening = True
            asyncio.get_running_loop().add_reader(int(reader.socket.fileno()), self._spoken)

    def _spoken(self) -> None:
        """Something is to be read of the contacts; its file goes on to say so until it was."""
        asyncio.get_running_loop().remove_reader(int(self._readers["contact"].socket.fileno()))
        self._listening = False
        self._look_in(GATHER_S)

    def _take(self, frame: Frame, message: bytes, now: int) -> str:
        topic = key = TOPIC_OF[type(frame)].name
        if self._ages is None:
            self._ages = Ages()
        # Another host's frame may have lain in the socket since that was last seen empty; our own say when.
        measured = self._ages.measured_ns(frame, now if frame.host in ("", host_id()) else self._empty_ns)
        if isinstance(frame, StatusFrame):
            key = f"status/{frame.process}"
        elif topic == "contact":
            self.source = frame.source
        self._version += 1
        shown = picture(frame)
        self.latest[key] = Latest(self._version, measured, message, shown)
        if isinstance(frame, (ImageFrame, StackFrame)):
            if brings(frame):
                self.pictures[topic] = self.latest[key]
            elif isinstance(frame, ImageFrame) and shown is not None and not self._has(topic, shown):
                self._ask_again(topic)
        return "info" if isinstance(frame, InfoFrame) else topic

    def _has(self, topic: str, shown: Reconstruction) -> bool:
        return topic in self.pictures and self.pictures[topic].picture == shown

    def _ask_again(self, topic: str) -> None:
        """Subscribe anew: whoever subscribes is sent the held picture with the next frame."""
        now, reader = time.monotonic(), self._readers.get(topic)
        if now - self._asked < ASK_AGAIN_S or reader is None:
            return
        self._asked, name = now, f"{topic}/{self.skin}\0".encode()
        reader.socket.unsubscribe(name)
        reader.socket.subscribe(name)

    def close(self) -> None:
        self._watched.clear()
        self._adjust()


def brings(frame: Frame) -> bool:
    """Whether a frame brings a picture of its own."""
    if isinstance(frame, ImageFrame):
        return frame.image.size > 0
    return isinstance(frame, StackFrame)


def picture(frame: Frame) -> Reconstruction | None:
    """Which picture a frame brings or holds; None where nothing is to be shown."""
    if isinstance(frame, StackFrame) or (isinstance(frame, ImageFrame) and (brings(frame) or frame.held)):
        return frame.session, frame.reconstructed
    return None
