"""The bridge to Foxglove, spoken to as the application does."""

from __future__ import annotations

import asyncio
import base64
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from tornado.httpclient import HTTPClientError

from protocol.control import ControlServer
from tests.bridges.conftest import FakeService, RunningBridge
from tests.bridges.viewer import Viewer

pytestmark = pytest.mark.live


def started(folder: Path, section: str) -> tuple[RunningBridge, str, str]:
    """The bridge, the address that it printed, the token."""
    bridge = RunningBridge("foxglove", folder, section)
    try:
        bridge.status()
        found = re.search(r'open (ws://\S+) .*"token": "(\S+)"', bridge.said())
        assert found, bridge.said()
    except AssertionError:
        bridge.process.kill()
        raise
    return bridge, found[1], found[2]


@pytest.fixture
def bridge(runtime: Path, fake: FakeService) -> Iterator[tuple[RunningBridge, str, str]]:
    found = started(runtime, "port = 0")
    try:
        yield found
    finally:
        found[0].close()


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def test_what_is_looked_at_is_shown_and_nothing_else_is_asked_for(
    fake: FakeService, bridge: tuple[RunningBridge, str, str]
) -> None:
    running, address, _ = bridge
    assert not any(fake.subscribers.values()), "it subscribes though nobody looks"
    assert running.status()["idle"] is True

    async def look() -> None:
        viewer = await Viewer.connect(address)
        await viewer.subscribe("/palm/forces")
        ns, forces = await viewer.message("/palm/forces")
        assert abs(ns - time.time_ns()) < 20e9
        assert (forces["fz"], forces["ty"], forces["force_n"], forces["touches"]) == (-3.0, 0.06, 3.0, 1)
        assert forces["contacts"][0]["x"] == 0.02
        assert fake.subscribers["contact"] == 1 and not fake.subscribers["image"] and not fake.subscribers["shape"]
        await viewer.subscribe("/palm/image", "/palm/scene")
        _, image = await viewer.message("/palm/image")
        pixels = np.frombuffer(base64.b64decode(image["data"]), "<f4").reshape(image["height"], image["width"])
        assert image["encoding"] == "32FC1" and pixels[3, 6] == np.float32(0.3)  # row 0 is the highest y
        while True:
            _, scene = await viewer.message("/palm/scene")
            entity = scene["entities"][0]
            if entity["id"] == "contacts" and len(entity["lines"][0]["points"]) == 4:
                break  # the contact's own outline
        assert entity["frame_id"] == "palm" and entity["lifetime"] == "0.250s"
        start, turn = entity["arrows"][0]["pose"]["position"], entity["arrows"][0]["pose"]["orientation"]
        assert start["z"] == pytest.approx(0.03) and (turn["y"], turn["w"]) == pytest.approx((0.5**0.5, 0.5**0.5))
        viewer.close()

    asyncio.run(look())
    wait_for(lambda: not any(fake.subscribers.values()))


def test_what_is_not_valid_is_not_shown_and_the_log_says_why(
    fake: FakeService, bridge: tuple[RunningBridge, str, str]
) -> None:
    _, address, _ = bridge

    async def look() -> None:
        viewer = await Viewer.connect(address)
        await viewer.subscribe("/palm/forces", "/palm/log")
        await viewer.message("/palm/forces")
        fake.valid = False
        while "frozen" not in (line := (await viewer.message("/palm/log"))[1])["message"]:
            pass
        assert line["level"] == "WARNING"
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.5):
                await viewer.message("/palm/forces")
        viewer.close()

    asyncio.run(look())


def test_services_ask_for_the_token(fake: FakeService, bridge: tuple[RunningBridge, str, str]) -> None:
    _, address, token = bridge

    async def call() -> None:
        viewer = await Viewer.connect(address)
        for wrong in ({}, {"token": "x"}, {"token": ""}, {"token": None}):
            refused = await viewer.call("/palm/tare", **wrong)
            assert refused["success"] is False and "token" in refused["message"]
        assert not fake.tares
        odd = await viewer.call("/palm/tare", token=token, force=True)
        assert odd["success"] is False and "unknown: force" in odd["message"] and not fake.tares
        done = await viewer.call("/palm/tare", token=token)
        assert done["success"] is True and "64" in done["message"] and fake.tares == ["palm"]
        assert {"/palm/press", "/palm/fault"} <= viewer.services.keys()
        absent = await viewer.call("/palm/press", token=token, x=0.0, y=0.0, force=1.0)  # no stub runs here
        assert absent["success"] is False and "stub does not answer" in absent["message"]
        viewer.close()

    asyncio.run(call())


def test_the_recorder_is_told_by_who_has_the_token(
    fake: FakeService, bridge: tuple[RunningBridge, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, address, token = bridge
    told: list[tuple[str, dict[str, object]]] = []
    ended = threading.Event()

    def recorder() -> None:
        def taking(command: str) -> Callable[[dict[str, object]], dict[str, object]]:
            return lambda args: told.append((command, args)) or {"file": "20260101T000000Z.mcap"}

        server = ControlServer("recorder", {name: taking(name) for name in ("record", "snapshot")})
        while not ended.is_set():
            server.serve_once(0.02)
        server.close()

    async def call() -> None:
        viewer = await Viewer.connect(address)
        absent = await viewer.call("/record", token=token, on=True)
        assert absent["success"] is False and "[recorder] in skin.toml" in absent["message"]
        serving = threading.Thread(target=recorder)
        serving.start()
        try:
            for wrong in ({}, {"token": "x"}):
                assert (await viewer.call("/record", **wrong))["success"] is False
            odd = await viewer.call("/record", token=token, on="yes")
            assert odd["success"] is False and "true or false" in odd["message"] and not told
            unsaid = await viewer.call("/record", token=token)
            assert unsaid["success"] is False and "argument on: found none" in unsaid["message"] and not told
            done = await viewer.call("/record", token=token, on=True)
            assert done["success"] is True and "20260101" in done["message"]
            await viewer.call("/record", token=token, on=False)
            await viewer.call("/snapshot", token=token, before_s=5)
        finally:
            ended.set()
            serving.join()
        assert told == [("record", {"on": True}), ("record", {"on": False}), ("snapshot", {"before_s": 5})]
        viewer.close()

    asyncio.run(call())


def test_beyond_this_host_even_looking_needs_the_token(runtime: Path, fake: FakeService) -> None:
    bridge, address, token = started(runtime, 'port = 0\nhost = "0.0.0.0"')
    try:
        assert address.startswith("ws://127.0.0.1:"), "one that this computer can open"
        assert address.endswith(f"/?token={token}")

        async def look() -> None:
            for wrong in (address.partition("?")[0], address[:-1], address.replace("token", "t")):
                with pytest.raises(HTTPClientError, match="403"):
                    await Viewer.connect(wrong)
            viewer = await Viewer.connect(address)
            await viewer.subscribe("/palm/forces")
            assert (await viewer.message("/palm/forces"))[1]["force_n"] == 3.0
            viewer.close()

        asyncio.run(look())
    finally:
        bridge.close()
