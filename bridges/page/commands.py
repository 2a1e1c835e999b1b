"""What the page's buttons do: commands to the service's processes, by those who have the token."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bridges.door import Door
from protocol.control import ControlClient, ControlError
from protocol.errors import in_words
from protocol.topics import RECORDER

from .feed import SkinFeed
from .replays import REPLAY, Replay, ReplayRefused, listed

TIMEOUT_S = {"preprocessing": 10.0, "stub": 2.0, RECORDER: 10.0}
THERE_S, BEGIN_S, STOP_S = 0.3, 8.0, 5.0
"""For a recorder to answer that runs, to begin, to end."""


@dataclass(frozen=True)
class Button:
    """The process that a command goes to ("": the page itself), and the arguments it may have. `stub`: only where the
    skin is the stub's. The recorder is one for all skins.
    """

    process: str
    args: tuple[str, ...] = ()
    stub: bool = True


BUTTONS = {
    "tare": Button("preprocessing", ("force",), stub=False),
    "press": Button("stub", ("x", "y", "force", "radius", "shape", "rotation", "seconds", "finger")),
    "release": Button("stub", ("finger",)),
    "scene": Button("stub", ("name",)),
    "fault": Button("stub", ("name", "args", "seconds", "clear")),
    "record": Button(RECORDER, ("on",), stub=False),
    "snapshot": Button(RECORDER, ("before_s", "after_s"), stub=False),
    "recordings": Button("", stub=False),
    "replay": Button("", ("file", "skin", "speed", "from"), stub=False),
    "replaying": Button("", stub=False),
}


class Buttons:
    """Carries out what browsers ask for."""

    def __init__(self, door: Door, feeds: dict[str, SkinFeed], recordings: str, tell: Callable[[bool], None]) -> None:
        """tell: called when there is news of a replay."""
        self._door, self._feeds, self._tell = door, feeds, tell
        self.recording = OwnRecorder(Path(recordings)) if recordings else None
        self._replay: Replay | None = None

    async def press(self, skin: str, command: str, args: dict[str, Any], given: str) -> dict[str, Any]:
        """{ok, result} or {ok, error}, for the person at the page."""
        button, feed = BUTTONS.get(command), self._feeds.get(skin)
        if not self._door.knows(given):
            return _no("commands need the token of the address that the service printed: open that address")
        if button is None or feed is None:
            return _no(f"there is no command {command[:32]!r}" if button is None else f"there is no skin {skin[:64]!r}")
        if button.stub and feed.source != "stub":
            return _no(f"{command} is for the stub's skin: {skin} is measured by {feed.source or 'nobody just now'}")
        if unknown := sorted(set(args) - set(button.args)):
            return _no(f"{command} has no argument {', '.join(unknown)[:80]}")
        if button.process not in ("", RECORDER) and skin == REPLAY:
            return _no(f"{command} is for a skin, not for a recording")
        try:
            return {"ok": True, "result": await self._carry_out(button.process, skin, command, args)}
        except (ControlError, OSError, ReplayRefused) as why:
            return _no(in_words(why))

    async def _carry_out(self, process: str, skin: str, command: str, args: dict[str, Any]) -> dict[str, Any]:
        if process and process != RECORDER:
            client = ControlClient(process, TIMEOUT_S[process])
            return await asyncio.to_thread(partial(client.call, command, skin=skin, **args))
        if self.recording is None:
            raise ReplayRefused("the page has no folder for recordings")
        if process:
            return await asyncio.to_thread(self.recording.call, command, args)
        if command == "recordings":
            return {"files": await asyncio.to_thread(listed, self.recording.folder)}
        if command == "replaying":
            return self._replay.state() if self._replay is not None else {"playing": False, "failed": False}
        return await self._replayed(skin, self.recording.folder, args)

    async def _replayed(self, skin: str, folder: Path, args: dict[str, Any]) -> dict[str, Any]:
        """One replay at a time: a new one, or another place of it, ends the one before."""
        if self._replay is not None:
            await asyncio.to_thread(self._replay.close)
            self._replay = None
        if (feed := self._feeds.pop(REPLAY, None)) is not None:
            feed.close()
        if not args.get("file"):
            return {"playing": False}
        shown = args.get("skin") or skin
        if shown not in self._feeds:
            raise ReplayRefused(f"there is no skin {shown!r:.64}")
        self._replay = Replay(folder, str(args["file"]), args.get("speed", 1.0), args.get("from", 0.0))
        self._feeds[REPLAY] = SkinFeed(str(shown), self._tell, self._replay.runtime)
        return {"playing": True}

    async def close(self) -> None:
        if self._replay is not None:
            await asyncio.to_thread(self._replay.close)
        if self.recording is not None:
            await asyncio.to_thread(self.recording.stop)


class OwnRecorder:
    """The service's recorder; where none runs, one that the page starts and ends."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def call(self, command: str, args: dict[str, Any]) -> dict[str, Any]:
        """Its answer. Raises ControlError, and ReplayRefused where none can be started."""
        with self._lock:
            if not self._answers(THERE_S):
                self._start()
        return ControlClient(RECORDER, TIMEOUT_S[RECORDER]).call(command, **args)

    def _start(self) -> None:
        command = [sys.executable, "-m", "services.recorder", "--wait", "--folder", str(self.folder)]
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        end = time.monotonic() + BEGIN_S
        while not self._answers(THERE_S):
            if self._process.poll() is not None or time.monotonic() > end:
                self.stop()
                raise ReplayRefused("no recorder runs, and none could be started; the service's output says why")

    @staticmethod
    def _answers(seconds: float) -> bool:
        """Whether a recorder is there; one that is slow to answer is."""
        try:
            ControlClient(RECORDER, seconds).call("status")
        except ControlError as why:
            return why.kind != "unreachable"
        return True

    def stop(self) -> None:
        """End ours; the service's goes on."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = None


def _no(why: str) -> dict[str, Any]:
    return {"ok": False, "error": why}
