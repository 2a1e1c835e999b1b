"""A stranger's program that uses the installed wheel: it must run, and type-check, with nothing of this checkout.

python tests/protocol/use_the_wheel.py, in an environment that holds the wheel and what it needs.
"""

import asyncio
import os
import tempfile
import threading
import time

import eitskin
from eitskin import (
    AsyncContactSubscriber,
    ContactFrame,
    ContactListener,
    ContactSubscriber,
    EitskinError,
    NotValid,
    Stale,
)
from eitskin.sockets import Publisher


def send_until(done: threading.Event, publisher: Publisher) -> None:
    while not done.wait(0.02):
        publisher.send(ContactFrame(skin="palm", valid=True, valid_for_s=1.0, stamps={"sample": time.monotonic_ns()}))


async def by_asyncio() -> None:
    async with AsyncContactSubscriber("palm") as skin:
        print("asyncio:", (await skin.latest(wait_s=5.0, valid=True)).seq)
        async for frame in skin:
            print("asyncio:", frame.seq)
            break


def main() -> None:
    done, seen, silent = threading.Event(), threading.Event(), threading.Event()

    def on_contact(frame: ContactFrame) -> None:
        seen.set()

    def on_stale(why: Stale) -> None:
        silent.set()

    publisher = Publisher("publisher")
    sending = threading.Thread(target=send_until, args=(done, publisher))
    sending.start()
    try:
        with ContactSubscriber("palm") as skin:
            try:
                frame: ContactFrame = skin.latest(wait_s=5.0, valid=True)
            except NotValid as why:
                assert isinstance(why, EitskinError)
                raise SystemExit(f"{why.frame.reasons}") from None
            print("client:", frame.seq, [contact.position for contact in frame.contacts])
        asyncio.run(by_asyncio())
        with ContactListener("palm", on_contact, on_stale):
            if not seen.wait(5.0):
                raise SystemExit("the listener was not called")
            done.set()
            if not silent.wait(5.0):
                raise SystemExit("the listener was not told of silence")
    finally:
        done.set()
        sending.join()
        publisher.close()
    print(f"the wheel of {eitskin.__version__} works")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as folder:
        os.environ["EITSKIN_RUNTIME"] = folder
        main()
