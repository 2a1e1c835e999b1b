"""python -m bridges.page '{"skins": ["palm"]}': the live page, until SIGINT or SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys

from aiohttp import web

from protocol import logs
from protocol.errors import EitskinError
from protocol.runtime import lock

from .commands import token
from .server import PageServer
from .settings import PageSettings, read

CLOSE_S = 0.5


async def serve(settings: PageSettings) -> None:
    """Until a signal comes. Raises OSError where it cannot listen."""
    secret = token()
    server = PageServer(settings, secret)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    listening = server.listen()
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=CLOSE_S)
    await runner.setup()
    await web.SockSite(runner, listening).start()
    name = f"[{settings.host}]" if ":" in settings.host else settings.host
    print(f"page: look at the skin, and press it, at http://{name}:{server.port}/#{secret}", flush=True)
    try:
        await stop.wait()
    finally:
        server.close()
        await runner.cleanup()


def main(arguments: list[str]) -> int:
    logs.setup("page: %(message)s")
    if len(arguments) != 1:
        print('usage: python -m bridges.page \'{"skins": ["palm"]}\'', file=sys.stderr)
        return 2
    try:
        settings = read(arguments[0])
        with lock(process="page"), contextlib.suppress(KeyboardInterrupt):
            asyncio.run(serve(settings))
    except (EitskinError, OSError) as why:
        print(f"page: {why}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
