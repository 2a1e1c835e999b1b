"""The runtime folder of one running service: its place, its owner, its sockets, and the lock against a second service.

`$EITSKIN_RUNTIME`, else `$XDG_RUNTIME_DIR/eitskin`, else `/tmp/eitskin-<uid>`; mode 0700, so that reaching a socket
needs the owner's rights.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import stat
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from .errors import EitskinError

CONFIG_LINK = "config"
"""Name of the link, in the runtime folder, to the configuration of the service that runs there."""
MAX_SOCKET_PATH = 107
"""Longest path of a Unix socket on Linux, in bytes (sun_path less its final 0)."""


class RuntimeDirError(EitskinError, RuntimeError):
    """The runtime folder cannot be used: not ours, open to others, a link, not a folder, or its path too long."""


class AlreadyRunning(EitskinError, RuntimeError):
    """Another service holds the runtime folder, or another process of this name runs there (`process`, else "");
    `pid` is its number, 0 where that is not known.
    """

    def __init__(self, folder: Path, pid: int, process: str = "") -> None:
        super().__init__(folder, pid, process)
        self.folder, self.pid, self.process = folder, pid, process

    def __str__(self) -> str:
        who = f" by process {self.pid}" if self.pid else ""
        what = f"{self.folder} has its {self.process} already, held" if self.process else f"{self.folder} is in use"
        return f"{what}{who}: stop that service first, or give this one its own EITSKIN_RUNTIME"


def runtime_dir(create: bool = True) -> Path:
    """The runtime folder, made if need be. Raises RuntimeDirError where it is not a folder that only we can enter."""
    named = os.environ.get("EITSKIN_RUNTIME")
    if named:
        path = Path(named).absolute()
    elif os.environ.get("XDG_RUNTIME_DIR"):
        path = Path(os.environ["XDG_RUNTIME_DIR"], "eitskin").absolute()
    else:
        path = Path(f"/tmp/eitskin-{os.geteuid()}")
    try:
        if create and not os.path.lexists(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as bad:
        raise RuntimeDirError(
            f"runtime folder {path}: {bad.strerror}; set EITSKIN_RUNTIME to a folder of your own"
        ) from None
    if stat.S_ISLNK(found.st_mode):
        raise RuntimeDirError(
            f"runtime folder {path} is a symbolic link, which others could redirect: name its target instead"
        )
    if not stat.S_ISDIR(found.st_mode):
        raise RuntimeDirError(f"runtime folder {path} is not a folder: set EITSKIN_RUNTIME to another path")
    if found.st_uid != os.geteuid():
        raise RuntimeDirError(
            f"runtime folder {path} belongs to user {found.st_uid}, expected {os.geteuid()} (you): "
            "set EITSKIN_RUNTIME to your own"
        )
    if found.st_mode & 0o077:
        raise RuntimeDirError(
            f"runtime folder {path} has mode {stat.S_IMODE(found.st_mode):04o}, expected 0700: chmod 700 {path}"
        )
    return path


def endpoint(producer: str) -> str:
    """Address of a producer's data socket in the runtime folder: ipc://<runtime>/<producer>.ipc."""
    return _ipc(f"{producer}.ipc")


def control_endpoint(process: str) -> str:
    """Address of a process's control socket in the runtime folder: ipc://<runtime>/<process>.ctl."""
    return _ipc(f"{process}.ctl")


def _ipc(name: str) -> str:
    path = runtime_dir() / name
    if len(os.fsencode(path)) > MAX_SOCKET_PATH:
        raise RuntimeDirError(
            f"{path} has {len(os.fsencode(path))} bytes, a socket's path at most {MAX_SOCKET_PATH}: "
            "set EITSKIN_RUNTIME to a shorter one"
        )
    return f"ipc://{path}"


@contextlib.contextmanager
def lock(folder: Path | None = None, process: str = "") -> Iterator[Path]:
    """Hold the runtime folder for one service, or for one process of it by its name (`acquisition`); the kernel lets go
    of it however the process ends, and of a stopped one it keeps it. Raises AlreadyRunning.

    Without it a second service would take over the first one's sockets without either of them noticing.
    """
    folder = folder or runtime_dir()
    name = f"{process}.lock" if process else "lock"
    try:
        fd = os.open(folder / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as bad:
        raise RuntimeDirError(
            f"runtime folder {folder} cannot be written to ({bad.strerror}): set EITSKIN_RUNTIME to another one"
        ) from None
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.pread(fd, 16, 0).strip()
            raise AlreadyRunning(folder, int(pid) if pid.isdigit() else 0, process) from None
        os.ftruncate(fd, 0)
        os.pwrite(fd, b"%d\n" % os.getpid(), 0)
        yield folder
    finally:
        os.close(fd)


@cache
def host_id() -> str:
    """The name of this host's monotonic clock: the boot id, equal in all containers of a host and new after each
    boot.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
    except OSError:
        return socket.gethostname()[:64]
