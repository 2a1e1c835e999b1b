"""A stranger's program that uses the installed wheel: it must run, and type-check, with nothing of this checkout."""

import asyncio
import importlib
import os
import pkgutil
import tempfile

import eitskin
from eitskin import AsyncContactSubscriber, ContactFrame, ContactListener, ContactSubscriber

os.environ.setdefault("EITSKIN_RUNTIME", tempfile.mkdtemp(prefix="eit", dir="/tmp"))
for module in pkgutil.iter_modules(eitskin.__path__):
    importlib.import_module(f"eitskin.{module.name}")
assert all(getattr(eitskin, name) for name in eitskin.__all__) and issubclass(eitskin.Stale, eitskin.EitskinError)


def on_frame(frame: ContactFrame) -> None:
    print(frame.seq, [contact.position for contact in frame.contacts])


def by_subscriber() -> None:
    with ContactListener("palm", on_frame, print), ContactSubscriber("palm") as skin:
        on_frame(skin.latest(wait_s=0.0))


async def by_asyncio() -> None:
    async with AsyncContactSubscriber("palm") as skin:
        on_frame(await skin.latest(wait_s=0.0))


try:
    by_subscriber()
    asyncio.run(by_asyncio())
except eitskin.Stale as why:
    print(why)
