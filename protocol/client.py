"""What a robot controller uses: the newest contacts, or an error, never old data.

with ContactSubscriber("palm") as skin:
    frame = skin.latest(max_age=0.05)
    for contact in frame.contacts: ...
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from types import TracebackType

from .frames import ContactFrame
from .runtime import host_id
from .sockets import NewestReader


class Stale(RuntimeError):
    """There is no contact frame that is new enough: stop, or fall back.

    `age_s` is the age of the newest one, None where there was none.
    """

    def __init__(self, message: str, age_s: float | None = None) -> None:
        super().__init__(message)
        self.age_s = age_s


class ContactSubscriber:
    """The contacts of one skin.

    Reconnects by itself; ignores replayed frames unless `replay`. Belongs to one thread.
    """

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin, self.replay = skin, replay
        self.replayed = 0
        """Replayed frames that were ignored."""
        self._reader = NewestReader("contact", skin, endpoint)
        self._newest: ContactFrame | None = None
        self._received_ns = 0

    def latest(self, max_age: float = 0.05, wait_s: float = 0.0) -> ContactFrame:
        """The newest frame, at most `max_age` seconds old and within its own `valid_for_s`.

        Waits up to `wait_s` for one. Age counts from `publish`, or on another host, whose clock is not ours, from
        reception. Raises Stale. Look at `frame.valid` before acting on the contacts.
        """
        self._take(0.0)
        deadline = time.monotonic() + wait_s
        while True:
            age = self._age()
            limit = max_age
            if self._newest is not None and self._newest.valid_for_s > 0:
                limit = min(max_age, self._newest.valid_for_s)
            if self._newest is not None and age is not None and age <= limit:
                return self._newest
            left = deadline - time.monotonic()
            if left <= 0:
                break
            self._take(left)
        if age is None:
            raise Stale(f"no contact frame of {self.skin} yet: is the service running (skin up)?")
        raise Stale(f"the newest contact frame of {self.skin} is {age:.3f} s old, expected at most {limit:.3f} s", age)

    def __iter__(self) -> Iterator[ContactFrame]:
        """Each frame as it comes, the newest one where several have; blocks in between."""
        while True:
            if self._take(1.0):
                assert self._newest is not None
                yield self._newest

    def _take(self, timeout_s: float) -> bool:
        frame = self._reader.recv(timeout_s)
        if not isinstance(frame, ContactFrame):
            return False
        if frame.source == "replay" and not self.replay:
            self.replayed += 1
            return False
        self._newest, self._received_ns = frame, time.monotonic_ns()
        return True

    def _age(self) -> float | None:
        if self._newest is None:
            return None
        born = self._received_ns
        if self._newest.host == host_id():
            born = self._newest.stamps.get("publish", born)
        return (time.monotonic_ns() - born) / 1e9

    def close(self) -> None:
        """Close the subscription."""
        self._reader.close()

    def __enter__(self) -> ContactSubscriber:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
