"""Recordings shown on the page: `skin replay` feeds stages of its own, in a runtime folder of its own."""

from __future__ import annotations

import logging
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from protocol.errors import INCOMPLETE, EitskinError

REPLAY = "replay"
"""What the replay is called among the skins: no skin may be called so while it plays."""
SKIN = Path(__file__).resolve().parents[2] / "skin"
MOST_FILES = 200
STOP_S = 2.0

log = logging.getLogger(__name__)


class ReplayRefused(EitskinError):
    """The page does not record or replay now; the text says why."""


def listed(folder: Path) -> list[dict[str, Any]]:
    """The recordings in a folder, newest first: name, bytes, and seconds where the file says so."""
    files = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime, reverse=True)[:MOST_FILES]
    return [{"name": path.name, "bytes": path.stat().st_size, "seconds": _seconds(path)} for path in files]


def _seconds(path: Path) -> float | None:
    """How long it is; None where it was cut short, or is no recording: it may be replayed all the same."""
    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        found = summary.statistics if summary is not None else None
        return None if found is None else (found.message_end_time - found.message_start_time) * 1e-9
    except Exception as why:  # whatever is in the file
        log.debug("%s: %s", path, why)
        return None


class Replay:
    """One recording being replayed. Raises ReplayRefused where it cannot be."""

    def __init__(self, folder: Path, name: str, speed: object, start_s: object) -> None:
        if name not in {path.name for path in folder.glob("*.mcap")}:
            raise ReplayRefused(f"there is no recording {name[:80]!r} in {folder}")
        numbers = [value for value in (speed, start_s) if isinstance(value, (int, float)) and math.isfinite(value)]
        if len(numbers) < 2 or not 0.05 <= numbers[0] <= 50 or numbers[1] < 0:
            raise ReplayRefused(f"speed {speed!r:.20} from {start_s!r:.20} s: expected 0.05 to 50, from 0 on")
        self.runtime = Path(tempfile.mkdtemp(prefix="eitpage-", dir="/tmp"))  # short: its sockets' paths are bounded
        command = [sys.executable, str(SKIN), "replay", str(folder / name)]
        command += ["--speed", str(numbers[0]), "--from", str(numbers[1])]
        environment = {key: value for key, value in os.environ.items() if key != "EITSKIN_BRIDGE"}
        environment["EITSKIN_RUNTIME"] = str(self.runtime)
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment)
        self._lock = threading.Lock()

    def state(self) -> dict[str, Any]:
        """Whether it still plays, and whether it has failed."""
        code = self._process.poll()
        return {"playing": code is None, "failed": code not in (None, 0, INCOMPLETE)}

    def close(self) -> None:
        """End it; its stages end with it."""
        with self._lock:
            if self._process.poll() is None:
                self._process.terminate()
                try:
                    self._process.wait(STOP_S)
                except subprocess.TimeoutExpired:
                    self._process.kill()
                    self._process.wait()
            shutil.rmtree(self.runtime, ignore_errors=True)
