"""What crosses a process or a wire: frames, topics, sockets, the board link, and the client for controllers.

Needs numpy, pyzmq and msgpack only. WIRE.md documents every byte of it. The names of `__all__` can be imported from
here; each is loaded when it is first used. Where to look:

    client.py, listener.py, aio.py     for a robot controller: the newest contacts, never old ones; callbacks; asyncio
    freshness.py, ages.py              what is new enough, and valid, to be acted on; how old a frame is
    topics.py, frame_types.py          the table of topics; the frames' fields with types, ranges and units
    frames.py, fields.py, records.py   frames as messages and back, checked
    held.py                            the image that held frames stand for
    views.py                           what is shown of frames: labels, totals, turns
    sockets.py, control.py             publishing, reading, commands
    metering.py                        a process's rates, latencies and CPU, for its status
    runtime.py, transport.py           where the sockets are, whose they are, TCP and keys
    link.py, link_messages.py          the board's serial link (with cobs.py and ad5940.py)
    errors.py                          the base of all exceptions, and their tree
    wire_doc.py                        prints WIRE.md's tables
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.2.0"

__all__ = [
    "AsyncContactSubscriber", "Contact", "ContactFrame", "ContactListener", "ContactSubscriber", "ControlError",
    "DeltaFrame", "EitskinError", "ForceFrame", "Frame", "FrameError", "ImageFrame", "InfoFrame",
    "JudgementsFrame", "NotValid", "PartFrame", "RawFrame", "ShapeFrame", "StackFrame", "Stale", "StatusFrame",
    "TransportError", "TruthFrame", "__version__",
]  # fmt: skip

if TYPE_CHECKING:
    from .aio import AsyncContactSubscriber
    from .client import ContactSubscriber
    from .control import ControlError
    from .errors import EitskinError
    from .frames import (
        Contact,
        ContactFrame,
        DeltaFrame,
        ForceFrame,
        Frame,
        FrameError,
        ImageFrame,
        InfoFrame,
        JudgementsFrame,
        PartFrame,
        RawFrame,
        ShapeFrame,
        StackFrame,
        StatusFrame,
        TruthFrame,
    )
    from .freshness import NotValid, Stale
    from .keys import TransportError
    from .listener import ContactListener
else:
    _HOMES = {
        "aio": ("AsyncContactSubscriber",),
        "client": ("ContactSubscriber",),
        "control": ("ControlError",),
        "errors": ("EitskinError",),
        "freshness": ("NotValid", "Stale"),
        "keys": ("TransportError",),
        "listener": ("ContactListener",),
    }
    _HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

    def __getattr__(name: str) -> object:
        """A public name, from the module that defines it; a frame's from frames.py."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        value = getattr(import_module(f"{__name__}.{_HOME_OF.get(name, 'frames')}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
