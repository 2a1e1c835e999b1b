"""What a bridge reads of one skin: contacts and images, each subscribed to only while somebody wants it, and given out
only while it may be acted on.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from protocol.ages import Ages
from protocol.frames import ContactFrame, ImageFrame
from protocol.freshness import NewestContacts, NotValid, Stale
from protocol.held import HeldImage
from protocol.runtime import host_id
from protocol.sockets import NewestReader
from protocol.topics import wire_topic
from protocol.transport import Socket


@dataclass(frozen=True)
class Refusal:
    """There is nothing to hand on, and why."""

    why: str


@dataclass(frozen=True)
class Measured:
    """Contacts that may be acted on, and when the skin was measured, by this host's monotonic clock."""

    frame: ContactFrame
    measured_ns: int


@dataclass(frozen=True)
class Picture:
    """An image that may be shown as the present one."""

    frame: ImageFrame
    measured_ns: int


class ContactFeed:
    """The newest contacts of a skin."""

    def __init__(self, skin: str, replay: bool = False) -> None:
        self._skin, self._replay = skin, replay
        self._newest: NewestContacts | None = None
        self._heard = 0.0
        self.skipped = 0
        """Frames overtaken by newer ones before we took them."""
        self.late = 0
        """Frames that could no longer be acted on when they came."""

    def want(self, wanted: bool) -> None:
        """Subscribe, or no longer."""
        if wanted and self._newest is None:
            self._newest, self._heard = NewestContacts(self._skin, replay=self._replay), time.monotonic()
        elif not wanted and self._newest is not None:
            self._newest.close()
            self._newest = None
        if self._newest is not None:
            self._newest.reader.mind()
            self.skipped = self._newest.reader.skipped

    def sockets(self) -> Iterator[Socket]:
        if self._newest is not None:
            yield self._newest.reader.socket

    def take(self, waited_ns: int) -> Measured | Refusal | None:
        """The frame that has come since the last call, or why it is not handed on; None where none has come."""
        if self._newest is None:
            return None
        came = bool(self._newest.reader.socket.poll(0))
        if came:
            self._newest.woken(waited_ns)
        try:
            frame = self._newest.fresh(None, valid=True)
        except NotValid as why:
            self._heard = time.monotonic()
            return Refusal(str(why))
        measured_ns = self._newest.measured_ns
        if frame is None or measured_ns is None:
            self.late += came
            return None
        self._heard = time.monotonic()
        return Measured(frame, measured_ns)

    def silence(self) -> Refusal | None:
        """Why nothing comes, once nothing has for longer than the newest frame was valid."""
        if self._newest is None or time.monotonic() - self._heard < self._newest.silence_s(None):
            return None
        try:
            self._newest.judge(None, valid=True)
        except Stale as why:
            return Refusal(str(why))
        return None

    def close(self) -> None:
        self.want(False)


class ImageFeed:
    """The newest image of a skin, a held one put in again."""

    def __init__(self, skin: str, replay: bool = False) -> None:
        self._skin, self._replay = skin, replay
        self._reader: NewestReader | None = None
        self._ages = Ages()
        self._held = HeldImage()

    def want(self, wanted: bool) -> None:
        """Subscribe, or no longer."""
        if wanted and self._reader is None:
            self._reader = NewestReader("image", self._skin)
        elif not wanted and self._reader is not None:
            self._reader.close()
            self._reader = None
        if self._reader is not None:
            self._reader.mind()

    def sockets(self) -> Iterator[Socket]:
        if self._reader is not None:
            yield self._reader.socket

    def take(self, waited_ns: int) -> Picture | None:
        """The image that has come since the last call, where it may be shown. One of another host has come since
        `waited_ns`, and more is not known.
        """
        if self._reader is None:
            return None
        frame = self._reader.recv(0.0)
        if not isinstance(frame, ImageFrame) or (frame.source == "replay" and not self._replay):
            return None
        here = frame.host in ("", host_id())
        measured_ns = self._ages.measured_ns(frame, time.monotonic_ns() if here else waited_ns)
        if not self._held.complete(frame):
            head = wire_topic("image", self._skin) + b"\0"
            self._reader.socket.unsubscribe(head)  # whoever subscribes is sent it again
            self._reader.socket.subscribe(head)
            return None
        if not frame.valid or measured_ns is None or self._ages.age_s(measured_ns) > frame.valid_for_s:
            return None
        return Picture(frame, measured_ns)

    def close(self) -> None:
        self.want(False)
        self._ages.close()
