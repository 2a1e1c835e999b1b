"""What the page's buttons do: commands to the service's processes, by those who have the token."""

from __future__ import annotations

import asyncio
import hmac
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.control import ControlClient, ControlError
from protocol.runtime import runtime_dir

from .feed import SkinFeed

TOKEN_FILE = "page.token"
TIMEOUT_S = {"preprocessing": 10.0, "stub": 2.0, "recorder": 2.0}


@dataclass(frozen=True)
class Button:
    """The process that a command goes to, and the arguments it may have. `stub`: only where the skin is the stub's."""

    process: str
    args: tuple[str, ...] = ()
    stub: bool = True


BUTTONS = {
    "tare": Button("preprocessing", ("force",), stub=False),
    "press": Button("stub", ("x", "y", "force", "radius", "shape", "rotation", "seconds", "finger")),
    "release": Button("stub", ("finger",)),
    "scene": Button("stub", ("name",)),
    "fault": Button("stub", ("name", "args", "seconds", "clear")),
    "record": Button("recorder", ("on",), stub=False),
}


def token() -> str:
    """What commands must come with: made once for a runtime folder, which nobody else may enter, and kept there, so
    that the printed address goes on to hold when the page's process is started anew.
    """
    path = runtime_dir() / TOKEN_FILE
    try:
        if len(known := path.read_text().strip()) >= 16:
            return known
    except OSError:
        pass
    new = secrets.token_urlsafe(16)
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(new)
    return new


class Buttons:
    """Carries out what browsers ask for."""

    def __init__(self, secret: str, feeds: Mapping[str, SkinFeed], recordings: str) -> None:
        self._secret, self._feeds = secret, feeds
        self.recording = RecorderProcess(Path(recordings)) if recordings else None

    def knows(self, given: str) -> bool:
        """Whether somebody has the token."""
        return hmac.compare_digest(given.encode(), self._secret.encode())

    async def press(self, skin: str, command: str, args: dict[str, Any], given: str) -> dict[str, Any]:
        """{ok, result} or {ok, error}, for the person at the page."""
        button, feed = BUTTONS.get(command), self._feeds.get(skin)
        if not self.knows(given):
            return _no("commands need the token of the address that the service printed: open that address")
        if button is None or feed is None:
            return _no(f"there is no command {command[:32]!r}" if button is None else f"there is no skin {skin[:64]!r}")
        if button.stub and feed.source != "stub":
            return _no(f"{command} is for the stub's skin: {skin} is measured by {feed.source or 'nobody just now'}")
        if unknown := sorted(set(args) - set(button.args)):
            return _no(f"{command} has no argument {', '.join(unknown)[:80]}")
        try:
            return {"ok": True, "result": await asyncio.to_thread(self._call, button.process, skin, command, args)}
        except (ControlError, OSError) as why:
            return _no(str(why))

    def _call(self, process: str, skin: str, command: str, args: dict[str, Any]) -> dict[str, Any]:
        if command == "record":
            if self.recording is None:
                raise ControlError("bad_request", "the page has no folder for recordings")
            return self.recording.start() if args.get("on") else self.recording.stop()
        return ControlClient(process, TIMEOUT_S[process]).call(command, skin=skin, **args)

    def close(self) -> None:
        if self.recording is not None:
            self.recording.stop()


class RecorderProcess:
    """A recorder that the page starts and ends."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder.absolute()
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> dict[str, Any]:
        if self._process is None or self._process.poll() is not None:
            command = [sys.executable, "-m", "services.recorder", "--folder", str(self._folder)]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        return {"recording": True, "folder": str(self._folder)}

    def stop(self) -> dict[str, Any]:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = None
        return {"recording": False, "folder": str(self._folder)}


def _no(why: str) -> dict[str, Any]:
    return {"ok": False, "error": why}
