"""What viewers connect to. The SDK's own server asks nobody who they are, so it listens at an address that no web page
can guess, of this host's loopback alone; here is looked at who comes, and messages are passed on between the two.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator

import aiohttp
from aiohttp import ClientWebSocketResponse, WSMsgType, web

from bridges.door import CLOSE_S, Door, hurry
from bridges.process import BridgeError
from bridges.serving import ServerThread

HEARTBEAT_S = 10.0
MOST_ASKED = 64 * 1024
"""Longest message of a viewer, in bytes."""
INSIDE_S = 5.0
"""For the SDK's server to answer."""

Either = web.WebSocketResponse | ClientWebSocketResponse


def hidden_address() -> str:
    """One of the loopback's 16 million addresses, by chance."""
    return f"127.{1 + secrets.randbelow(254)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"


class Front:
    """Listens at the door, and passes on between its viewers and the server at `inside`, "http://HOST:PORT"."""

    def __init__(self, door: Door, port: int, inside: str) -> None:
        self._door, self._inside = door, inside
        self._session: aiohttp.ClientSession | None = None
        application = web.Application(middlewares=[door.guard])
        application.router.add_get("/{path:.*}", self._look)
        application.cleanup_ctx.append(self._reaching)
        try:
            listening = door.listen(port)
        except OSError as why:
            raise BridgeError(
                f"cannot listen at {door.host}:{port}: {why.strerror or why}; see [foxglove] in skin.toml"
            ) from None
        self._thread = ServerThread(door, listening, application)

    @property
    def alive(self) -> bool:
        return self._thread.alive

    async def _reaching(self, application: web.Application) -> AsyncIterator[None]:
        async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=INSIDE_S)) as self._session:
            yield

    async def _look(self, request: web.Request) -> web.StreamResponse:
        if not self._door.token_in(request):  # which another page cannot know; Foxglove's own is of its website
            self._door.refuse_other_pages(request)
            self._door.refuse_strangers(request)
        spoken = [each.strip() for each in request.headers.get("Sec-WebSocket-Protocol", "").split(",") if each.strip()]
        viewer = web.WebSocketResponse(
            protocols=spoken, heartbeat=HEARTBEAT_S, max_msg_size=MOST_ASKED, compress=False, timeout=CLOSE_S
        )
        if not viewer.can_prepare(request):
            raise web.HTTPBadRequest(
                text="found a plain request, expected a WebSocket: open this address in Foxglove\n"
            )
        assert self._session is not None
        with self._door.place(request) as known:
            try:
                inside = await self._session.ws_connect(self._inside, protocols=spoken, max_msg_size=0)
            except aiohttp.WSServerHandshakeError:
                found = ", ".join(spoken)[:80] or "none"
                raise web.HTTPBadRequest(text=f"found the subprotocol {found!r}, expected foxglove.sdk.v1\n") from None
            except (aiohttp.ClientError, TimeoutError):
                raise web.HTTPServiceUnavailable(text="the server does not answer: start the bridge anew\n") from None
            async with inside:
                await viewer.prepare(request)
                await _between(viewer, inside, known)
        return viewer

    def close(self) -> None:
        """Let nobody in any more, and end what is open."""
        self._thread.close()


async def _between(viewer: web.WebSocketResponse, inside: ClientWebSocketResponse, known: bool) -> None:
    """Pass on in both directions, until one of them ends."""
    said = asyncio.Event()
    ways = [asyncio.create_task(_pass(viewer, inside, said)), asyncio.create_task(_pass(inside, viewer))]
    others = [] if known else [asyncio.create_task(hurry(viewer, said))]
    try:
        await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (*ways, *others):
            task.cancel()
        await asyncio.gather(*ways, *others, return_exceptions=True)
        await viewer.close()


async def _pass(source: Either, sink: Either, said: asyncio.Event | None = None) -> None:
    async for message in source:
        if said is not None:
            said.set()
        if message.type is WSMsgType.TEXT:
            await sink.send_str(message.data)
        elif message.type is WSMsgType.BINARY:
            await sink.send_bytes(message.data)
