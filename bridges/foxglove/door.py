"""The door for viewers on other hosts: who does not bring the token in the address is not let through to the server,
which itself listens on the loopback alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import threading
from urllib.parse import parse_qs, urlsplit

from bridges.process import BridgeError

HEAD_BYTES = 8192
HEAD_S = 5.0
MOST = 32
CHUNK = 65536
REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"

log = logging.getLogger(__name__)


class Door:
    """Listens at (host, port) and passes on what brings the token; a thread of its own."""

    def __init__(self, host: str, port: int, inside: int, token: str) -> None:
        self._inside, self._token = inside, token
        self._open = 0
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(
                asyncio.start_server(self._serve, host, port, limit=HEAD_BYTES)
            )
        except OSError as why:
            self._loop.close()
            raise BridgeError(f"cannot listen at {host}:{port}: {why.strerror}; see [foxglove] in skin.toml") from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name="door", daemon=True)
        self._thread.start()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            if self._open > MOST:
                return
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_S)
            if not brings(head, self._token):
                log.warning("a viewer without the token was refused")
                writer.write(REFUSED)
                await writer.drain()
                return
            from_server, to_server = await asyncio.open_connection("127.0.0.1", self._inside)
            to_server.write(head)
            await asyncio.gather(_pass(reader, to_server), _pass(from_server, writer))
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError) as why:
            log.debug("a viewer's connection ended: %s", why)
        finally:
            self._open -= 1
            writer.close()

    def close(self) -> None:
        """Let nobody in any more."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(2.0)
        self._server.close()


def brings(head: bytes, token: str) -> bool:
    """Whether a request's first line, `GET /?token=... HTTP/1.1`, has the token."""
    parts = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ")
    if len(parts) != 3 or parts[0] != "GET":
        return False
    with contextlib.suppress(ValueError):
        given = parse_qs(urlsplit(parts[1]).query).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), token.encode())
    return False


async def _pass(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    try:
        while data := await source.read(CHUNK):
            sink.write(data)
            await sink.drain()
    finally:
        sink.close()
