"""The client for asyncio: as `client.ContactSubscriber`, with `await`.

async with AsyncContactSubscriber("palm") as skin:
    frame = await skin.latest()
    async for frame in skin: ...
"""

from __future__ import annotations

import math
import time
from collections.abc import AsyncIterator
from types import TracebackType

import zmq.asyncio

from .frames import ContactFrame
from .freshness import WAIT_SLICE_S, NewestContacts, Stale


class AsyncContactSubscriber:
    """The contacts of one skin, for one event loop; arguments, ages and errors as of `client.ContactSubscriber`."""

    def __init__(self, skin: str, endpoint: str | None = None, *, replay: bool = False) -> None:
        self.skin = skin
        self._newest = NewestContacts(skin, endpoint, replay=replay)
        self._socket: zmq.asyncio.Socket = zmq.asyncio.Socket.from_socket(self._newest.reader.socket)

    @property
    def replayed(self) -> int:
        """Replayed frames that were ignored."""
        return self._newest.replayed

    async def latest(
        self, max_age: float | None = None, wait_s: float | None = None, *, allow_invalid: bool = False
    ) -> ContactFrame:
        """The newest frame, within its own `valid_for_s` and `max_age`; waits for the first one, 1 s at most, or up to
        `wait_s`. Raises Stale, or NotValid.
        """
        deadline = None if wait_s is None else time.monotonic() + wait_s
        while True:
            self._newest.take()
            try:
                return self._newest.judge(max_age, allow_invalid)
            except Stale:
                if not await self._wait(self._newest.first_by() if deadline is None else deadline):
                    raise

    async def next_frame(self, max_age: float | None = None, *, allow_invalid: bool = False) -> ContactFrame:
        """A frame not given out before. Raises Stale where none has come for `max_age` seconds, or for as long as the
        newest one was valid for; NotValid where it must not be acted on.
        """
        deadline = time.monotonic() + self._newest.silence_s(max_age)
        while (frame := self._newest.fresh(max_age, allow_invalid)) is None:
            if not await self._wait(deadline):
                raise self._newest.stale(max_age)
        return frame

    async def frames(self, max_age: float | None = None, *, allow_invalid: bool = False) -> AsyncIterator[ContactFrame]:
        """`next_frame` for ever. Silence ends it with Stale, a frame that is not valid with NotValid."""
        while True:
            yield await self.next_frame(max_age, allow_invalid=allow_invalid)

    def __aiter__(self) -> AsyncIterator[ContactFrame]:
        return self.frames()

    async def _wait(self, deadline: float) -> bool:
        left = deadline - time.monotonic()
        if left <= 0:
            return False
        since = time.monotonic_ns()
        if await self._socket.poll(math.ceil(min(left, WAIT_SLICE_S) * 1000)):
            self._newest.woken(since)
        return True

    def close(self) -> None:
        """Close the subscription."""
        self._socket.close(0)
        self._newest.close()

    async def __aenter__(self) -> AsyncContactSubscriber:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
