"""What a robot controller uses: the newest contacts, or an error, never old data.

with ContactSubscriber("palm") as skin:
    frame = skin.latest(max_age=0.05, valid=True)    # else Stale: stop
    for contact in frame.contacts: ...

with ContactSubscriber("palm") as skin:
    for frame in skin: ...                           # each new frame; Stale when none comes

In the background: `listener.ContactListener`; with asyncio: `aio.AsyncContactSubscriber`. A skin on another host:

transport.configure(Transport(
    addresses={"publisher": "tcp://robot:47600"},
    secret_key=Path("arm.key_secret"), server_keys={"publisher": Path("robot.key")}))
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType

from .frames import ContactFrame
from .freshness import WAIT_SLICE_S, NewestContacts, NotValid, Stale

__all__ = ["SILENCE_S", "ContactSubscriber", "NotValid", "Stale"]

SILENCE_S = 0.25
"""So long without a frame is silence, unless said otherwise: five frames of the demo's 22 a second."""


class ContactSubscriber:
    """The contacts of one skin. Belongs to one thread.

    A service that was restarted is found again by itself. Replayed frames are ignored unless `replay`. `endpoint`
    overrides the publisher's address (tcp://HOST:PORT or ipc://PATH); keys come from `transport.configure`.

    A frame with `valid` false is given out, with its `reasons`, to who asks for any frame; `valid=True` asks for one
    to act on, and raises NotValid, a kind of Stale, instead.

    Ages count from a frame's `publish` stamp; on another host from its reception, and a frame that waited for us to
    ask counts from when we last asked. Ask there at least every `max_age`, or wait for a frame with `wait_s`.
    """

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin = skin
        self._newest = NewestContacts(skin, endpoint, replay=replay)

    @property
    def replayed(self) -> int:
        """Replayed frames that were ignored."""
        return self._newest.replayed

    def latest(self, max_age: float = 0.05, wait_s: float = 0.0, *, valid: bool = False) -> ContactFrame:
        """The newest frame, at most `max_age` seconds old and within its own `valid_for_s`; the same one again until
        there is a newer one.

        Waits up to `wait_s` for one. Raises Stale. Without `valid=True`, look at `frame.valid` before acting on it.
        """
        deadline = time.monotonic() + wait_s
        while True:
            self._newest.take()
            try:
                return self._newest.judge(max_age, valid)
            except Stale:
                if not self._wait(deadline):
                    raise

    def next_frame(self, max_age: float = SILENCE_S, *, valid: bool = False) -> ContactFrame:
        """A frame not given out before, the newest one where several have come; waits for it.

        Raises Stale where none has come within `max_age` seconds.
        """
        deadline = time.monotonic() + max_age
        while (frame := self._newest.fresh(max_age, valid)) is None:
            if not self._wait(deadline):
                raise self._newest.stale(max_age)
        return frame

    def frames(self, max_age: float = SILENCE_S, *, valid: bool = False) -> Iterator[ContactFrame]:
        """`next_frame` for ever. Silence ends it with Stale, so that a loop that moves a robot never just hangs;
        begin a new one to go on.
        """
        while True:
            yield self.next_frame(max_age, valid=valid)

    def __iter__(self) -> Iterator[ContactFrame]:
        return self.frames()

    def run(
        self,
        on_contact: Callable[[ContactFrame], object],
        on_stale: Callable[[Stale], object],
        max_age: float = SILENCE_S,
        stop: threading.Event | None = None,
    ) -> None:
        """Call `on_contact` with each new valid frame, also when nothing touches, and `on_stale` for each frame that
        is not valid (NotValid, with the frame) and for every `max_age` seconds of silence; until `stop` is set.

        So one of the two is called at least every `max_age` seconds. An exception in either ends `run` and reaches
        the caller.
        """
        while stop is None or not stop.is_set():
            try:
                frame = self.next_frame(max_age, valid=True)
            except Stale as why:
                on_stale(why)
            else:
                on_contact(frame)

    def _wait(self, deadline: float) -> bool:
        """Wait for something to arrive, WAIT_SLICE_S at most; False when the deadline is over."""
        left = deadline - time.monotonic()
        if left <= 0:
            return False
        since = time.monotonic_ns()
        if self._newest.reader.socket.poll(math.ceil(min(left, WAIT_SLICE_S) * 1000)):
            self._newest.woken(since)
        return True

    def close(self) -> None:
        """Close the subscription."""
        self._newest.reader.close()

    def __enter__(self) -> ContactSubscriber:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
