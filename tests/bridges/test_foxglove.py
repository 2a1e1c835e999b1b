"""The bridge to Foxglove, spoken to as the application does."""

import asyncio
import base64
import re
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from tests.bridges.conftest import FakeService, RunningBridge
from tests.bridges.viewer import PROTOCOL, Viewer
from tests.waiting import WAIT_S, until

pytestmark = pytest.mark.live


@pytest.fixture
def bridge(request: pytest.FixtureRequest, runtime: Path, fake: FakeService) -> Iterator[Any]:
    """The bridge, the address that it printed, the token."""
    running = RunningBridge("foxglove", runtime, getattr(request, "param", "port = 0"))
    try:
        running.status()
        yield running, *re.search(r'open (ws://\S+) .*"token": "(\S+)"', running.said()).groups()
        assert "Traceback" not in running.said() and "Unhandled" not in running.said(), running.said()
    finally:
        running.close()


def run(address: str, test: Callable[[Viewer], Awaitable[None]]) -> None:
    async def with_viewer() -> None:
        viewer = await Viewer.connect(address)
        await asyncio.wait_for(test(viewer), 3 * WAIT_S)
        viewer.close()

    asyncio.run(with_viewer())


def test_what_is_looked_at_is_shown_while_it_is_valid_and_nothing_else_is_asked_for(fake, bridge) -> None:
    running, address, _ = bridge
    assert running.status()["idle"] is True and not any(fake.subscribers.values()), "nobody looks"

    async def look(viewer: Viewer) -> None:
        await viewer.subscribe("/palm/forces")
        ns, forces = await viewer.message("/palm/forces")
        assert abs(ns - time.time_ns()) < WAIT_S * 1e9
        assert (forces["fz"], forces["ty"], forces["force_n"], forces["touches"]) == (-3.0, 0.06, 3.0, 1)
        assert forces["contacts"][0]["x"] == 0.02
        assert fake.subscribers["contact"] == 1 and not fake.subscribers["image"] and not fake.subscribers["shape"]
        await viewer.subscribe("/palm/image", "/palm/scene", "/palm/log")
        _, image = await viewer.message("/palm/image")
        pixels = np.frombuffer(base64.b64decode(image["data"]), "<f4").reshape(image["height"], image["width"])
        assert image["encoding"] == "32FC1" and pixels[3, 6] == np.float32(0.3)  # row 0 is the highest y
        while True:
            entity = (await viewer.message("/palm/scene"))[1]["entities"][0]
            if entity["id"] == "contacts" and len(entity["lines"][0]["points"]) == 4:
                break  # the contact's own outline
        assert entity["frame_id"] == "palm" and entity["lifetime"] == "0.250s"
        start, turn = entity["arrows"][0]["pose"]["position"], entity["arrows"][0]["pose"]["orientation"]
        assert start["z"] == pytest.approx(0.03) and (turn["y"], turn["w"]) == pytest.approx((0.5**0.5, 0.5**0.5))
        fake.valid = False
        while "frozen" not in (line := (await viewer.message("/palm/log"))[1])["message"]:
            pass
        assert line["level"] == "WARNING"
        fake.contact, fake.valid = 2, True  # what comes next is of the time after
        while (await viewer.message("/palm/forces"))[1]["contacts"][0]["id"] != 2:
            pass
        offset = time.time_ns() - time.monotonic_ns()
        bad = [at + offset for _, at, valid in fake.sent if not valid]
        assert bad and not [ns for ns in viewer.times["/palm/forces"] if min(abs(ns - at) for at in bad) < 1e6]

    run(address, look)
    until(lambda: not any(fake.subscribers.values()), running.process)


def test_services_ask_for_the_token(fake: FakeService, bridge) -> None:
    _, address, token = bridge

    async def call(viewer: Viewer) -> None:
        for service, says, args in (
            *(("/palm/tare", "token", wrong) for wrong in ({}, {"token": "x"}, {"token": ""}, {"token": None})),
            ("/record", "token", {"on": True}),
            ("/palm/tare", "unknown: force", {"token": token, "force": True}),
        ):
            answer = await viewer.call(service, **args)
            assert answer["success"] is False and says in answer["message"], answer
        assert not fake.tares
        done = await viewer.call("/palm/tare", token=token)
        assert done["success"] is True and "64" in done["message"] and fake.tares == ["palm"]
        assert {"/palm/press", "/palm/fault", "/record", "/snapshot"} <= viewer.services.keys()

    run(address, call)


@pytest.mark.parametrize("bridge", ["port = 0", 'port = 0\nhost = "0.0.0.0"'], indirect=True, ids=["here", "beyond"])
def test_who_may_look(bridge, request: pytest.FixtureRequest) -> None:
    """Here any program, no page but Foxglove's own with the printed address; beyond it the token is needed."""
    _, address, token = bridge
    own = address.partition("/?")[0].removeprefix("ws://")
    assert own.startswith("127.0.0.1:") and address.endswith(f"/?token={token}"), "one that this computer can open"

    async def look(viewer: Viewer) -> None:
        await viewer.subscribe("/palm/forces")
        async with aiohttp.ClientSession() as session:

            async def status(given: str, **headers: str) -> int:
                try:
                    async with session.ws_connect(f"ws://{own}/{given}", headers=headers, protocols=[PROTOCOL]):
                        return 0
                except aiohttp.WSServerHandshakeError as why:
                    return why.status

            for given in ("", f"?t={token}", f"?token={token[:-1]}"):
                assert await status(given) == (403 if "beyond" in request.node.name else 0)
                for origin in ("http://evil.com", "null", "file://", "https://app.foxglove.dev"):
                    assert await status(given, Origin=origin) == 403, origin
            for origin in ("file://", "https://app.foxglove.dev"):  # its application and its website
                assert await status(f"?token={token}", Origin=origin) == 0
            assert await status(f"?token={token}", Host="evil.com") == 421

    run(address, look)
