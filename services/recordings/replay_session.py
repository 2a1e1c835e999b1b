"""`skin replay`: finds stages to feed, or brings up its own, and reports what came out."""

from __future__ import annotations

import contextlib
import ctypes
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
from services.recordings import settings
from services.recordings.recording import RecordingReader, RecordingWriter
from services.recordings.replay import Replayer, ReplayError, skins_in, steps
from services.runtime.config import ROOT, ConfigError, Skin, config_path, load
from services.runtime.stage import STAGES

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
    bundle: Path | None = None,
) -> dict[str, Any]:
    """Replays `file`; the report's keys: frames, contacts, valid, touched, seconds, warnings, whole and damage of
    `file`, and how many contact frames could not be written to `out`.

    bundle: to use instead of the one that the recording names by its hash.

    Raises RecordingError, ConfigError, BundleError, ReplayError.
    """
    reader = RecordingReader(file)
    skins = skins_in(reader)
    if not skins:
        damage = "" if reader.damage.whole else f"; it is damaged ({reader.damage})"
        raise ReplayError(f"{file} holds no raw frames: nothing to replay{damage}")
    if skin and skin not in skins:
        raise ReplayError(f"{file} holds no skin {skin!r}, only {', '.join(skins)}")
    wanted = {skin: skins[skin]} if skin else skins
    with contextlib.ExitStack() as cleanup:
        if private:
            cleanup.enter_context(private_runtime())
        warnings = cleanup.enter_context(_stages(list(wanted), reader, bundle))
        writer = cleanup.enter_context(RecordingWriter(out, {"origin": "replay", "of": file.name})) if out else None
        replayer = Replayer(list(wanted), speed, writer)
        cleanup.callback(replayer.close)
        began = time.monotonic()
        for _ in progress(replayer.run(steps(reader, start_s, skin)), sum(wanted.values())):
            if writer is not None:
                writer.flush_if_due()
        seconds = time.monotonic() - began
    counts: dict[str, Any] = {key: replayer.counts[key] for key in ("frames", "contacts", "valid", "touched")}
    counts |= {"seconds": seconds, "whole": reader.damage.whole, "damage": str(reader.damage)}
    counts |= {"unwritten": writer.lost if writer else 0, "why": writer.why if writer else ""}
    return counts | {"warnings": [*warnings, *replayer.warnings]}


@contextlib.contextmanager
def private_runtime() -> Iterator[None]:
    """A runtime folder of one run's own: what is kept there is nobody else's."""
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
def _stages(skins: list[str], reader: RecordingReader, bundle: Path | None) -> Iterator[list[str]]:
    """Stages that run here already, else ones of our own for as long as it takes; gives what is to be warned of.

    Who holds the folder's locks decides, and not who answers: a process that stands still has its sockets all the same.
    """
    with contextlib.ExitStack() as cleanup:
        try:
            cleanup.enter_context(lock(process="acquisition"))
        except AlreadyRunning as busy:
            raise ReplayError(
                f"a board feeds the service in {busy.folder} (acquisition, process {busy.pid}): "
                "use `skin replay --private`, or start it with `skin up --no-board`"
            ) from None
        try:
            cleanup.enter_context(lock())
        except AlreadyRunning as busy:
            if bundle is not None:
                raise ReplayError(
                    f"--bundle is for stages that replay starts itself, but those of the service in {busy.folder} "
                    "(`skin up --no-board`) run already: give their skin.toml that bundle, or use --private"
                ) from None
            yield []
            return
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="replay-", dir=runtime_dir())))
        file, warnings = configuration_of(skins, reader, bundle, folder)
        environment = os.environ | {"EITSKIN_CONFIG": str(file)}
        for name in STAGES:
            cleanup.callback(stop, _start(name, environment))
        yield warnings


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


def configuration_of(
    skins: list[str], reader: RecordingReader, bundle: Path | None, folder: Path
) -> tuple[Path, list[str]]:
    """A file in `folder` that configures all `skins`, and what is to be warned of: each as the recording says, else as
    the configuration in force does. Addresses, keys and paths are never the recording's.
    """
    recorded = settings.read(reader.metadata.get(settings.KEY, ""), reader.path)
    config, unusable = None, ""
    try:
        config = load()
    except ConfigError as why:
        unusable = f" ({str(why).splitlines()[0]})"
    known = settings.Known.here(config, bundle)
    said = {name: skin for name, skin in recorded.skins.items() if name in skins}
    content = settings.configuration(recorded.model_copy(update={"skins": said}), known, folder)
    for name in skins:
        if name in said:
            continue
        if config is not None and name in config.skins:
            content["skins"][name] = _of_ours(config.skins[name])
        elif bundle is None:
            raise ReplayError(
                f"the recording does not say how skin {name} is configured, nor does {config_path()}{unusable}: "
                "add it there, or name its bundle with --bundle PATH"
            )
        if known.given is not None:
            content["skins"].setdefault(name, {"port": "stub"})["bundle"] = str(known.given.path.resolve())
    file = folder / "skin.toml"
    file.write_text(settings.toml(content), encoding="utf-8")
    load(file)
    return file, [text for name, skin in said.items() if (text := known.differs(name, skin))]


def _of_ours(skin: Skin) -> dict[str, Any]:
    """A skin of the configuration in force, its paths whole."""
    said = skin.model_dump(mode="json") | {"port": "stub"}
    if "/" in skin.bundle:
        said["bundle"] = str(Path(skin.bundle).resolve())
    if skin.calibration is not None:
        said["calibration"] = str(skin.calibration.resolve())
    return said
