"""The page's server: its files, and one WebSocket for each browser. Who may ask is bridges/door.py's."""

from __future__ import annotations

import asyncio
import importlib.util
import logging
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from aiohttp import web

from bridges.door import CLOSE_S, Door
from bridges.process import BridgeError
from protocol.advice import ADVICE
from protocol.frame_types import ELECTRODE_STATES, REASONS
from protocol.runtime import host_id
from protocol.topics import RECORDER

from .commands import BUTTONS, Buttons
from .feed import SkinFeed
from .replays import REPLAY
from .settings import PageSettings
from .viewer import Viewer

if TYPE_CHECKING:
    from .metrics import SkinMetrics

WEB = Path(__file__).with_name("web")
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
TRIES = 20
HEARTBEAT_S = 10.0
MOST_ASKED = 16 * 1024
"""Longest message of a browser, in bytes."""

log = logging.getLogger(__name__)


class PageServer:
    """`listen`, `application`, and `close`."""

    def __init__(self, settings: PageSettings, secret: str, handed_on: Callable[[str, int | None], None]) -> None:
        """handed_on: called with the skin, and when it was measured, of each scan that goes to the browsers."""
        if settings.metrics and importlib.util.find_spec("prometheus_client") is None:
            raise BridgeError("[page] metrics needs the package prometheus-client, which is not installed: `make venv`")
        self.settings, self._handed_on = settings, handed_on
        self.door = Door(settings.host, settings.names, secret)
        self.feeds = {skin: SkinFeed(skin, partial(self._tell, skin)) for skin in settings.skins}
        self.buttons = Buttons(self.door, self.feeds, settings.recordings, partial(self._tell, REPLAY))
        self._viewers: set[Viewer] = set()
        self._metrics: SkinMetrics | None = None
        self._files = {f"/{path.name}": path.read_bytes() for path in WEB.iterdir() if path.suffix in TYPES}
        self._files["/"] = self._files["/index.html"]

    def listen(self) -> socket.socket:
        """A socket at the first free port from the settings' on. Raises OSError where none of them is."""
        return self.door.listen(self.settings.port, TRIES)

    def application(self) -> web.Application:
        found = web.Application(middlewares=[self.door.guard])
        found.router.add_get("/live", self._live)
        if self.settings.metrics:
            found.router.add_get("/metrics", self._measured)
            found.cleanup_ctx.append(self._measuring)
        found.router.add_get("/{path:.*}", self._file)
        return found

    async def _file(self, request: web.Request) -> web.Response:
        content = self._files.get(request.path)
        if content is None:
            raise web.HTTPNotFound(text="no such file\n", headers=self._headers())
        kind = TYPES[Path(request.path).suffix] if request.path != "/" else "text/html"
        return web.Response(body=content, content_type=kind, charset="utf-8", headers=self._headers())

    def _headers(self) -> dict[str, str]:
        sockets = " ".join(
            sorted(f"ws://{name}" for name in self.door.names if "[" not in name)
        )  # which CSP cannot name
        return {
            "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: "
            f"blob:; connect-src 'self' {sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-cache",
        }

    async def _measuring(self, application: web.Application) -> AsyncIterator[None]:
        """Count while the server runs, whether anybody looks or not."""
        from .metrics import LOOK_S, SkinMetrics  # where it is off, its package is not needed

        self._metrics = metrics = SkinMetrics(self.settings.skins)

        async def look() -> None:
            while True:
                metrics.look()
                await asyncio.sleep(LOOK_S)

        looking = asyncio.create_task(look())
        yield
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        self._metrics = None
        metrics.close()

    async def _measured(self, request: web.Request) -> web.Response:
        """For Prometheus. Who may look may read it; beyond this host the token is asked for, as for looking."""
        self.door.refuse_other_pages(request)
        self.door.refuse_strangers(request)
        if self._metrics is None:
            raise web.HTTPServiceUnavailable(text="not yet\n")
        headers = {**self._headers(), "Content-Type": "text/plain; version=0.0.4; charset=utf-8"}
        return web.Response(body=self._metrics.text(), headers=headers)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        self.door.refuse_other_pages(request, pages_only=True)
        self.door.refuse_strangers(request)
        with self.door.place(request) as known:
            socket = web.WebSocketResponse(
                heartbeat=HEARTBEAT_S, max_msg_size=MOST_ASKED, compress=False, timeout=CLOSE_S
            )
            await socket.prepare(request)
            viewer = Viewer(socket, self.feeds, self.buttons.press)
            self._viewers.add(viewer)
            try:
                await viewer.run(self._hello(), hurried=not known)
            except ConnectionError:
                pass
            finally:
                self._viewers.discard(viewer)
        return socket

    def _hello(self) -> dict[str, object]:
        """What a browser is to know before the first frame."""
        return {
            "kind": "hello",
            "skins": list(self.settings.skins),
            "host": host_id(),
            "now": time.monotonic_ns(),
            "reasons": REASONS,
            "advice": ADVICE,
            "electrode_states": list(ELECTRODE_STATES),
            "buttons": [
                name
                for name, button in BUTTONS.items()
                if self.buttons.recording or button.process not in ("", RECORDER)
            ],
        }

    @property
    def looking(self) -> Counter[str]:
        """How many browsers look at each skin, or at the replay."""
        return Counter(viewer.name for viewer in list(self._viewers))

    def _tell(self, name: str, contacts: bool) -> None:
        if contacts and name in self.settings.skins:
            self._handed_on(name, self.feeds[name].latest["contact"].measured_ns)
        for viewer in self._viewers:
            if viewer.name == name:
                viewer.tell()

    async def close(self) -> None:
        """Send the browsers away."""
        await asyncio.gather(*(viewer.close() for viewer in list(self._viewers)), return_exceptions=True)
        await self.buttons.close()
        for feed in self.feeds.values():
            feed.close()
