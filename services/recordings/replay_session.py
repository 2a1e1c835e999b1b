"""`skin replay`: finds stages to feed, or brings up its own, and reports what came out."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from protocol.frames import ContactFrame
from protocol.runtime import AlreadyRunning, lock, runtime_dir
from protocol.sockets import ControlClient, ControlError
from services.config import ROOT, ConfigError, config_path, load
from services.recordings.recording import RecordingReader, RecordingWriter
from services.recordings.replay import Replayer, ReplayError, skins_in, steps
from services.stage import STAGES

PR_SET_PDEATHSIG = 1
STOP_S = 2.0

Progress = Callable[[Iterator[ContactFrame], int], Iterator[ContactFrame]]


def replay_file(
    file: Path,
    speed: float | None = 1.0,
    start_s: float = 0.0,
    skin: str = "",
    out: Path | None = None,
    private: bool = False,
    progress: Progress = lambda contacts, total: contacts,
) -> dict[str, Any]:
    """Replays `file`; the report's keys: frames, contacts, valid, touched, seconds, damage, warnings.

    Raises RecordingError, ConfigError, ReplayError.
    """
    reader = RecordingReader(file)
    skins = skins_in(reader)
    if not skins:
        damage = "" if str(reader.damage) == "whole" else f"; it is damaged ({reader.damage})"
        raise ReplayError(f"{file} holds no raw frames: nothing to replay{damage}")
    if skin and skin not in skins:
        raise ReplayError(f"{file} holds no skin {skin!r}, only {', '.join(skins)}")
    wanted = {skin: skins[skin]} if skin else skins
    with contextlib.ExitStack() as cleanup:
        if private:
            cleanup.enter_context(_private_runtime())
        cleanup.enter_context(_stages(list(wanted), reader))
        writer = cleanup.enter_context(RecordingWriter(out, {"origin": "replay", "of": file.name})) if out else None
        replayer = Replayer(list(wanted), speed, writer)
        cleanup.callback(replayer.close)
        began = time.monotonic()
        for _ in progress(replayer.run(steps(reader, start_s, skin)), sum(wanted.values())):
            if writer is not None:
                writer.flush_if_due()
        seconds = time.monotonic() - began
    counts = {key: replayer.counts[key] for key in ("frames", "contacts", "valid", "touched")}
    return counts | {"seconds": seconds, "damage": str(reader.damage), "warnings": replayer.warnings}


@contextlib.contextmanager
def _private_runtime() -> Iterator[None]:
    before = os.environ.get("EITSKIN_RUNTIME")
    with tempfile.TemporaryDirectory(prefix="eitskin-", dir="/tmp") as folder:
        os.environ["EITSKIN_RUNTIME"] = folder
        try:
            yield
        finally:
            if before is None:
                del os.environ["EITSKIN_RUNTIME"]
            else:
                os.environ["EITSKIN_RUNTIME"] = before


@contextlib.contextmanager
def _stages(skins: list[str], reader: RecordingReader) -> Iterator[None]:
    """Stages that run here already, else ones of our own for as long as it takes."""
    with contextlib.ExitStack() as cleanup:
        try:
            cleanup.enter_context(lock())
        except AlreadyRunning as busy:
            _refuse_a_board(busy)
            yield
            return
        environment = os.environ | {"EITSKIN_CONFIG": str(_configuration(skins, reader))}
        for name in STAGES:
            cleanup.callback(stop, _start(name, environment))
        yield


def _refuse_a_board(busy: AlreadyRunning) -> None:
    try:
        ControlClient("acquisition", 0.5).call("clock")
    except ControlError:
        return
    raise ReplayError(
        f"a board feeds the service in {busy.folder}: "
        "use `skin replay --private`, or start it with `skin up --no-board`"
    )


def _start(name: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    libc = ctypes.CDLL(None)
    return subprocess.Popen(
        [sys.executable, "-m", f"services.{name}"],
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        start_new_session=True,  # a Ctrl-C is ours: we stop them in order
        preexec_fn=lambda: libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL),
    )


def stop(process: subprocess.Popen[Any]) -> None:
    """Ask it to end; where it does not, end it."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _configuration(skins: list[str], reader: RecordingReader) -> Path:
    """A file that configures all `skins`: the one in force, else the recorded one, else one that names their bundle."""
    missing = skins
    with contextlib.suppress(ConfigError):
        missing = [name for name in skins if name not in load().skins]
    if not missing:
        return config_path()
    recorded = runtime_dir() / "replay.toml"
    text = reader.metadata.get("configuration", "")
    if text:
        recorded.write_text(text, encoding="utf-8")
        if all(name in load(recorded).skins for name in skins):
            return recorded
    bundle = reader.metadata.get("bundle", "")
    if not bundle:
        raise ReplayError(
            f"the recording is of skin {', '.join(missing)}, which {config_path()} does not configure: add it"
        )
    lines = [f'[skins.{name}]\nport = "stub"\nbundle = {json.dumps(bundle)}\n' for name in skins]
    recorded.write_text("\n".join(lines), encoding="utf-8")
    load(recorded)
    return recorded
