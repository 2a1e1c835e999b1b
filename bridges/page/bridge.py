"""The page as a bridge: its server in a thread of its own, so that a heartbeat goes on whatever browsers do."""

from __future__ import annotations

import time
from collections.abc import Iterable

from bridges.door import kept_token
from bridges.process import Bridge, BridgeError, Handed, openable
from bridges.serving import ServerThread
from protocol.transport import Socket

from .server import PageServer
from .settings import PageSettings


class PageBridge(Bridge):
    """Listens once it is made, and says where."""

    def __init__(self, handed: Handed) -> None:
        super().__init__("page", handed)
        settings, secret = PageSettings.of(handed), kept_token("page")
        self._server = PageServer(settings, secret, self._handed_on)
        try:
            listening = self._server.listen()
        except OSError as why:
            raise BridgeError(f"{why.strerror or why}: choose another in [page] of skin.toml") from None
        self._thread = ServerThread(self._server.door, listening, self._server.application(), self._server.close)
        self.address = f"http://{openable(settings.host)}:{self._server.door.port}"
        print(f"look at the skin, and press it, at {self.address}/#{secret}", flush=True)

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
            alive = self._thread.alive
            pulse.level = "OK" if alive else "ERROR"
            pulse.messages = [f"{self.address}: {who}" if alive else "the server has stopped: start the page anew"]

    def close(self) -> None:
        self._thread.close()
