"""The page's server on a port of its own, for programs that ask it as a browser would."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import msgpack

from bridges.page.server import PageServer
from bridges.page.settings import PageSettings
from protocol.frames import Frame, unpack
from protocol.sockets import Publisher
from tests.waiting import WAIT_S

SECRET = "a-token-of-the-test"


def server_of(**changes: Any) -> PageServer:
    known = {"skins": ("palm", "sole"), "host": "127.0.0.1", "port": 0, "names": (), "recordings": ""}
    return PageServer(PageSettings(**{**known, **changes}), SECRET, lambda skin, measured_ns: None)


@asynccontextmanager
async def serving(**changes: Any) -> AsyncIterator[PageServer]:
    server = server_of(**changes)
    listening = server.listen()
    async with server.door.serve(server.application(), listening):
        try:
            yield server
        finally:
            await server.close()


class Browser:
    """What a browser would say and hear."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket, self.say = socket, socket.send_json

    async def hear(self, kind: str) -> dict[str, Any]:
        """The next message of a kind."""
        while True:
            message = msgpack.unpackb(await asyncio.wait_for(self.socket.receive_bytes(), WAIT_S))
            if message["kind"] == kind:
                return message

    async def frames(self) -> list[Frame]:
        message = await self.hear("frames")
        await self.say({"ack": 1})
        return [unpack(packed) for _, packed in message["frames"]]

    async def watch(self, publisher: Publisher, *topics: str) -> None:
        """Ask for topics of palm; once this publisher knows."""
        await self.say({"skin": "palm", "want": topics})
        await until(lambda: all(wanted(publisher, topic) for topic in topics))

    async def command(self, name: str, token: str = SECRET, **args: Any) -> dict[str, Any]:
        await self.say({"command": name, "skin": "palm", "args": args, "id": 1, "token": token})
        return await self.hear("answer")


@asynccontextmanager
async def looking(server: PageServer, query: str = "", **headers: str) -> AsyncIterator[Browser]:
    own = f"http://127.0.0.1:{server.door.port}"
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(f"{own}/live{query}", headers={"Origin": own, **headers}) as socket:
            browser = Browser(socket)
            await browser.hear("hello")
            yield browser


def wanted(publisher: Publisher, topic: str) -> bool:
    publisher.poll()
    return publisher.wanted(topic, "palm")


async def until(true: Callable[[], bool]) -> None:
    while not true():  # `run` ends it
        await asyncio.sleep(0.01)


def run(test: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 3 * WAIT_S))
