"""A web application in a thread of its own, so that a bridge's heartbeat goes on whatever its viewers do."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable

from aiohttp import web

from .door import CLOSE_S, Door


class ServerThread:
    """Serves from the start on, until `close`."""

    def __init__(
        self,
        door: Door,
        listening: socket.socket,
        application: web.Application,
        ending: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        """ending: awaited before the connections are closed."""
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(
            target=self._run, args=(door, listening, application, ending), name="server", daemon=True
        )
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def _run(
        self,
        door: Door,
        listening: socket.socket,
        application: web.Application,
        ending: Callable[[], Awaitable[None]] | None,
    ) -> None:
        async def until_stopped() -> None:
            async with door.serve(application, listening):
                await self._stop.wait()
                if ending is not None:
                    await ending()

        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(until_stopped())
        self._loop.close()

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(2 * CLOSE_S + 1)
