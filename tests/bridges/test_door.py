"""The doors of the page and of Foxglove, from outside: real processes, asked over sockets of the loopback by those who
may, by another web page, and by who only takes up places.
"""

from __future__ import annotations

import asyncio
import re
import resource
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import aiohttp
import msgpack
import pytest

from tests.bridges.conftest import FakeService, RunningBridge

pytestmark = pytest.mark.live

WAIT_S = 60.0
PROTOCOL = "foxglove.sdk.v1"
PAGE_PORT = 18300


@dataclass
class Doorway:
    """A running bridge: where it listens, its token, and how its own clients look."""

    bridge: RunningBridge
    port: int
    token: str

    @property
    def is_page(self) -> bool:
        return self.bridge.name == "page"

    def url(self, token: str = "", host: str = "127.0.0.1") -> str:
        query = f"?token={token}" if token else ""
        return f"http://{host}:{self.port}/{'live' if self.is_page else ''}{query}"

    @property
    def headers(self) -> dict[str, str]:
        """Of a viewer on this host: the page's browser, or a program that speaks Foxglove's protocol."""
        return {"Origin": f"http://127.0.0.1:{self.port}"} if self.is_page else {}

    def connect(
        self, session: aiohttp.ClientSession, token: str = "", **headers: str
    ) -> aiohttp.client._WSRequestContextManager:
        protocols = () if self.is_page else (PROTOCOL,)
        return session.ws_connect(self.url(token), headers={**self.headers, **headers}, protocols=protocols)

    async def looks(self, token: str = "", **headers: str) -> None:
        """Looks once, and is told something."""
        async with aiohttp.ClientSession() as session, asyncio.timeout(WAIT_S):
            async with self.connect(session, token, **headers) as viewer:
                first = await viewer.receive()
                assert first.type in (aiohttp.WSMsgType.BINARY, aiohttp.WSMsgType.TEXT), first

    async def refused(self, token: str = "", **headers: str) -> int:
        """The status with which a viewer is refused; 0 where it is not."""
        try:
            await self.looks(token, **headers)
        except aiohttp.WSServerHandshakeError as why:
            return why.status
        return 0


@pytest.fixture(params=["page", "foxglove"])
def doorway(request: pytest.FixtureRequest, runtime: Path, fake: FakeService) -> Iterator[Doorway]:
    name = request.param
    bridge = RunningBridge(name, runtime, f"port = {PAGE_PORT if name == 'page' else 0}")
    try:
        bridge.status()
        pattern = r"at http://[^:]+:(\d+)/#(\S+)" if name == "page" else r'open ws://[^:]+:(\d+).*"token": "(\S+)"'
        found = re.search(pattern, bridge.said())
        assert found, bridge.said()
        yield Doorway(bridge, int(found[1]), found[2])
        said = bridge.said()
        assert "Traceback" not in said and "Unhandled" not in said, said
    finally:
        bridge.close()


def run(what: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(what(), 2 * WAIT_S))


def test_another_web_page_reads_nothing(doorway: Doorway) -> None:
    async def test() -> None:
        await doorway.looks()
        await doorway.looks(doorway.token)
        for origin in (
            "http://evil.com",
            "https://evil.com",
            "null",
            "file://",
            f"http://127.0.0.1.evil:{doorway.port}",
        ):
            assert await doorway.refused(Origin=origin) == 403, origin
            assert await doorway.refused("wrong", Origin=origin) == 403, origin

    run(test)


def test_asked_by_the_name_of_another_it_refuses_also_with_the_token(doorway: Doorway) -> None:
    """A name that its owner points at this host (DNS rebinding)."""

    async def test() -> None:
        for host in ("evil.com", f"evil.com:{doorway.port}", "127.0.0.1:1"):
            for token in ("", doorway.token):
                assert await doorway.refused(token, Host=host, Origin=f"http://{host}") == 421, host
        await doorway.looks(Host=f"localhost:{doorway.port}")

    run(test)


def test_foxglove_itself_comes_with_the_printed_address(doorway: Doorway) -> None:
    """Its website and its application have origins of their own; the page's is the page's alone."""

    async def test() -> None:
        for origin in ("https://app.foxglove.dev", "file://"):
            assert await doorway.refused(doorway.token, Origin=origin) == (403 if doorway.is_page else 0)

    run(test)


@asynccontextmanager
async def idlers(doorway: Doorway, count: int) -> AsyncIterator[list[aiohttp.ClientWebSocketResponse[bool]]]:
    """So many viewers that bring no token and say nothing, or as many as are let in; yields them."""
    async with AsyncExitStack() as stack:
        session = await stack.enter_async_context(aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)))
        found = []
        for _ in range(count):
            try:
                found.append(await stack.enter_async_context(doorway.connect(session)))
            except (aiohttp.WSServerHandshakeError, aiohttp.ServerDisconnectedError) as why:
                assert getattr(why, "status", 503) == 503
        yield found


@pytest.mark.release
def test_64_idle_viewers_do_not_keep_the_owner_out(doorway: Doorway) -> None:
    async def test() -> None:
        async with idlers(doorway, 64) as idle:
            assert idle, "without the token one may look here"
            assert await doorway.refused() == 503, "the places of those without the token are full"
            await doorway.looks(doorway.token)
            end = time.monotonic() + WAIT_S
            first = idle[0]
            while (message := await first.receive()).type in (1, 2):
                pass
            assert first.close_code == 1008 and "token" in str(message.extra), "who says nothing is sent away"
            while await doorway.refused():
                assert time.monotonic() < end, "and makes room"
                await asyncio.sleep(0.2)

    run(test)


@pytest.mark.release
def test_a_viewer_with_the_token_may_be_silent(doorway: Doorway) -> None:
    async def test() -> None:
        async with aiohttp.ClientSession() as session, doorway.connect(session, doorway.token) as viewer:
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(13.0):  # longer than SAY_S
                    while (message := await viewer.receive()).type in (1, 2):
                        pass
                    raise AssertionError(message)
            assert not viewer.closed

    run(test)


@pytest.mark.release
def test_1135_half_sent_requests_do_not_keep_the_owner_out(doorway: Doorway) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, 4096), hard), hard))
    half = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{doorway.port}\r\nX: ".encode()
    try:
        with ExitStack() as stack:
            for _ in range(1135):
                peer = stack.enter_context(socket.socket())
                peer.settimeout(10)
                peer.connect(("127.0.0.1", doorway.port))
                peer.sendall(half)
            run(lambda: doorway.looks(doorway.token))
            assert len(list(Path(f"/proc/{doorway.bridge.process.pid}/fd").iterdir())) < 400
            peer.settimeout(WAIT_S)
            with suppress(ConnectionError):
                while peer.recv(4096):
                    pass  # the last one, for which nobody had to make room, is ended too
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.release
def test_1135_requests_for_a_view_that_cannot_be_do_not_keep_the_owner_out(doorway: Doorway) -> None:
    """They pass the door, are told what they should have asked for, and stay connected."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, 4096), hard), hard))
    head = f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{doorway.port}\r\nOrigin: http://127.0.0.1:{doorway.port}\r\n"
    if not doorway.is_page:
        head += "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        head += "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: other\r\n"
    try:
        with ExitStack() as stack:
            for _ in range(1135):
                peer = stack.enter_context(socket.socket())
                peer.settimeout(10)
                peer.connect(("127.0.0.1", doorway.port))
                peer.sendall(head.encode() + b"\r\n")
                assert b" 400 " in peer.recv(4096)
                assert len(list(Path(f"/proc/{doorway.bridge.process.pid}/fd").iterdir())) < 400
            run(lambda: doorway.looks(doorway.token))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


MALFORMED = [
    '{"ping": "\\ud800"}',
    f'{{"ping": {2**70}}}',
    '{"want": ["contact"], "skin": "\\udfff"}',
    '{"command": "tare", "skin": "palm", "args": {}, "id": "\\ud800", "token": "\\ud800"}',
    f'{{"command": "tare", "skin": "palm", "args": {{}}, "id": {-(2**70)}}}',
    '{"ping": ' + "[" * 3000 + "]" * 3000 + "}",
    "[]",
    "{}",
    "no JSON",
]


@pytest.mark.parametrize("doorway", ["page"], indirect=True)
def test_malformed_messages_end_in_a_reason(doorway: Doorway) -> None:
    async def test() -> None:
        async with aiohttp.ClientSession() as session:
            for text in MALFORMED:
                async with doorway.connect(session) as viewer:
                    await viewer.send_str(text)
                    while (message := await viewer.receive(WAIT_S)).type is aiohttp.WSMsgType.BINARY:
                        assert msgpack.unpackb(message.data)["kind"] == "hello"
                    assert message.type is aiohttp.WSMsgType.CLOSE, (text[:60], message)
                    assert message.data == 1007, text[:60]
                    assert re.search("found .* expected", message.extra or ""), text[:60]
            async with doorway.connect(session) as viewer:
                await viewer.send_str('{"ping": 12.5}')
                while (answer := msgpack.unpackb(await viewer.receive_bytes(timeout=WAIT_S)))["kind"] != "pong":
                    pass
                assert answer["ping"] == 12.5

    run(test)


def test_foxglove_says_what_it_expected(runtime: Path, fake: FakeService) -> None:
    """Of a plain request, and of a viewer that speaks an older protocol."""
    bridge = RunningBridge("foxglove", runtime, "port = 0")
    try:
        bridge.status()
        port = int(re.search(r"ws://127.0.0.1:(\d+)", bridge.said())[1])  # type: ignore[index]

        async def test() -> None:
            upgrade = {
                "Connection": "Upgrade",
                "Upgrade": "websocket",
                "Sec-WebSocket-Version": "13",
                "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
                "Sec-WebSocket-Protocol": "foxglove.websocket.v1",
            }
            async with aiohttp.ClientSession() as session:
                for headers, expected in (({}, "a WebSocket"), (upgrade, PROTOCOL)):
                    async with session.get(f"http://127.0.0.1:{port}/", headers=headers) as answer:
                        assert answer.status == 400 and f"expected {expected}" in await answer.text()

        run(test)
    finally:
        bridge.close()
