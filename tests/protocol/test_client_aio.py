"""The client for asyncio, against real sockets and processes."""

import asyncio
import contextlib
import gc
import warnings

import pytest

from protocol.aio import AsyncContactSubscriber
from protocol.client import NotValid, Stale
from protocol.sockets import Publisher

from .test_client import RESTARTED, ago, frame
from .test_sockets import run, subscribed

pytestmark = pytest.mark.live


@pytest.fixture
def publisher(runtime, context):
    return Publisher("publisher", context)


def test_latest_and_iterating(publisher):
    async def main():
        async with AsyncContactSubscriber("palm") as skin:
            with pytest.raises(Stale, match="no contact frame of palm yet"):
                await skin.latest(wait_s=0.0)
            subscribed(publisher)
            sending = asyncio.get_running_loop().call_later(0.05, lambda: publisher.send(frame()))
            assert (await skin.latest()).seq == 0, "the first one is waited for, and the loop was not blocked meanwhile"
            sending.cancel()
            frames = aiter(skin)
            for seq in range(1, 4):
                publisher.send(frame(valid_for_s=0.25))
                assert (await anext(frames)).seq == seq
            with pytest.raises(Stale, match="expected at most 0.250 s"):
                await anext(frames)
            publisher.send(frame(valid=False, reasons=["gap"]))
            with pytest.raises(NotValid, match="gap"):
                await skin.next_frame(1.0, valid=True)
            publisher.send(frame(source="replay"))
            with pytest.raises(Stale, match="1 replayed ones"):
                await skin.next_frame(0.2)
            assert skin.replayed == 1

    run_strictly(main())


def test_old_frames_are_skipped(publisher):
    async def main():
        async with AsyncContactSubscriber("palm") as skin:
            subscribed(publisher)
            publisher.send(frame(valid_for_s=0.25, stamps=ago(1.0)))
            with pytest.raises(Stale):
                await skin.next_frame(0.3)

    run_strictly(main())


def test_two_skins_side_by_side_and_a_cancelled_wait(publisher):
    async def main():
        async with AsyncContactSubscriber("palm") as palm, AsyncContactSubscriber("back") as back:
            subscribed(publisher, skin="palm")
            subscribed(publisher, skin="back")
            waiting = asyncio.create_task(palm.next_frame(60.0))
            other = asyncio.create_task(back.next_frame(60.0))
            await asyncio.sleep(0.05)
            waiting.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await waiting
            publisher.send(frame(skin="back"))
            assert (await other).skin == "back"
            publisher.send(frame())
            assert (await palm.next_frame(2.0)).skin == "palm"

    run_strictly(main())


def test_a_killed_service_is_found_again(runtime):
    async def main():
        sessions = set()
        async with AsyncContactSubscriber("palm") as skin:
            for _ in range(2):
                process = run(RESTARTED)
                try:
                    sessions.add((await skin.next_frame(5.0)).session)
                finally:
                    process.kill()
                    process.communicate()
                with pytest.raises(Stale):
                    async for _ in skin:
                        pass
        assert len(sessions) == 2

    run_strictly(main())


def run_strictly(coroutine):
    """Run it; what is left open or never awaited is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asyncio.run(coroutine, debug=False)
        gc.collect()
