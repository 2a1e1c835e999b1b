"""The page's door, from outside: asked by those who may, by another web page, and by who only takes up places."""

import asyncio
import re
from pathlib import Path

import aiohttp
import pytest

from bridges import door
from bridges.page.server import PageServer
from bridges.process import openable
from tests.bridges.page_server import SECRET, looking, run, serving
from tests.waiting import WAIT_S

pytestmark = [pytest.mark.live, pytest.mark.usefixtures("runtime")]
TOKEN = f"?token={SECRET}"


async def refused(server: PageServer, query: str = "", **headers: str) -> int:
    """The status with which a browser is refused; 0 where it is not."""
    try:
        async with looking(server, query, **headers):
            return 0
    except aiohttp.WSServerHandshakeError as why:
        return why.status


def test_asked_by_another_name_from_another_page_or_beyond_the_loopback_it_refuses() -> None:
    async def test() -> None:
        async with serving() as server, aiohttp.ClientSession() as session:
            own = f"127.0.0.1:{server.door.port}"
            for path, host, expected in (
                *(("/", host, 200) for host in (own, f"localhost:{server.door.port}")),
                *(("/", host, 421) for host in ("evil.com", f"evil.com:{server.door.port}", "127.0.0.1:1")),
                *((path, own, 404) for path in ("/server.py", "/%2e%2e/server.py")),
            ):
                async with session.get(f"http://{own}{path}", headers={"Host": host}) as answer:
                    assert answer.status == expected, (path, host)
                    policy = answer.headers.get("Content-Security-Policy", "")
                    assert expected != 200 or ("default-src 'none'" in policy and "unsafe" not in policy)
            for token in ("", "?token=wrong", TOKEN):
                wrong = "http://evil.com", f"https://{own}", "null", "file://", "", f"http://127.0.0.1.evil:{own[10:]}"
                assert {await refused(server, token, Origin=origin) for origin in wrong} == {403}
                # a name that its owner points at this host (DNS rebinding)
                assert await refused(server, token, Host="evil.com", Origin="http://evil.com") == 421
            assert await refused(server) == 0
            async with serving(port=server.door.port) as second:
                assert server.door.port < second.door.port < server.door.port + 20, "the first that is free"

        async with serving(host="0.0.0.0", names=("robot.lan",)) as server:  # beyond the loopback
            assert await refused(server) == await refused(server, "?token=wrong") == 403
            named = {"Host": f"robot.lan:{server.door.port}", "Origin": f"http://robot.lan:{server.door.port}"}
            assert await refused(server, TOKEN) == await refused(server, TOKEN, **named) == 0

    run(test)


def test_viewers_without_the_token_fill_only_their_own_places_and_must_say_what_they_want(monkeypatch) -> None:
    monkeypatch.setitem(door.PLACES, False, 3)
    monkeypatch.setattr(door, "SAY_S", 0.5)

    async def test() -> None:
        async with serving() as server, looking(server, TOKEN) as silent:
            async with looking(server) as idle, looking(server), looking(server):
                assert await refused(server) == 503, "the places of those without the token are full"
                assert await refused(server, TOKEN) == 0
                message = await idle.socket.receive(WAIT_S)
                assert idle.socket.close_code == 1008 and "token" in str(message.extra), "who says nothing is sent away"
            while await refused(server):  # and makes room
                await asyncio.sleep(0.01)
            await silent.say({"ping": 12.5})
            assert (await silent.hear("pong"))["ping"] == 12.5, "who has the token may be silent"

    run(test)


def test_connections_that_do_not_look_make_room_for_newer_ones(monkeypatch) -> None:
    monkeypatch.setattr(door, "MOST_WAITING", 8)
    monkeypatch.setattr(door, "HEAD_S", 3600.0)

    async def test() -> None:
        async with serving() as server:
            peers = [await asyncio.open_connection("127.0.0.1", server.door.port) for _ in range(40)]
            for _, writer in peers:
                writer.write(b"GET /live HTTP/1.1\r\nX: ")  # half of a request
            for reader, _ in peers[:32]:
                await asyncio.wait_for(asyncio.gather(reader.read(), return_exceptions=True), WAIT_S)
            assert await refused(server, TOKEN) == 0 and not peers[-1][0].at_eof()

    run(test)


BIG = f'{{"command": "tare", "skin": "palm", "args": {{}}, "id": {-(2**70)}}}'
DEEP = '{"ping": ' + "[" * 3000 + "]" * 3000 + "}"
MALFORMED = ['{"ping": "\\ud800"}', '{"want": ["contact"], "skin": "\\udfff"}', BIG, DEEP, "[]", "no JSON"]


def test_malformed_messages_end_in_a_reason() -> None:
    async def test() -> None:
        async with serving() as server:
            for text in MALFORMED:
                async with looking(server) as viewer:
                    await viewer.socket.send_str(text)
                    message = await viewer.socket.receive(WAIT_S)
                    assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 1007), (text[:60], message)
                    assert re.search("found .* expected", message.extra or ""), text[:60]

    run(test)


def test_the_token_is_kept_for_its_owner_alone_and_the_printed_address_is_answered_to(runtime: Path) -> None:
    first = door.kept_token("page")
    assert len(first) >= 16 and door.kept_token("page") == first != door.kept_token("foxglove")
    assert (runtime / "page.token").stat().st_mode & 0o777 == 0o600
    (runtime / "page.token").write_text("short")
    assert door.kept_token("page") not in ("short", first)
    assert [openable(host) for host in ("127.0.0.1", "0.0.0.0", "fe80::1")] == ["127.0.0.1", "127.0.0.1", "[fe80::1]"]
