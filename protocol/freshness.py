"""Whether the newest contact frame of a skin may be acted on: its age, its `valid`, and the errors that say no.

Nothing here waits: client.py does so in a thread, aio.py in an event loop.
"""

from __future__ import annotations

import time

from .frames import ContactFrame
from .runtime import host_id
from .sockets import NewestReader

WAIT_SLICE_S = 0.1
"""Longest single wait for a frame: what a longer one wakes to has come while the whole process was stopped."""


class Stale(RuntimeError):
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

    def __init__(self, frame: ContactFrame, age_s: float) -> None:
        reasons = ", ".join(frame.reasons) or "no reason given"
        super().__init__(f"the newest contact frame of {frame.skin} is not valid: {reasons}", age_s)
        self.frame = frame


class NewestContacts:
    """The newest contact frame of a skin and when it was made, as far as this host can know.

    On the publisher's host a frame's age counts from its `publish` stamp. Another host's clock is not ours: there it
    counts from reception, and a frame that may have lain in the socket counts from when the socket was last seen empty.
    """

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin, self.replay = skin, replay
        self.reader = NewestReader("contact", skin, endpoint)
        self.replayed = 0
        self._frame: ContactFrame | None = None
        self._born_ns = 0
        self._empty_ns = time.monotonic_ns()

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
        self._frame, self._born_ns = frame, received_ns
        if frame.host == host_id():  # a stamp from the future would make it look new for long
            self._born_ns = min(frame.stamps.get("publish", received_ns), time.monotonic_ns())
        return True

    def woken(self, since_ns: int) -> None:
        """The socket, empty at `since_ns`, has become readable: what is in it has come just now."""
        now = time.monotonic_ns()
        if now - since_ns < 1.5 * WAIT_SLICE_S * 1e9:
            self._empty_ns = now

    def judge(self, max_age: float, valid: bool) -> ContactFrame:
        """The newest frame where it is at most `max_age` seconds old and within its own `valid_for_s`, else Stale;
        with `valid`, NotValid where it is not.
        """
        frame, age = self._frame, self._age()
        if frame is None or age is None or not age <= self._limit(max_age):
            raise self.stale(max_age)
        if valid and not frame.valid:
            raise NotValid(frame, age)
        return frame

    def fresh(self, max_age: float, valid: bool) -> ContactFrame | None:
        """A frame that has arrived since the last look, as `judge` gives it; None where there is none, or where it is
        old because it lay in the socket while nobody asked. With `valid`, NotValid.
        """
        if not self.take():
            return None
        try:
            return self.judge(max_age, valid)
        except NotValid:
            raise
        except Stale:
            return None

    def stale(self, max_age: float) -> Stale:
        """The error that says what there is instead of a frame that is new enough."""
        age = self._age()
        if age is None:
            text = f"no contact frame of {self.skin} yet: is the service running (skin up)?"
        else:
            limit = self._limit(max_age)
            text = f"the newest contact frame of {self.skin} is {age:.3f} s old, expected at most {limit:.3f} s"
        if self.replayed:
            text += f"; {self.replayed} replayed ones were ignored (replay=True takes them)"
        if self.reader.malformed:
            text += f"; {self.reader.malformed} malformed ones were dropped, the last because {self.reader.last_error}"
        return Stale(text, age)

    def _age(self) -> float | None:
        return None if self._frame is None else (time.monotonic_ns() - self._born_ns) / 1e9

    def _limit(self, max_age: float) -> float:
        own = self._frame.valid_for_s if self._frame is not None else 0.0
        return min(max_age, own) if own > 0 else max_age
