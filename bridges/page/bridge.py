"""The page as a bridge: its server in a thread of its own, so that a heartbeat goes on whatever browsers do."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterable

from aiohttp import web

from bridges.process import Bridge, BridgeError, Handed, openable
from protocol.transport import Socket

from .commands import token
from .server import PageServer
from .settings import PageSettings

CLOSE_S = 0.5


class PageBridge(Bridge):
    """Listens once it is made, and says where."""

    def __init__(self, handed: Handed) -> None:
        super().__init__("page", handed)
        settings, secret = PageSettings.of(handed), token()
        self._server = PageServer(settings, secret, self._handed_on)
        try:
            listening = self._server.listen()
        except OSError as why:
            raise BridgeError(f"{why.strerror or why}: choose another in [page] of skin.toml") from None
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, args=(listening,), name="server", daemon=True)
        self._thread.start()
        self.address = f"http://{openable(settings.host)}:{self._server.port}"
        print(f"look at the skin, and press it, at {self.address}/#{secret}", flush=True)

    def _serve(self, listening: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._until_stopped(listening))
        self._loop.close()

    async def _until_stopped(self, listening: socket.socket) -> None:
        runner = web.AppRunner(self._server.application(), access_log=None, shutdown_timeout=CLOSE_S)
        await runner.setup()
        await web.SockSite(runner, listening).start()
        try:
            await self._stop.wait()
        finally:
            await self._server.close()
            await runner.cleanup()

    def _handed_on(self, skin: str, measured_ns: int | None) -> None:
        """A scan's contacts go to the browsers."""
        pulse = self.pulses[skin]
        pulse.heard()
        pulse.sent["contact"] += 1
        pulse.handed_on(measured_ns, time.monotonic_ns())

    def sockets(self) -> Iterable[Socket]:
        return ()

    def serve(self, waited_ns: int) -> None:
        """The server's thread does."""

    def tick(self) -> None:
        looking = self._server.looking
        for skin, pulse in self.pulses.items():
            pulse.idle = not looking[skin]
            who = f"{looking[skin]} browser{'s' if looking[skin] != 1 else ''}"
            alive = self._thread.is_alive()
            pulse.level = "OK" if alive else "ERROR"
            pulse.messages = [f"{self.address}: {who}" if alive else "the server has stopped: start the page anew"]

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(2 * CLOSE_S + 1)
