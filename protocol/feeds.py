"""What a bridge reads of one skin: contacts and images, each subscribed to only while somebody wants it, and given out
only while it may be acted on.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

from .ages import Ages
from .frames import ContactFrame, Frame, ImageFrame
from .freshness import NewestContacts, NotValid, Stale
from .held import HeldImage
from .runtime import host_id
from .sockets import NewestReader
from .topics import wire_topic
from .transport import Socket


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


class ContactPace:
    """At most so many frames a second, and at once each that says something else than the last one: a contact that
    begins, comes to be known otherwise, or ends.
    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = int(1e9 / rate_hz)
        self._due_ns = 0
        self._said: object = None

    def passes(self, found: Measured) -> bool:
        """Whether a frame is handed on."""
        frame, at_ns = found.frame, found.measured_ns
        says = frame.session, sorted(frame.reasons), [(c.id, c.state, c.shape) for c in frame.contacts]
        news = says != self._said
        if not news and self._due_ns - self._period_ns <= at_ns < self._due_ns:
            return False
        # On its grid while nothing is new, so that parts whose own period is no share of ours keep the rate.
        self._due_ns = self._period_ns + (at_ns if news else max(self._due_ns, at_ns - self._period_ns))
        self._said = says
        return True

    def refused(self) -> None:
        """There was nothing to hand on: whatever comes next is new."""
        self._said = None


class ContactFeed:
    """The newest contacts of a skin, rate_hz times a second at most."""

    def __init__(self, skin: str, replay: bool = False, *, rate_hz: float) -> None:
        self._skin, self._replay = skin, replay
        self._pace = ContactPace(rate_hz)
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
        """The frame that has come since the last call, or why it is not handed on; None where none has come, or one too
        soon after the last that says the same.
        """
        if self._newest is None:
            return None
        came = bool(self._newest.reader.socket.poll(0))
        if came:
            self._newest.woken(waited_ns)
        try:
            frame = self._newest.fresh()
        except NotValid as why:
            self._heard = time.monotonic()
            self._pace.refused()
            return Refusal(str(why))
        measured_ns = self._newest.measured_ns
        if frame is None or measured_ns is None:
            self.late += came
            return None
        self._heard = time.monotonic()
        found = Measured(frame, measured_ns)
        return found if self._pace.passes(found) else None

    def silence(self) -> Refusal | None:
        """Why nothing comes, once nothing has for longer than the newest frame was valid."""
        if self._newest is None or time.monotonic() - self._heard < self._newest.silence_s(None):
            return None
        try:
            self._newest.judge()
        except Stale as why:
            return Refusal(str(why))
        return None

    def close(self) -> None:
        self.want(False)


class NewestFeed:
    """The newest frame of one topic of a skin, whatever it says."""

    def __init__(self, topic: str, skin: str) -> None:
        self._topic, self._skin = topic, skin
        self._reader: NewestReader | None = None

    def want(self, wanted: bool) -> None:
        """Subscribe, or no longer."""
        if wanted and self._reader is None:
            self._reader = NewestReader(self._topic, self._skin)
        elif not wanted and self._reader is not None:
            self._reader.close()
            self._reader = None
        if self._reader is not None:
            self._reader.mind()

    def sockets(self) -> Iterator[Socket]:
        if self._reader is not None:
            yield self._reader.socket

    def recv(self) -> Frame | None:
        """The frame that has come since the last call."""
        return None if self._reader is None else self._reader.recv(0.0)

    def ask_again(self) -> None:
        """Have sent again what whoever subscribes is sent."""
        if self._reader is not None:
            head = wire_topic(self._topic, self._skin) + b"\0"
            self._reader.socket.unsubscribe(head)
            self._reader.socket.subscribe(head)

    def close(self) -> None:
        self.want(False)


class ImageFeed(NewestFeed):
    """The newest image of a skin, a held one put in again."""

    def __init__(self, skin: str, replay: bool = False) -> None:
        super().__init__("image", skin)
        self._replay = replay
        self._ages = Ages()
        self._held = HeldImage()

    def take(self, waited_ns: int) -> Picture | None:
        """The image that has come since the last call, where it may be shown. One of another host has come since
        `waited_ns`, and more is not known.
        """
        frame = self.recv()
        if not isinstance(frame, ImageFrame) or (frame.source == "replay" and not self._replay):
            return None
        here = frame.host in ("", host_id())
        measured_ns = self._ages.measured_ns(frame, time.monotonic_ns() if here else waited_ns)
        if not self._held.complete(frame):
            self.ask_again()
            return None
        if not frame.valid or measured_ns is None or self._ages.age_s(measured_ns) > frame.valid_for_s:
            return None
        return Picture(frame, measured_ns)

    def close(self) -> None:
        super().close()
        self._ages.close()
