"""The door of a bridge that listens at a TCP port, the page's or Foxglove's: who may come in, for how long, how many.

It answers to its own names alone, and not to other pages than its own, so that no web page from elsewhere reaches it.
The token of the printed address opens what is closed to others, and has places of its own: whoever has none can fill
only the places of those who have none, and a connection that has not asked for anything yet makes room for newer ones.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import ipaddress
import os
import secrets
import socket
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager

from aiohttp import WSCloseCode, web
from aiohttp.typedefs import Handler, Middleware

from protocol.logs import foreign
from protocol.runtime import runtime_dir

LOOPBACK = ("127.0.0.1", "::1", "localhost")
HEAD_S = 5.0
"""For a connection to ask something, in full; also how long one is kept that asks nothing more."""
SAY_S = 10.0
"""For a viewer without the token to say what it wants to see."""
CLOSE_S = 0.5
MOST_WAITING = 128
"""Connections that do not hold a viewer's place; a further one ends the oldest."""
PLACES = {True: 48, False: 16}
"""Viewers at one time who brought the token, and who did not."""


def kept_token(process: str) -> str:
    """What commands must come with: made once for a runtime folder, which nobody else may enter, and kept there, so
    that the printed address goes on to hold when the process is started anew.
    """
    path = runtime_dir() / f"{process}.token"
    try:
        if len(known := path.read_text().strip()) >= 16:
            return known
    except OSError:
        pass
    new = secrets.token_urlsafe(16)
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(new)
    return new


class Door:
    """`listen`, then `serve` an application with `guard` among its middlewares."""

    def __init__(self, host: str, names: Iterable[str], secret: str) -> None:
        """host: where to listen. names: host names beside those of the loopback by which it may be asked for."""
        self.host, self.port = host, 0
        self._names, self._secret = tuple(names), secret
        self._waiting: dict[asyncio.BaseTransport, asyncio.Transport] = {}  # oldest first
        self._seated: Counter[bool] = Counter()

    @property
    def local(self) -> bool:
        """Whether only this host's programs reach it."""
        try:
            return self.host in LOOPBACK or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def names(self) -> set[str]:
        """What it may be called in a request's header Host."""
        hosts = {*LOOPBACK, *self._names, self.host} - {"0.0.0.0", "::"}
        return {f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}" for host in hosts}

    def listen(self, port: int, tries: int = 1) -> socket.socket:
        """A socket at the first free port of `tries` from `port` on. Raises OSError where none of them is."""
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        for each in range(port, port + tries):
            found = socket.socket(family, socket.SOCK_STREAM)
            found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                found.bind((self.host, each))
                found.listen(MOST_WAITING)
            except OSError as why:
                found.close()
                if why.errno != errno.EADDRINUSE:
                    raise
                continue
            self.port = found.getsockname()[1]
            return found
        ports = f"{port} to {port + tries - 1}" if tries > 1 else str(port)
        raise OSError(errno.EADDRINUSE, f"no free port from {ports} at {self.host}")

    @asynccontextmanager
    async def serve(self, application: web.Application, listening: socket.socket) -> AsyncIterator[None]:
        """Let in who may come in, meanwhile."""
        runner = web.AppRunner(
            application, access_log=None, shutdown_timeout=CLOSE_S, keepalive_timeout=HEAD_S, tcp_keepalive=True
        )
        await runner.setup()
        server = runner.server
        assert server is not None
        loop = asyncio.get_running_loop()
        listener = await loop.create_server(lambda: _Counted(self, server()), sock=listening)
        try:
            yield
        finally:
            listener.close()
            await runner.cleanup()

    @property
    def guard(self) -> Middleware:
        """Refuses who asks for it by another name."""

        @web.middleware
        async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
            if request.host not in self.names:
                raise web.HTTPMisdirectedRequest(text=f"asked for as {foreign(request.host, 80)!r}: that is not us\n")
            return await handler(request)

        return guard

    def refuse_other_pages(self, request: web.Request, pages_only: bool = False) -> None:
        """Raises HTTPForbidden where another page asks; with `pages_only` also where none does."""
        origin = request.headers.get("Origin")
        if origin is None and not pages_only:
            return
        scheme, _, name = (origin or "").partition("://")
        if scheme != "http" or name not in self.names:
            raise web.HTTPForbidden(text=f"asked by another page, {foreign(origin, 80)!r}: refused\n")

    def refuse_strangers(self, request: web.Request) -> None:
        """Beyond this host the token is asked for. Raises HTTPForbidden."""
        if not self.local and not self.token_in(request):
            raise web.HTTPForbidden(text="open the address that the service printed, with its token\n")

    def token_in(self, request: web.Request) -> bool:
        """Whether a request brings the token, in its address or as Bearer's credentials."""
        bearer = request.headers.get("Authorization", "").removeprefix("Bearer ")
        return self.knows(bearer or request.query.get("token", ""))

    def knows(self, given: str) -> bool:
        """Whether somebody has the token."""
        return hmac.compare_digest(given.encode("utf-8", "replace"), self._secret.encode())

    @contextmanager
    def place(self, request: web.Request) -> Iterator[bool]:
        """A viewer's place while it looks; whether it brought the token. Raises HTTPServiceUnavailable."""
        known = self.token_in(request)
        if self._seated[known] >= PLACES[known]:
            advice = "close some" if known else "open the address that the service printed, with its token"
            raise web.HTTPServiceUnavailable(text=f"{PLACES[known]} look already: {advice}\n")
        self._seated[known] += 1
        if request.transport is not None:
            self._waiting.pop(request.transport, None)
        try:
            yield known
        finally:
            self._seated[known] -= 1
            if request.transport is not None and not request.transport.is_closing():
                self.opened(request.transport)  # it did not become a viewer, or is one no more

    def opened(self, transport: asyncio.Transport) -> None:
        """A connection has come."""
        self._waiting[transport] = transport
        if len(self._waiting) > MOST_WAITING:
            oldest = self._waiting.pop(next(iter(self._waiting)))
            oldest.abort()  # `close` would wait for a peer that does not read

    def closed(self, transport: asyncio.BaseTransport | None) -> None:
        """A connection has gone."""
        if transport is not None:
            self._waiting.pop(transport, None)


async def hurry(viewer: web.WebSocketResponse, said: asyncio.Event) -> None:
    """End the connection of a viewer without the token that has not said in time what it wants."""
    try:
        async with asyncio.timeout(SAY_S):
            await said.wait()
    except TimeoutError:
        reason = f"said nothing for {SAY_S:g} s: say what you want, or bring the token".encode()
        await viewer.close(code=WSCloseCode.POLICY_VIOLATION, message=reason)


class _Counted(asyncio.Protocol):
    """A connection as aiohttp has it, known to the door."""

    def __init__(self, door: Door, inner: asyncio.Protocol) -> None:
        self._door, self._inner = door, inner
        self._transport: asyncio.BaseTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._inner.connection_made(transport)
        self._door.opened(transport)

    def connection_lost(self, why: Exception | None) -> None:
        self._door.closed(self._transport)
        self._inner.connection_lost(why)

    def data_received(self, data: bytes) -> None:
        self._inner.data_received(data)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received()

    def pause_writing(self) -> None:
        self._inner.pause_writing()

    def resume_writing(self) -> None:
        self._inner.resume_writing()
