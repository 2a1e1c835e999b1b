"""Whether the newest contact frame of a skin may be acted on: its age, its `valid`, and the errors that say no.

Nothing here waits: client.py does so in a thread, aio.py in an event loop.
"""

from __future__ import annotations

import time

from .ages import Ages
from .errors import EitskinError
from .frames import ContactFrame
from .runtime import host_id
from .sockets import NewestReader

SILENCE_S = 0.25
"""So long without a first frame is silence; later it is the newest frame's own `valid_for_s`."""
FIRST_S = 1.0
"""So long `latest` waits for the first frame of a subscription."""
MOST_SEEN = 1024
"""Contacts remembered: more than can be there at once."""

WAIT_SLICE_S = 0.1
"""Longest single wait for a frame: what a longer one wakes to has come while the whole process was stopped."""


class Stale(EitskinError, RuntimeError):
    """There is no contact frame that is new enough: stop, or fall back.

    `age_s` is the age of the newest one, None where there was none.
    """

    def __init__(self, message: str, age_s: float | None = None) -> None:
        super().__init__(message)
        self.age_s = age_s


class NotValid(Stale):
    """The newest frame is new, but says that it must not be acted on; `frame.reasons` say why.

    A kind of Stale, so that one `except Stale: robot.stop()` stops for both.
    """

    def __init__(self, frame: ContactFrame, age_s: float | None) -> None:
        reasons = ", ".join(frame.reasons) or "no reason given"
        super().__init__(f"the newest contact frame of {frame.skin} is not valid: {reasons}", age_s)
        self.frame = frame


class NewestContacts:
    """The newest contact frame of a skin and when it was measured, as far as this host can know (ages.py).

    A frame of another host may have waited in the socket; it is only known to have come after the socket was last seen
    empty.
    """

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin, self.replay = skin, replay
        self.reader = NewestReader("contact", skin, endpoint)
        self.replayed = 0
        self._ages = Ages()
        self._frame: ContactFrame | None = None
        self._measured_ns: int | None = None
        self._empty_ns = time.monotonic_ns()
        self._first_by: float | None = None  # when to give up waiting for the first frame
        self._session = ""
        self._seen: dict[int, None] = {}  # ids of contacts that were given out, oldest first

    @property
    def measured_ns(self) -> int | None:
        """When the newest frame was measured, by our monotonic clock; None where it does not say."""
        return self._measured_ns

    def take(self) -> bool:
        """Take in the newest frame that has arrived; whether there was one."""
        looked_ns = time.monotonic_ns()
        frame = self.reader.recv(0.0)
        received_ns, self._empty_ns = self._empty_ns, looked_ns
        if not isinstance(frame, ContactFrame):
            return False
        if frame.source == "replay" and not self.replay:
            self.replayed += 1
            return False
        here = frame.host == host_id()  # a stamp of ours says when; one from the future would make it look new for long
        self._measured_ns = self._ages.measured_ns(frame, time.monotonic_ns() if here else received_ns)
        self._frame = frame
        self._take_out_ended(frame)
        return True

    def _take_out_ended(self, frame: ContactFrame) -> None:
        """What has ended goes to `ended`, or nowhere where nobody was told that it had begun."""
        if frame.session != self._session:
            self._session, self._seen = frame.session, {}
        frame.note_ended([c for c in frame.contacts if c.state == "end" and c.id in self._seen])
        frame.contacts = [c for c in frame.contacts if c.state != "end"]
        self._seen.update(dict.fromkeys(c.id for c in frame.contacts))
        while len(self._seen) > MOST_SEEN:
            del self._seen[next(iter(self._seen))]

    def woken(self, since_ns: int) -> None:
        """The socket, empty at `since_ns`, has become readable: what is in it has come just now."""
        now = time.monotonic_ns()
        if now - since_ns < 1.5 * WAIT_SLICE_S * 1e9 and not self._ages.look():
            self._empty_ns = now

    def first_by(self) -> float:
        """Until when `latest` waits by default: FIRST_S from its first call for the first frame, and not at all once
        that has come.
        """
        if self._first_by is None:
            self._first_by = time.monotonic() + FIRST_S
        return self._first_by if self._frame is None else 0.0

    def silence_s(self, max_age: float | None) -> float:
        """How long to wait for the next frame: by default as long as the newest one is valid."""
        if max_age is not None:
            return max_age
        return max(SILENCE_S, self._frame.valid_for_s) if self._frame is not None else FIRST_S

    def judge(self, max_age: float | None = None, allow_invalid: bool = False) -> ContactFrame:
        """The newest frame where it is at most `max_age` seconds old and within its own `valid_for_s`, else Stale;
        NotValid where it must not be acted on, unless that is allowed.
        """
        frame, age = self._frame, self._age()
        if frame is None or age is None or not age <= self._limit(max_age):
            raise self.stale(max_age)
        if not (frame.valid or allow_invalid):
            raise NotValid(frame, age)
        return frame

    def fresh(self, max_age: float | None = None, allow_invalid: bool = False) -> ContactFrame | None:
        """A frame that has arrived since the last look, as `judge` gives it; None where there is none, or where it is
        old: it was measured long ago, or lay in the socket while nobody asked. NotValid of an old one too: it is news
        that nothing may be acted on.
        """
        if not self.take() or self._frame is None:
            return None
        age = self._age()
        if not (self._frame.valid or allow_invalid):
            raise NotValid(self._frame, age)
        return self._frame if age is not None and age <= self._limit(max_age) else None

    def stale(self, max_age: float | None) -> Stale:
        """The error that says what there is instead of a frame that is new enough."""
        age = self._age()
        if self._frame is None:
            text = f"no contact frame of {self.skin} yet: does the service run (`skin up`), with a skin of that name?"
        elif age is None:
            text = f"the newest contact frame of {self.skin} does not say when it was measured"
        else:
            limit = self._limit(max_age)
            text = f"the newest contact frame of {self.skin} is {age:.3f} s old, expected at most {limit:.3f} s"
        if self._frame is not None and not self._frame.valid and self._frame.reasons:
            text += f"; it is not valid either: {', '.join(self._frame.reasons)}"
        if self.replayed:
            text += f"; {self.replayed} replayed ones were ignored (replay=True takes them)"
        if self.reader.malformed:
            text += f"; {self.reader.malformed} malformed ones were dropped, the last because {self.reader.last_error}"
        return Stale(text, age)

    def close(self) -> None:
        self._ages.close()
        self.reader.close()

    def _age(self) -> float | None:
        return None if self._measured_ns is None else self._ages.age_s(self._measured_ns)

    def _limit(self, max_age: float | None) -> float:
        own = self._frame.valid_for_s if self._frame is not None else 0.0
        return own if max_age is None else min(max_age, own)
