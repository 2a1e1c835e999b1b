"""What a robot controller uses: the newest contacts, or an error, never old data.

with ContactSubscriber("palm") as skin:
    frame = skin.latest()                            # valid and new, else Stale: stop
    for contact in frame.contacts: ...               # what touches now; what has just ended is in frame.ended

with ContactSubscriber("palm") as skin:
    for frame in skin: ...                           # each new frame; Stale when none comes, or one that is not valid

In the background: `listener.ContactListener`; with asyncio: `aio.AsyncContactSubscriber`. A skin on another host:

transport.configure(Transport(
    addresses={"publisher": "tcp://robot:47600", "publisher.ctl": "tcp://robot:47601"},  # the latter tells its clock
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

__all__ = ["ContactSubscriber", "NotValid", "Stale"]


class ContactSubscriber:
    """The contacts of one skin. Belongs to one thread.

    A service that was restarted is found again by itself. Replayed frames are ignored unless `replay`. `endpoint`
    overrides the publisher's address (tcp://HOST:PORT or ipc://PATH); keys come from `transport.configure`.

    Only frames to act on are given out. For one with `valid` false NotValid is raised, a kind of Stale, with the frame
    and its `reasons`; `allow_invalid=True` gives it out like the others: look at `frame.valid` then.

    `frame.contacts` are those that touch; those that have ended since stand in `frame.ended`.

    A frame's age counts from when the skin was measured, its stamp `sample` (of a replayed one: from `read`). A frame
    is out of date when it is older than its own `valid_for_s`, which the service sets to three scans, 0.25 s at least;
    `max_age` asks for a newer one. From another host, whose clock a control socket tells, see protocol/WIRE.md: until
    it has told, a frame that waited for us to ask counts from when we last asked, so wait for frames there, or ask
    often.

    A contact that is new to us has `state` begin where it was not there in the service's frame before, and hold where
    it had been there already; one that we were not told of does not stand in `ended`.
    """

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin = skin
        self._newest = NewestContacts(skin, endpoint, replay=replay)

    @property
    def replayed(self) -> int:
        """Replayed frames that were ignored."""
        return self._newest.replayed

    def latest(
        self, max_age: float | None = None, wait_s: float | None = None, *, allow_invalid: bool = False
    ) -> ContactFrame:
        """The newest frame, within its own `valid_for_s` and at most `max_age` seconds old where that is given; the
        same one again until there is a newer one.

        Waits for the first frame after subscribing, 1 s at most, and never again; with `wait_s` up to so long for a
        frame that will do. Raises Stale, or NotValid.
        """
        deadline = None if wait_s is None else time.monotonic() + wait_s
        while True:
            self._newest.take()
            try:
                return self._newest.judge(max_age, allow_invalid)
            except Stale:
                if not self._wait(self._newest.first_by() if deadline is None else deadline):
                    raise

    def next_frame(self, max_age: float | None = None, *, allow_invalid: bool = False) -> ContactFrame:
        """A frame not given out before, the newest one where several have come; waits for it.

        Raises Stale where none has come for `max_age` seconds; unless given, for as long as the newest one was valid
        for, and 1 s for the first; NotValid where it must not be acted on.
        """
        deadline = time.monotonic() + self._newest.silence_s(max_age)
        while (frame := self._newest.fresh(max_age, allow_invalid)) is None:
            if not self._wait(deadline):
                raise self._newest.stale(max_age)
        return frame

    def frames(self, max_age: float | None = None, *, allow_invalid: bool = False) -> Iterator[ContactFrame]:
        """`next_frame` for ever. Silence ends it with Stale, a frame that is not valid with NotValid, so that a loop
        that moves a robot neither hangs nor acts on it; begin a new one to go on.
        """
        while True:
            yield self.next_frame(max_age, allow_invalid=allow_invalid)

    def __iter__(self) -> Iterator[ContactFrame]:
        return self.frames()

    def run(
        self,
        on_frame: Callable[[ContactFrame], object],
        on_stale: Callable[[Stale], object],
        max_age: float | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        """Call `on_frame` with each new valid frame, also when nothing touches, and `on_stale` for each frame that
        is not valid (NotValid, with the frame) and for every `max_age` seconds of silence (unless given, as of
        `next_frame`); until `stop` is set.

        So one of the two is called at least every `max_age` seconds. An exception in either ends `run` and reaches
        the caller.
        """
        while stop is None or not stop.is_set():
            try:
                frame = self.next_frame(max_age)
            except Stale as why:
                on_stale(why)
            else:
                on_frame(frame)

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
        self._newest.close()

    def __enter__(self) -> ContactSubscriber:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
