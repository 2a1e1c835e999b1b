"""The client for asyncio: as `client.ContactSubscriber`, with `await`.

async with AsyncContactSubscriber("palm") as skin:
    frame = await skin.latest(max_age=0.05, valid=True)
    async for frame in skin: ...
"""

from __future__ import annotations

import math
import time
from collections.abc import AsyncIterator
from types import TracebackType

import zmq.asyncio

from .client import SILENCE_S
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

    async def latest(self, max_age: float = 0.05, wait_s: float = 0.0, *, valid: bool = False) -> ContactFrame:
        """The newest frame, at most `max_age` seconds old and within its own `valid_for_s`, waiting up to `wait_s`
        for one. Raises Stale, with `valid` also NotValid.
        """
        deadline = time.monotonic() + wait_s
        while True:
            self._newest.take()
            try:
                return self._newest.judge(max_age, valid)
            except Stale:
                if not await self._wait(deadline):
                    raise

    async def next_frame(self, max_age: float = SILENCE_S, *, valid: bool = False) -> ContactFrame:
        """A frame not given out before. Raises Stale where none has come within `max_age` seconds."""
        deadline = time.monotonic() + max_age
        while (frame := self._newest.fresh(max_age, valid)) is None:
            if not await self._wait(deadline):
                raise self._newest.stale(max_age)
        return frame

    async def frames(self, max_age: float = SILENCE_S, *, valid: bool = False) -> AsyncIterator[ContactFrame]:
        """`next_frame` for ever. Silence ends it with Stale; begin a new one to go on."""
        while True:
            yield await self.next_frame(max_age, valid=valid)

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
        self._newest.reader.close()

    async def __aenter__(self) -> AsyncContactSubscriber:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
