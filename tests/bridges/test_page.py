"""The page's server, asked by programs: who may ask, who may command, and what a viewer is sent."""

from __future__ import annotations

import asyncio
import json
import re
import time
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import msgpack
import numpy as np
import pytest

from bridges.door import Door, kept_token
from bridges.page.commands import OwnRecorder
from bridges.page.replays import Replay, ReplayRefused, listed
from bridges.page.server import PageServer
from bridges.page.settings import PageSettings
from bridges.process import BridgeError, Handed, openable
from protocol.advice import ADVICE
from protocol.frames import REASONS, ContactFrame, Frame, ImageFrame, unpack
from protocol.sockets import ControlServer, Publisher
from protocol.transport import Transport
from tests.bridges.page_server import SECRET, serving, settings

pytestmark = pytest.mark.live

WAIT_S = 20.0


class Browser:
    """What a browser would say and hear."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket

    async def hear(self, kind: str) -> dict[str, Any]:
        """The next message of a kind."""
        while True:
            message = msgpack.unpackb(await asyncio.wait_for(self.socket.receive_bytes(), WAIT_S))
            if message["kind"] == kind:
                return message

    async def frames(self, ack: bool = True) -> list[Frame]:
        message = await self.hear("frames")
        if ack:
            await self.socket.send_json({"ack": 1})
        return [unpack(packed) for _, packed in message["frames"]]

    async def watch(self, *topics: str) -> None:
        await self.socket.send_json({"skin": "palm", "want": topics})

    async def command(self, name: str, token: str = SECRET, **args: Any) -> dict[str, Any]:
        await self.socket.send_json({"command": name, "skin": "palm", "args": args, "id": 1, "token": token})
        return await self.hear("answer")


@asynccontextmanager
async def looking(server: PageServer, query: str = "", **headers: str) -> AsyncIterator[Browser]:
    own = f"http://127.0.0.1:{server.door.port}"
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(f"{own}/live{query}", headers={"Origin": own, **headers}) as socket:
            browser = Browser(socket)
            await browser.hear("hello")
            yield browser


async def until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < end, "it did not happen"
        await asyncio.sleep(0.02)


def contact(scan: int, source: str = "stub") -> ContactFrame:
    now = time.monotonic_ns()
    stamps = {"sample": now, "read": now, "publish": now}
    return ContactFrame(skin="palm", scan=scan, source=source, stamps=stamps, valid=True, valid_for_s=0.25, contacts=[])


def image(scan: int, held: bool = False) -> ImageFrame:
    drop = np.zeros((0, 0) if held else (4, 4), "f4")
    return ImageFrame(skin="palm", scan=scan, source="stub", touched=True, held=held, reconstructed=7, image=drop)


def run(test: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 3 * WAIT_S))  # type: ignore[arg-type]


def test_asked_by_another_name_or_from_another_page_it_refuses(runtime: Path) -> None:
    async def test() -> None:
        async with serving() as server, aiohttp.ClientSession() as session:
            own = f"http://127.0.0.1:{server.door.port}"

            async def asked(path: str, **headers: str) -> tuple[int, aiohttp.typedefs.LooseHeaders]:
                async with session.get(own + path, headers=headers) as answer:
                    return answer.status, answer.headers

            status, headers = await asked("/")
            policy = headers["Content-Security-Policy"]  # type: ignore[index]
            assert status == 200 and "default-src 'none'" in policy and "unsafe" not in policy
            assert (await asked("/", Host="evil.example"))[0] == 421
            assert (await asked("/", Host=f"evil.example:{server.door.port}"))[0] == 421
            for path in ("/server.py", "/../server.py", "/%2e%2e/server.py", "/web/../main.js.map", "/etc/passwd"):
                assert (await asked(path))[0] == 404, path
            for origin in ("http://evil.example", f"https://127.0.0.1:{server.door.port}", "null", ""):
                with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                    async with session.ws_connect(f"{own}/live", headers={"Origin": origin}):
                        pass
                assert refused.value.status == 403, origin
            async with looking(server) as browser:
                await browser.watch("contact")

    run(test)


def test_beyond_the_loopback_looking_needs_the_token_too(runtime: Path) -> None:
    async def test() -> None:
        async with serving(host="0.0.0.0", names=("robot.lan",)) as server:
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                async with looking(server):
                    pass
            assert refused.value.status == 403
            async with looking(server, f"?token={SECRET}"):
                pass
            named = {"Host": f"robot.lan:{server.door.port}", "Origin": f"http://robot.lan:{server.door.port}"}
            async with looking(server, f"?token={SECRET}", **named):
                pass

    run(test)


def test_the_first_free_port_is_taken(runtime: Path) -> None:
    async def test() -> None:
        async with serving() as first, serving() as second:
            assert settings().port <= first.door.port < second.door.port

    run(test)


def test_commands_need_the_token_and_presses_the_stub(runtime: Path) -> None:
    asked: list[dict[str, Any]] = []
    publisher = Publisher("publisher")

    async def test() -> None:
        stub = ControlServer("stub", {"press": lambda args: asked.append(args) or {"presses": 1}})  # type: ignore[func-returns-value]
        async with serving() as server, looking(server) as browser:
            answering = asyncio.create_task(asyncio.to_thread(stub.serve_once, WAIT_S))
            press = {"x": 0.01, "y": 0.0, "force": 2.0}
            for token in ("", "wrong"):
                answer = await browser.command("press", token=token, **press)
                assert not answer["ok"] and "token" in answer["error"]
            assert "nobody just now" in (await browser.command("press", **press))["error"]
            await browser.watch("contact")
            await until(lambda: (publisher.poll(), publisher.wanted("contact", "palm"))[1])
            publisher.send(contact(1, source="board"))
            await browser.frames()
            assert "measured by board" in (await browser.command("press", **press))["error"]
            publisher.send(contact(2))
            await browser.frames()
            assert "no argument to_heart" in (await browser.command("press", to_heart=1))["error"]
            assert "no command 'load'" in (await browser.command("load"))["error"]
            assert not asked
            answer = await browser.command("press", **press)
            assert answer["ok"] and answer["result"] == {"presses": 1}
            assert asked == [{"skin": "palm", **press}]
            await answering
            await browser.socket.send_str("no JSON")
            await browser.socket.send_str("[1]")
            await browser.watch("contact")
        stub.close()

    run(test)
    publisher.close()


def test_the_services_recorder_is_told(runtime: Path, tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []

    async def test() -> None:
        answers = {"status": lambda args: {}, "snapshot": lambda args: asked.append(args) or {"file": "a.mcap"}}
        recorder = ControlServer("recorder", answers)  # type: ignore[arg-type]
        async with serving(recordings=str(tmp_path)) as server, looking(server) as browser:
            ended = asyncio.Event()

            async def serve() -> None:
                while not ended.is_set():
                    recorder.serve_once()
                    await asyncio.sleep(0.01)

            answering = asyncio.create_task(serve())
            assert "token" in (await browser.command("snapshot", token=""))["error"] and not asked
            answer = await browser.command("snapshot", after_s=1)
            assert answer["ok"] and answer["result"] == {"file": "a.mcap"} and asked == [{"after_s": 1}]
            assert "no argument folder" in (await browser.command("record", folder="/etc"))["error"]
            ended.set()
            await answering
        recorder.close()

    run(test)


def test_a_recorder_that_is_slow_to_answer_is_there(runtime: Path, tmp_path: Path) -> None:
    assert not OwnRecorder._answers(0.1)
    server = ControlServer("recorder", {"status": lambda: {}})  # and nobody serves it
    assert OwnRecorder._answers(0.1)
    server.close()


def test_where_no_recorder_runs_the_page_has_one_while_it_runs(runtime: Path, tmp_path: Path) -> None:
    async def test() -> None:
        async with serving(recordings=str(tmp_path)) as server, looking(server) as browser:
            answer = await browser.command("record", on=True)
            assert answer["ok"] and answer["result"]["recording"], answer
            file = Path(answer["result"]["file"])
            assert file.parent == tmp_path and file.exists()
            assert server.buttons.recording is not None
            process = server.buttons.recording._process
            assert process is not None and process.poll() is None
            assert (await browser.command("record", on=False))["result"]["file"] == str(file)
        assert process.poll() == 0

    run(test)


def test_nothing_is_subscribed_to_while_nobody_looks(runtime: Path) -> None:
    publisher = Publisher("publisher")

    def wanted(topic: str) -> bool:
        publisher.poll()
        return publisher.wanted(topic, "palm")

    async def test() -> None:
        async with serving() as server:
            assert not wanted("contact")
            async with looking(server) as browser, looking(server) as other:
                await browser.watch("contact", "shape")
                await other.watch("contact")
                await until(lambda: wanted("contact") and wanted("shape"))
                await browser.socket.close()
                await until(lambda: not wanted("shape"))
                assert wanted("contact")
            await until(lambda: not wanted("contact"))
            assert sum(server.looking.values()) == 0

    run(test)
    publisher.close()


def test_a_viewer_that_does_not_read_is_dropped_to_the_newest_and_holds_up_nobody(runtime: Path) -> None:
    publisher = Publisher("publisher")

    async def test() -> None:
        async with serving() as server, looking(server) as quick, looking(server) as slow:
            for browser in (quick, slow):
                await browser.watch("contact")
            await until(lambda: (publisher.poll(), publisher.subscribers("contact", "palm"))[1] > 0)
            seen = []
            for scan in range(1, 41):
                publisher.send(contact(scan))
                while not seen or seen[-1] < scan:
                    seen += [frame.scan for frame in await quick.frames()]
            assert seen == list(range(1, 41))
            got = []
            for _ in range(3):  # two were on their way before it had read any; what waits for it is the newest alone
                got += [frame.scan for frame in await slow.frames()]
            assert got[-1] == 40 and len(got) == 3, got

    run(test)
    publisher.close()


def test_who_comes_late_is_sent_the_picture_that_is_held(runtime: Path) -> None:
    inference = Publisher("inference")

    async def test() -> None:
        async with serving() as server, looking(server) as first:
            await first.watch("image")
            await until(lambda: (inference.poll(), inference.wanted("image", "palm"))[1])
            inference.send(image(7))
            assert [frame.scan for frame in await first.frames()] == [7]
            inference.send(image(8, held=True))
            assert [frame.scan for frame in await first.frames()] == [8]
            async with looking(server) as second:
                await second.watch("image")
                brought, held = await second.frames()
                assert isinstance(brought, ImageFrame) and isinstance(held, ImageFrame)
                assert (brought.scan, brought.image.size, held.scan, held.image.size) == (7, 16, 8, 0)

    run(test)
    inference.close()


def test_a_late_frame_is_sent_with_when_it_was_measured(runtime: Path) -> None:
    """So that a browser can tell its age, whatever clock it has."""
    publisher = Publisher("publisher")

    async def test() -> None:
        async with serving() as server, looking(server) as browser:
            await browser.watch("contact")
            await until(lambda: (publisher.poll(), publisher.wanted("contact", "palm"))[1])
            old = contact(1)
            old.stamps["sample"] -= 5_000_000_000
            publisher.send(old)
            message = await browser.hear("frames")
            assert (message["now"] - message["frames"][0][0]) * 1e-9 == pytest.approx(5, abs=2)
            await browser.socket.send_json({"ping": 12.5})
            pong = await browser.hear("pong")
            assert pong["ping"] == 12.5 and 0 <= time.monotonic_ns() - pong["now"] < 10e9

    run(test)
    publisher.close()


def test_each_reason_has_its_advice() -> None:
    assert ADVICE.keys() == REASONS.keys()
    assert all(text.endswith(".") for text in ADVICE.values())


def test_settings_that_say_too_little_are_refused() -> None:
    with pytest.raises(BridgeError, match="found {'port': 8080}.*expected host, port"):
        PageSettings.of(Handed({}, Transport(), {"port": 8080}))


def test_the_token_is_kept_for_a_runtime_folder_and_for_its_owner_alone(runtime: Path) -> None:
    first = kept_token("page")
    assert len(first) >= 16 and kept_token("page") == first != kept_token("foxglove")
    assert (runtime / "page.token").stat().st_mode & 0o777 == 0o600
    (runtime / "page.token").write_text("short")
    assert kept_token("page") not in ("short", first)


def test_only_recordings_of_the_folder_are_replayed(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out.mcap").write_bytes(b"")
    (tmp_path / "in" / "cut.mcap").write_bytes(b"cut short")
    (tmp_path / "in" / "notes.txt").write_bytes(b"")
    assert [(f["name"], f["bytes"], f["seconds"]) for f in listed(tmp_path / "in")] == [("cut.mcap", 9, None)]
    for name in ("../out.mcap", "notes.txt", "", "--help", str(tmp_path / "out.mcap")):
        with pytest.raises(ReplayRefused, match="there is no recording"):
            Replay(tmp_path / "in", name, 1.0, 0.0)
    for speed, start in ((0, 0.0), (1e9, 0.0), (1.0, -1.0), (float("nan"), 0.0), ("fast", 0.0), (1.0, None)):
        with pytest.raises(ReplayRefused, match="expected 0.05 to 50"):
            Replay(tmp_path / "in", "cut.mcap", speed, start)


def test_the_settings_in_skin_toml_reach_it() -> None:
    from services.bridge import settings as handed
    from services.runtime.config import ROOT, load

    found = PageSettings.of(Handed.read(handed("page", load(ROOT / "skin.toml"))))
    assert found.skins == ("palm",) and found.port == 8080 and Door(found.host, (), "").local
    assert json.loads(handed("page", load(ROOT / "skin.toml")))["options"]["host"] == "127.0.0.1"
    inside = PageSettings.of(Handed.read(handed("page", load(ROOT / "skin.toml"), "0.0.0.0", 9000)))
    assert (inside.host, inside.port) == ("0.0.0.0", 9000), "what a container's command says"


@pytest.mark.parametrize(
    ("host", "shown"),
    [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "127.0.0.1"), ("::", "[::1]"), ("fe80::1", "[fe80::1]"), ("lan", "lan")],
)
def test_the_printed_address_is_one_that_the_page_answers_to(host: str, shown: str) -> None:
    assert openable(host) == shown
    assert f"{shown}:0" in PageServer(settings(host=host), SECRET, lambda skin, measured_ns: None).door.names


def test_what_the_page_of_the_page_configures_is_understood() -> None:
    from services.runtime.config import ROOT, parse

    (block,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "page.md").read_text(), re.DOTALL)
    found = parse(tomllib.loads(block) | {"skins": {"palm": {"port": "stub", "bundle": "square16"}}})
    assert found.bridges == ("page",) and found.page.host == "0.0.0.0" and found.page.names == ("robot.lan",)
    assert found.page.metrics
