"""Acquisition: raw frames from each skin's source to the sockets. `python -m services.acquisition`

Sources block, so each runs in a thread of its own; the runner takes their frames as they come.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from models.bundle import Bundle
from protocol import transport
from protocol.frames import Frame, RawFrame, StatusFrame
from protocol.sockets import AllReader
from services.board.host_time import SUSPENDED_NS, HostTime
from services.board.parts_or_whole import PartsOrWhole
from services.board.source import BoardSource, Source
from services.process import main
from services.recordings.file_source import FileSource, RecordingSource
from services.runner import Runner
from services.runtime.config import Skin
from services.runtime.stage import Health, Stage

CLOSE_S = 0.2  # how long a stop waits for a source that blocks; its thread dies with the process
QUEUE = 256  # frames that the runner may be behind before the oldest are dropped

log = logging.getLogger(__name__)


def open_source(name: str, skin: Skin, bundle: Bundle) -> Source:
    """Open the source that a skin's `port` names."""
    kind = {".mcap": RecordingSource, ".npz": FileSource}.get(Path(skin.port).suffix, BoardSource)
    return kind(name, skin, bundle)


class Acquiring(Stage):
    """source -> raw: the frames as the source gives them."""

    reads = ""
    writes = ("raw",)
    stamp = "read"

    def __init__(self, name: str, feed: SourceFeed, load: Load | None = None) -> None:
        super().__init__(name)
        self._feed, self._load = feed, load

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        return [frame]

    def between_frames(self) -> None:
        if self._load is not None:
            self._load.look(self.skin)

    def health(self) -> Health:
        found = self._feed.source.health()
        found.counters["overrun"] = self._feed.overrun
        found.counters["slept_over"] = self._feed.slept_over
        return found


class SourceFeed:
    """A source in a thread; `socket` becomes readable when frames wait. ending: to be shared by all of a process: the
    first that is closed ends them all.
    """

    def __init__(self, source: Source, host: HostTime | None = None, ending: threading.Event | None = None) -> None:
        self.source = source
        if ending is not None:
            source.ending = ending
        self._host = host or HostTime()
        self.slept_over = 0  # frames that waited while the machine was suspended: their stamps do not show it
        self.socket = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.overrun = 0
        self.malformed = self.skipped = 0
        self._frames: deque[tuple[RawFrame, int]] = deque()  # and for how long the machine had been suspended by then
        self._stop = source.ending
        self._thread = threading.Thread(target=self._run, name=f"source-{source.name}", daemon=True)
        self._thread.start()

    def recv(self) -> Frame | None:
        """The oldest frame not yet taken, or None."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.socket)
        suspended_ns = self._host.suspended_ns()
        while True:
            try:
                frame, then_ns = self._frames.popleft()
            except IndexError:
                return None
            if suspended_ns - then_ns < SUSPENDED_NS:
                return frame
            self.slept_over += 1

    def close(self) -> None:
        """Tell the thread to end, which closes the source, and wait CLOSE_S for it at most."""
        self._stop.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            self._feed()
        finally:
            self.source.close()

    def _feed(self) -> None:
        while not self._stop.is_set():
            try:
                for frame in self.source.frames():
                    if frame is not None:
                        self._frames.append((frame, self._host.suspended_ns()))
                        if len(self._frames) > QUEUE:
                            self._frames.popleft()
                            self.overrun += 1
                        os.eventfd_write(self.socket, 1)
                    if self._stop.is_set():
                        return
            except (
                Exception
            ) as why:  # a source that raises is a bug, yet the other skins go on and this one is tried again
                log.exception("source of %s", self.source.name)
                self.source.problem = f"internal error: {type(why).__name__}: {why}"
                self._stop.wait(1.0)


class Load:
    """How preprocessing keeps up with the boards that scan in parts, by its own statuses."""

    def __init__(self, boards: Sequence[BoardSource]) -> None:
        self._boards = {board.name: board for board in boards}
        self._choice = PartsOrWhole(self._boards)
        self._reader = AllReader(["status"], endpoint=transport.current().data_address("preprocessing"))

    def look(self, skin: str) -> None:
        """Tell its board whether it is to scan whole for now. Boards that know no parts tell nothing of the load."""
        while (status := self._reader.recv()) is not None:
            board = self._boards.get(status.skin)
            if isinstance(status, StatusFrame) and status.process == "preprocessing" and board and board.in_parts:
                self._choice.update(status, time.monotonic())
        if skin in self._boards:
            self._boards[skin].whole = self._choice.whole(skin)


def run(runner: Runner) -> None:
    ending = threading.Event()
    sources = [open_source(name, skin, runner.bundle(name)) for name, skin in runner.config.skins.items()]
    boards = [source for source in sources if isinstance(source, BoardSource) and source.in_parts]
    load = Load(boards) if boards else None
    for source in sources:
        feed = SourceFeed(source, ending=ending)
        runner.add(Acquiring(source.name, feed, load), feed)


if __name__ == "__main__":
    sys.exit(main("acquisition", run))
