"""The page's server on a port of its own, for programs that ask it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from bridges.page.server import PageServer
from bridges.page.settings import PageSettings

SECRET = "a-token-of-the-test"


def settings(**changes: Any) -> PageSettings:
    known = {"skins": ("palm", "sole"), "host": "127.0.0.1", "port": 18080, "names": (), "recordings": ""}
    return PageSettings(**{**known, **changes})


@asynccontextmanager
async def serving(**changes: Any) -> AsyncIterator[PageServer]:
    """A server with these settings changed. It listens at `server.door.port`."""
    server = PageServer(settings(**changes), SECRET, lambda skin, measured_ns: None)
    listening = server.listen()
    async with server.door.serve(server.application(), listening):
        try:
            yield server
        finally:
            await server.close()
