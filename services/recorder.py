"""The recorder: `python -m services.recorder FILE` or `--folder FOLDER`. Only subscribes; nothing waits for it.

Recording does not wake lazy topics unless they are asked for. The recorder asks the stages for their state when the
recording starts and after each new baseline. It stores the answers as `state/<skin>`; a replay begins from there.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import msgpack

from models.bundle import BundleError
from protocol import logs, transport
from protocol.frames import Frame, InfoFrame
from protocol.runtime import host_id
from protocol.sockets import AllReader, ControlClient, ControlError, ControlServer
from protocol.topics import TOPICS
from protocol.transport import TransportError
from services.recordings import settings
from services.recordings.recording import STATE_TOPIC, RecordingError, RecordingWriter
from services.runtime.config import ConfigError, load
from services.runtime.stage import STAGES

DEFAULT_TOPICS = ("raw", "contact", "status", "info")
POLL_S = 0.05
STATE_TIMEOUT_S = 0.5
MOST_SKINS = 64
COMMANDS_AT_ONCE = 5  # answered between two turns of recording

log = logging.getLogger("recorder")


class Recorder:
    """Subscribes and writes. `step` often; not thread-safe."""

    def __init__(
        self, path: Path, topics: Iterable[str] = DEFAULT_TOPICS, skin: str | None = None, overwrite: bool = False
    ) -> None:
        topics = list(topics)
        for name in topics:
            if name not in TOPICS:
                raise RecordingError(f"no topic {name!r}: expected some of {', '.join(TOPICS)}")
        self.path = path
        self.writer = RecordingWriter(path, _metadata(topics, skin), overwrite)
        self.reader = AllReader(topics, skin)
        self.states = _StateReader()
        self._zero_ns = (
            time.time_ns() - time.monotonic_ns()
        )  # a clock that is set meanwhile must not tear the file's times
        self._baselines: dict[str, Any] = {}
        self._skins: set[str] = set()

    def step(self, seconds: float = POLL_S) -> int:
        """Writes what arrives within `seconds`; how many messages that was."""
        end, taken = time.monotonic() + seconds, 0
        while True:
            got = self.reader.recv_message(max(0.0, end - time.monotonic()))
            self._write_states()
            if got is None:
                self.writer.flush_if_due()
                return taken
            frame, message = got
            topic, _, data = message.partition(b"\0")
            self.writer.write(topic.decode(), data, self._now_ns())
            taken += 1
            self._ask_states(frame)

    @property
    def problem(self) -> str:
        """What is wrong with the recording, and what to do; "" while all is well."""
        lost = f"{self.writer.lost} messages are lost so far" if self.writer.lost else "nothing is lost yet"
        if self.writer.full:
            folder = self.path.resolve().parent
            return f"{self.writer.full}: make room in {folder}; {lost}, recording goes on by itself when there is room"
        return f"{lost}: the disk was full" if self.writer.lost else ""

    def _ask_states(self, frame: Frame) -> None:
        """Ask at the first frame of a skin, and after each tare: the state holds how drift is followed from there."""
        if frame.skin not in self._skins and len(self._skins) < MOST_SKINS:
            self._skins.add(frame.skin)
            self.states.ask(frame.skin)
        if isinstance(frame, InfoFrame) and (found := frame.info.get("tare_sample_ns")) is not None:
            if self._baselines.setdefault(frame.skin, found) != found:
                self._baselines[frame.skin] = found
                self.states.ask(frame.skin)

    def _write_states(self) -> None:
        for skin, packed in self.states.answers():
            self.writer.write(f"{STATE_TOPIC}/{skin}", packed, self._now_ns())

    def _now_ns(self) -> int:
        return self._zero_ns + time.monotonic_ns()

    @property
    def gaps(self) -> int:
        """Messages that got lost before they reached us."""
        return self.reader.gaps

    def close(self) -> None:
        self.states.close()
        self._write_states()
        self.reader.close()
        self.writer.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _StateReader:
    """Asks the stages for their state on a thread of its own, so that a silent stage holds up no message."""

    def __init__(self) -> None:
        self._asked: list[str] = []
        self._answers: list[tuple[str, bytes]] = []
        self._lock = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="states", daemon=True)
        self._thread.start()

    def ask(self, skin: str) -> None:
        with self._lock:
            self._asked.append(skin)
            self._lock.notify()

    def answers(self) -> Iterator[tuple[str, bytes]]:
        """(skin, msgpack map process -> state) not yet taken."""
        with self._lock:
            found, self._answers = self._answers, []
        yield from found

    def _run(self) -> None:
        while True:
            with self._lock:
                while not self._asked and not self._closing:
                    self._lock.wait()
                if self._closing:
                    return
                skin = self._asked.pop(0)
            packed: bytes = msgpack.packb(stage_states(skin))
            with self._lock:
                self._answers.append((skin, packed))

    def close(self) -> None:
        with self._lock:
            self._closing = True
            self._lock.notify()
        self._thread.join(len(STAGES) * STATE_TIMEOUT_S + 0.5)


def stage_states(skin: str) -> dict[str, Any]:
    """process -> state, of the stages that answer, as their control command `state` gives it."""
    found: dict[str, Any] = {}
    for process in STAGES:
        try:
            found[process] = ControlClient(process, STATE_TIMEOUT_S).call("state", skin=skin)["state"]
        except (ControlError, KeyError) as error:
            log.warning("the state of %s is not in the recording: %s", process, error)
    return found


def _metadata(topics: list[str], skin: str | None) -> dict[str, str]:
    try:
        config = load()
        wanted = {name: found for name, found in config.skins.items() if skin in (None, name)}
        carried = settings.text_of(wanted, config.skip)
    except (ConfigError, BundleError) as error:
        log.warning("how the skins are configured is not in the recording: %s", error)
        carried = ""
    return {
        "origin": "record",
        "host": host_id(),
        "topics": " ".join(topics),
        "skin": skin or "",
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        settings.KEY: carried,
    }


def file_in(folder: Path) -> Path:
    """A file name that the folder does not have yet: the time, to the second, and a number where needed."""
    stem = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    names = (folder / f"{stem}{suffix}.mcap" for suffix in ("", *(f"-{n}" for n in range(1, 1000))))
    return next(path for path in names if not path.exists())


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="services.recorder", description="Records a running service.")
    parser.add_argument("file", nargs="?", type=Path)
    parser.add_argument("--folder", type=Path, help="write a new file, named by the time, in this folder")
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
        transport.configure(load().transport())
    except (ConfigError, TransportError) as error:
        log.error("%s", error)
        return 2
    try:
        if args.folder is not None:
            args.folder.mkdir(parents=True, exist_ok=True)
        path = args.file or file_in(args.folder)
        recorder = Recorder(path, args.topics.split(","), args.skin)
    except (RecordingError, OSError) as error:
        log.error("%s", error)
        return 2
    try:
        server = ControlServer("recorder", {})
    except TransportError as error:
        recorder.close()
        log.error("%s", error)
        return 2
    server.handlers["status"] = lambda _: _status(recorder, server)
    log.info("recording to %s", path)
    full = False
    try:
        with recorder:
            while not stop.is_set():
                recorder.step()
                server.mind()
                for _ in range(COMMANDS_AT_ONCE):
                    if not server.serve_once():
                        break
                if bool(recorder.writer.full) != full:
                    full = not full
                    log.log(logging.ERROR if full else logging.INFO, "%s", recorder.problem or "recording goes on")
    except OSError as error:  # the disk is broken, or gone
        log.error("cannot go on writing %s: %s", path, error.strerror)
        return 1
    finally:
        server.close()
    log.info("recorded %s", ", ".join(f"{topic} {n}" for topic, n in recorder.writer.counts.items()) or "nothing")
    return 0


def _status(recorder: Recorder, server: ControlServer) -> dict[str, Any]:
    """`level` and `problems` as in status frames; `lost`: messages that there was no room for on the disk."""
    problems = [text for text in (recorder.problem,) if text] + server.problems
    return {
        "file": str(recorder.path),
        "messages": recorder.writer.counts,
        "gaps": recorder.gaps,
        "lost": recorder.writer.lost,
        "level": "ERROR" if recorder.writer.full else "WARN" if problems else "OK",
        "problems": problems,
    }


if __name__ == "__main__":
    sys.exit(main())
