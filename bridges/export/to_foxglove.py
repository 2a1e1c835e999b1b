"""MCAP with Foxglove's own schemas: the same channels as live."""

from __future__ import annotations

import contextlib
import errno
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import foxglove
from foxglove import Context
from foxglove.messages import LogLevel

from bridges.foxglove.channels import FoxgloveChannels, Outlines
from protocol.frames import ContactFrame, ImageFrame, InfoFrame, ShapeFrame

from .entries import Entry


@contextlib.contextmanager
def _opened(path: Path, context: Context) -> Iterator[None]:
    """The file. Raises OSError, where the package raises errors of its own."""
    try:
        with foxglove.open_mcap(path, context=context):
            yield
    except RuntimeError as why:
        raise OSError(errno.EIO, f"{why}: is there room on the disk?") from None


def write_foxglove(entries: Iterable[Entry], path: Path) -> Counter[str]:
    """Write all entries; how many messages of each topic. The file must not be there."""
    context = Context()
    shown: dict[str, FoxgloveChannels] = {}
    outlines: dict[str, tuple[str, int, Outlines]] = {}  # of each skin: session, scan, outline of each contact
    said: dict[str, str] = {}
    with _opened(path, context):
        for entry in entries:
            frame, ns, skin = entry.frame, entry.ns, entry.skin
            if skin not in shown:
                shown[skin] = FoxgloveChannels(skin, skin, context)
            channels = shown[skin]
            if isinstance(frame, ContactFrame):
                channels.frame_id = frame.frame_id or skin
                reasons = ", ".join(frame.reasons) or "no reason given"
                now = "valid" if frame.valid else f"not valid: {reasons}"
                if said.get(skin) != now:
                    said[skin] = now
                    channels.put_log(now, ns, LogLevel.Info if frame.valid else LogLevel.Warning)
                if frame.valid:
                    session, scan, found = outlines.get(skin, ("", 0, {}))
                    near = session == frame.session and abs(frame.scan - scan) <= 1
                    channels.put_contacts(frame, ns, found if near else {})
            elif isinstance(frame, ShapeFrame) and frame.valid:
                outlines[skin] = frame.session, frame.scan, dict(zip(frame.ids, frame.outlines, strict=True))
            elif isinstance(frame, ImageFrame) and frame.valid:
                channels.put_image(frame, ns)
            elif isinstance(frame, InfoFrame):
                channels.put_place(frame, ns)
    return Counter({f"/{s}/{what}": n for s, channels in shown.items() for what, n in channels.sent.items() if n})
