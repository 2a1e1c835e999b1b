"""The recorder as a process: `python -m services.recorder FILE`, or `--folder FOLDER`, which records at once, or with
`--wait` only when told to. Its commands: `record`, `snapshot`, `status`.

It keeps the last seconds in memory, for snapshots ([recorder] of skin.toml says how many).
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

from protocol import logs, transport
from protocol.errors import INCOMPLETE
from protocol.metering import StatusBeat
from protocol.runtime import AlreadyRunning, RuntimeDirError, lock, runtime_dir
from protocol.sockets import ControlServer, Publisher
from protocol.topics import RECORDER
from protocol.transport import TransportError
from services.recordings.recorder import DEFAULT_TOPICS, Recorder
from services.recordings.recording import RecordingError
from services.recordings.rotation import PRIVATE, Rotation
from services.recordings.snapshots import LONGEST_S, Keeping, file_in
from services.runtime.config import ConfigError, ConfigFile, load
from services.runtime.config_sections import RecorderSection

COMMANDS_AT_ONCE = 5  # answered between two turns of recording
STATUS_S = 1.0
MINUTE_S, MB = 60.0, 1e6

log = logging.getLogger("recorder")


class RecorderService:
    """A recorder with its commands and its heartbeat. `turn` often."""

    def __init__(self, recorder: Recorder, folder: Path, skins: list[str]) -> None:
        self.recorder, self.folder = recorder, folder
        commands = {"status": lambda _: self.status(), "record": self._record, "snapshot": self._snapshot}
        self.control = ControlServer(RECORDER, commands)
        self.publisher = Publisher(RECORDER)
        self._beats = {skin: StatusBeat(RECORDER, skin) for skin in skins}

    def turn(self) -> None:
        """Record for a moment, answer commands, say how it goes."""
        self.recorder.step()
        self.control.mind()
        for _ in range(COMMANDS_AT_ONCE):
            if not self.control.serve_once():
                break
        self.publisher.mind()
        self.publisher.poll()
        self._say()

    def _record(self, args: dict[str, Any]) -> dict[str, Any]:
        if args["on"]:
            self.folder.mkdir(PRIVATE, parents=True, exist_ok=True)
            self.recorder.record(file_in(self.folder), named_by_time=True)
            with contextlib.suppress(OSError):  # a crash ends it then
                _wanted().write_text(str(os.getppid()))
            return self.status()
        self.recorder.look(now=True)
        before = self.status()
        with contextlib.suppress(OSError):
            _wanted().unlink(missing_ok=True)
        self.recorder.stop()
        return {**self.status(), "file": before["file"]}

    def _snapshot(self, args: dict[str, Any]) -> dict[str, Any]:
        snapshots = self.recorder.snapshots
        if snapshots is None:
            raise RecordingError("this recorder keeps nothing for snapshots: start it with --folder")
        most = {"before_s": snapshots.keeping.before_s, "after_s": LONGEST_S}
        wanted: dict[str, float] = {}
        for name, limit in most.items():
            if name not in args:
                continue
            if not 0 <= args[name] <= limit:
                hint = ": before_s in [recorder] of skin.toml says how much is kept" if name == "before_s" else ""
                raise RecordingError(f"found {name} {args[name]!r:.40}, expected 0 to {limit:g} s{hint}")
            wanted[name] = args[name]
        why = (args.get("why") or "by command")[:200]
        path = snapshots.take("snapshot", why, self.recorder.now_ns(), **wanted)
        return {"file": str(path), "after_s": wanted.get("after_s", snapshots.keeping.after_s)}

    def status(self) -> dict[str, Any]:
        """`level` and `problems` as in status frames; `lost`: messages that are in no file."""
        recorder, snapshots = self.recorder, self.recorder.snapshots
        writer = recorder.writer
        problems = [recorder.problem] if recorder.problem else []
        problems += self.control.problems + self.publisher.problems
        stuck = writer is not None and (writer.full or writer.nowhere)
        found: dict[str, Any] = {
            "recording": writer is not None,
            "folder": str(self.folder),
            "file": str(writer.path) if writer is not None and not writer.nowhere else "",
            "messages": {f"{topic}/{skin}": n for (topic, skin), n in recorder.received.items()},
            "gaps": recorder.gaps,
            "lost": recorder.lost + (snapshots.lost if snapshots else 0),
            "files": writer.files if writer is not None else 0,
            "deleted": (writer.deleted if writer is not None else 0) + (snapshots.deleted if snapshots else 0),
            "level": "ERROR" if stuck else "WARN" if problems else "OK",
            "problems": problems,
        }
        if snapshots is not None:
            found |= {
                "held_s": snapshots.ring.held_s,
                "held_bytes": snapshots.ring.bytes,
                "forgotten": snapshots.ring.forgotten,
                "snapshots": snapshots.taken,
                "missed": snapshots.missed,
                "writing": snapshots.writing,
                "snapshot": snapshots.last,
            }
        return found

    def _say(self) -> None:
        now, status = time.monotonic(), self.status()
        counters = {name: int(status[name]) for name in COUNTED if name in status}
        doing = f"recording to {status['file'] or 'nowhere'}" if status["recording"] else "not recording"
        if status.get("writing"):
            doing += f"; a snapshot is being written: {status['snapshot']}"
        for skin, beat in self._beats.items():
            beat.meter.sent.update(
                {t: n - beat.meter.sent[t] for (t, s), n in self.recorder.received.items() if s == skin}
            )
            drops = {"gaps": status["gaps"], "lost": status["lost"], "forgotten": status.get("forgotten", 0)}
            frame = beat.frame(status["level"], [doing, *status["problems"]], now, STATUS_S, drops, counters)
            if frame is not None:
                self.publisher.send(frame)

    def close(self) -> None:
        self.control.close()
        self.publisher.close()


COUNTED = ("recording", "files", "deleted", "snapshots", "missed", "writing", "held_s", "held_bytes")
"""What status frames say in numbers."""


def _wanted() -> Path:
    """A file that is there while a recording is wanted: after a crash the next recorder goes on in a new file. It names
    our parent: under another supervisor it means nothing.
    """
    return runtime_dir() / "recorder.wanted"


def _crashed() -> bool:
    """Whether the recorder before us was recording when it ended."""
    try:
        return _wanted().read_text() == str(os.getppid())
    except (OSError, ValueError):
        return False


def rotation_of(section: RecorderSection) -> Rotation:
    """When the next file of a recording begins."""
    return Rotation(int(section.file_mb * MB), section.file_minutes * MINUTE_S, section.keep_files)


def keeping_of(section: RecorderSection, folder: Path) -> Keeping:
    """What is kept for snapshots."""
    memory = int(section.memory_mb * MB)
    return Keeping(folder, section.before_s, section.after_s, memory, section.triggers, section.keep_snapshots)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="services.recorder", description="Records a running service.")
    parser.add_argument("file", nargs="?", type=Path)
    parser.add_argument("--folder", type=Path, help="write new files, named by the time, in this folder")
    parser.add_argument(
        "--wait", action="store_true", help="record only when told to; snapshots are taken all the same"
    )
    parser.add_argument("--skin", help="only this skin")
    parser.add_argument("--topics", default=",".join(DEFAULT_TOPICS))
    args = parser.parse_args(argv)
    if (args.file is None) == (args.folder is None):
        parser.error("name either a file or --folder")
    logs.setup("%(asctime)s %(name)s %(levelname)s %(message)s")
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    try:
        config = load()
        transport.configure(config.transport())
        with lock(process=RECORDER):
            return _run(args, config, stop)
    except (AlreadyRunning, ConfigError, RecordingError, RuntimeDirError, TransportError) as error:
        log.error("%s", error)
    except OSError as error:
        log.error("%s: %s", error.filename or args.folder, error.strerror or error)
    return 2


def _run(args: argparse.Namespace, config: ConfigFile, stop: threading.Event) -> int:
    section = config.recorder or RecorderSection()
    folder = (args.folder or args.file.parent).absolute()
    if not args.wait:
        folder.mkdir(PRIVATE, parents=True, exist_ok=True)
    keeping = keeping_of(section, folder) if args.folder is not None else None
    path = None if args.wait and not _crashed() else args.file or file_in(folder)
    with Recorder(None, args.topics.split(","), args.skin, rotation=rotation_of(section), keeping=keeping) as recorder:
        if path is not None:
            recorder.record(path, named_by_time=args.folder is not None)
            log.info("recording to %s", path)
        process = RecorderService(recorder, folder, [args.skin] if args.skin else list(config.skins))
        try:
            _record_until(stop, process)
        finally:
            process.close()
    counts = recorder.writer.counts if recorder.writer is not None else {}
    log.info("recorded %s", ", ".join(f"{topic} {n}" for topic, n in counts.items()) or "nothing")
    if recorder.writer is not None and recorder.writer.problems:
        log.error("%s", recorder.problem)
        return INCOMPLETE
    return 0


def _record_until(stop: threading.Event, process: RecorderService) -> None:
    recorder, full = process.recorder, False
    while not stop.is_set():
        process.turn()
        if bool(recorder.problem) != full:
            full = not full
            log.log(logging.ERROR if full else logging.INFO, "%s", recorder.problem or "recording goes on")
    with contextlib.suppress(OSError):
        _wanted().unlink(missing_ok=True)  # nobody wants it after an ordered end


if __name__ == "__main__":
    sys.exit(main())
