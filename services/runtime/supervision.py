"""Process supervision of `skin up`: supervisord as a library, in the foreground, quick.

Four things differ from supervisord as it comes: it looks at its children every POLL_S instead of every second and
restarts one in the same round in which it was reaped; a process that keeps failing is retried for ever, at growing
intervals, instead of being given up; no setting of the system's clock delays a restart or cuts a stop short; children
write to our own stdout (one log stream, no copying) and die with us,
whatever kills us.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import supervisor.process
import supervisor.supervisord
from supervisor.medusa import asyncore_25 as asyncore
from supervisor.options import ServerOptions
from supervisor.process import Subprocess
from supervisor.states import ProcessStates
from supervisor.supervisord import Supervisor

from protocol.part_size import BAUD
from protocol.runtime import CONFIG_LINK, lock, runtime_dir
from protocol.topics import RECORDER
from services.runtime import room
from services.runtime.config import BUNDLES, MANIFEST, ROOT, ConfigFile
from services.runtime.stage import PROCESSES

POLL_S = 0.05
HEALTHY_S = 3  # a process that lived this long starts its next restarts from the shortest delay
FIRST_RETRY_S, LONGEST_RETRY_S = 0.1, 5.0
STOP_S = 1  # from SIGTERM to SIGKILL
PR_SET_PDEATHSIG = 1


class _Monotonic:
    """What supervisor takes for the module `time`: it counts restart and stop delays by it."""

    time = staticmethod(time.monotonic)


supervisor.process.time = supervisor.supervisord.time = _Monotonic


@dataclass(frozen=True)
class Program:
    """A process to keep alive: `python -m module arguments`."""

    name: str
    module: str
    arguments: tuple[str, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)


def programs(config: ConfigFile, record: Path | None = None) -> list[Program]:
    """What a configuration needs: the stages, its bridges, its recorder, and the stub where a skin's port is "stub".
    record: to this folder, from the start.
    """
    found = [Program(name, f"services.{name}") for name in PROCESSES]
    found += [Program(name, "services.bridge", (name,)) for name in config.bridges]
    if record is not None:
        found.append(Program(RECORDER, "services.recorder", ("--folder", str(record.resolve()))))
    elif config.recorder is not None:
        folder = config.relative(Path(config.recorder.folder))
        found.append(Program(RECORDER, "services.recorder", ("--wait", "--folder", str(folder))))
    if on_stub := stub_arguments(config):
        found.insert(0, Program("stub", "firmware_stub", on_stub))
    return found


def stub_arguments(config: ConfigFile) -> tuple[str, ...]:
    """What `python -m firmware_stub` is told: a board for each skin whose port is "stub", with that skin's bundle and
    the names of the mismatch between its sheet and the bundle and of its world, and its line's rate.
    """
    skins = [(name, skin) for name, skin in config.skins.items() if skin.port == "stub"]
    said = [part for name, skin in skins for part in ("--skin", f"{name}={_folder(skin.bundle)}")]
    for name, skin in skins:
        said += ["--mismatch", f"{name}={skin.mismatch}"] if skin.mismatch != "none" else []
        said += ["--world", f"{name}={skin.world}"] if skin.world else []
        said += ["--baud", f"{name}={skin.baud}"] if skin.baud != BAUD else []
    return tuple(said)


def _folder(bundle: str) -> Path:
    """A bundle's folder; the stub runs in the checkout, wherever `skin up` was called."""
    return Path(bundle).resolve() if (Path(bundle) / MANIFEST).is_file() else BUNDLES / bundle


def up(config: ConfigFile, extra: Sequence[Program] = (), wanted: Sequence[Program] | None = None) -> int:
    """Run the service in the foreground until SIGINT or SIGTERM; returns the exit status.

    Raises protocol.runtime.AlreadyRunning where another `skin up` holds the runtime folder.
    """
    runtime = runtime_dir()
    with lock():
        running = list(programs(config) if wanted is None else wanted) + list(extra)
        _link(runtime / CONFIG_LINK, config.path.resolve())
        file = runtime / "supervisord.conf"
        file.write_text(_settings(running), encoding="utf-8")
        options = ServerOptions()
        options.first, options.test = True, False
        options.realize(["-c", str(file), "-n"])
        _complete(options, runtime, config, running)
        ctypes.CDLL(None)  # loaded before any fork
        try:
            _Service(options).main()
        except asyncore.ExitNow:
            pass
        finally:
            options.close_logger()
            _clear(runtime, running)
    return 0


def _clear(runtime: Path, ran: Sequence[Program]) -> None:
    """Remove what we and the programs that ran left in the runtime folder. `lock` and `state` stay, and so do sockets
    of others (`skin record`, `skin replay`).
    """
    left = [runtime / "supervisord.conf", runtime / "supervisord.pid", runtime / CONFIG_LINK]
    left += [runtime / f"{program.name}{suffix}" for program in ran for suffix in (".ipc", ".ctl")]
    if any(program.name == "stub" for program in ran):
        left += [path for path in runtime.glob("board*") if path.is_symlink()]
    for path in left:
        with contextlib.suppress(OSError):  # not there, mostly
            path.unlink()


def _link(link: Path, target: Path) -> None:
    """Tell whoever comes to this folder which configuration runs here."""
    link.unlink(missing_ok=True)
    link.symlink_to(target)


class _Service(Supervisor):  # type: ignore[misc]
    def __init__(self, options: Any) -> None:
        super().__init__(options)
        poll = options.poller.poll
        options.poller.poll = lambda timeout: poll(min(timeout, POLL_S))

    def add_process_group(self, config: Any) -> bool:
        added = bool(super().add_process_group(config))
        group = self.process_groups[config.name]
        for name, process in group.processes.items():
            group.processes[name] = _Stage(process.config)
            group.processes[name].group = group
        return added

    def reap(self, once: bool = False, recursionguard: int = 0) -> None:
        super().reap(once, recursionguard)
        if recursionguard == 0:
            for group in self.process_groups.values():
                group.transition()


class _Stage(Subprocess):  # type: ignore[misc]
    def change_state(self, new_state: int, expected: bool = True) -> Any:
        changed = super().change_state(new_state, expected)
        if new_state == ProcessStates.BACKOFF:
            self.delay = time.monotonic() + min(FIRST_RETRY_S * 2 ** (self.backoff - 1), LONGEST_RETRY_S)
        return changed

    def record_spawnerr(self, msg: str) -> None:
        """Says why it could not be started, at every try, where supervisord keeps it to itself."""
        self.spawnerr = msg
        lacking = f": {room.LACKS[errno.EAGAIN]}" if "process table" in msg else ""
        self.config.options.logger.warn(f"{self.config.name} cannot be started ({msg}){lacking}")

    def _prepare_child_fds(self) -> None:
        """Our own stdout and stderr stay as they are; everything above is closed."""
        os.dup2(self.pipes["child_stdin"], 0)
        os.closerange(3, 256)

    def _spawn_as_child(self, filename: str, argv: list[str]) -> None:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        super()._spawn_as_child(filename, argv)


def _settings(running: Sequence[Program]) -> str:
    """supervisord's configuration file. No path stands in it: its syntax does not know all of them, see `_complete`."""
    lines = [
        "[supervisord]",
        "nodaemon=true",
        "logfile=/dev/null",
        "logfile_maxbytes=0",
        "loglevel=warn",
        "childlogdir=/",
        "nocleanup=true",
        "minfds=0",  # services/runtime/room.py has looked
        "minprocs=0",
    ]
    if os.getuid() == 0:
        lines.append("user=root")  # says that running as root is meant
    for program in running:
        lines += [
            f"[program:{program.name}]",
            "command=completed",
            f"startsecs={HEALTHY_S}",
            "startretries=1000000000",
            "autorestart=true",
            f"stopwaitsecs={STOP_S}",
            "stopsignal=TERM",
            "stdout_logfile=NONE",
            "redirect_stderr=true",
        ]
    lines += ["[group:eitskin]", "programs=" + ",".join(program.name for program in running)]
    return "\n".join(lines) + "\n"


def _complete(options: Any, runtime: Path, config: ConfigFile, running: Sequence[Program]) -> None:
    """Gives supervisord's options what has a path in it."""
    options.pidfile = str(runtime / "supervisord.pid")
    environment = {
        "EITSKIN_RUNTIME": str(runtime),
        "EITSKIN_CONFIG": str(config.path.resolve()),
        "PYTHONUNBUFFERED": "1",
    }
    by_name = {program.name: program for program in running}
    for process in (each for group in options.process_group_configs for each in group.process_configs):
        program = by_name[process.name]
        process.command = shlex.join([sys.executable, "-m", program.module, *program.arguments])
        process.environment = environment | program.environment
        process.directory = str(ROOT)
