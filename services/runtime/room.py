"""Whether the system gives the service what it needs: descriptors, processes, memory, room in the runtime folder.

What is needed was measured beside two skins with all bridges and the recorder (`ls /proc/PID/fd`, VmPeak, threads), and
doubled where clients and calibrations come on top. Imports nothing that needs much memory.
"""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Iterator
from pathlib import Path

from protocol.errors import EitskinError

MB = 1 << 20
DESCRIPTORS, DESCRIPTORS_EACH = 96, 16  # of one process; for each skin: 35 were in use with two skins
THREADS = 8  # of one process: 6 were seen
COMMAND_MB = 500  # address space of a command: 350 MB were seen
SERVICE_MB, SERVICE_MB_EACH = 900, 200  # of one process; for each skin: 715 MB were seen with two skins
RUNTIME_BYTES = 2 * MB  # kept states, sockets' names


class NoRoom(EitskinError):
    """The system allows too little; says of what, how much was found and needed, and what to do."""


def lacking(processes: int, skins: int, folder: Path) -> Iterator[str]:
    """What a service of so many processes and skins lacks here, in its runtime folder. Raises the limit of descriptors
    where that is allowed.
    """
    yield from _descriptors(DESCRIPTORS + DESCRIPTORS_EACH * skins)
    yield from memory(SERVICE_MB + SERVICE_MB_EACH * skins)
    yield from _processes(processes * THREADS)
    disk = os.statvfs(folder)
    if (free := disk.f_bavail * disk.f_frsize) < RUNTIME_BYTES:
        yield (
            f"the disk of the runtime folder {folder} has {free} bytes free, needed {RUNTIME_BYTES}: make room, or set "
            "EITSKIN_RUNTIME to another folder"
        )


def check(processes: int, skins: int, folder: Path) -> None:
    """Raises NoRoom where something is lacking."""
    if found := "\n".join(lacking(processes, skins, folder)):
        raise NoRoom(found)


def memory(needed_mb: int = COMMAND_MB) -> Iterator[str]:
    """Whether the address space of a process is limited to less."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < needed_mb * MB:
        yield (
            f"found a limit of {limit // MB} MB of memory, needed {needed_mb} MB: raise it with "
            f"`ulimit -v {needed_mb * 1024}`"
        )


def _descriptors(needed: int) -> Iterator[str]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < needed and (hard == resource.RLIM_INFINITY or hard >= needed):
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    elif soft != resource.RLIM_INFINITY and soft < needed:
        yield f"found a limit of {hard} open files, needed {needed}: raise it with `ulimit -n {needed}`"


def _processes(needed: int) -> Iterator[str]:
    """Threads count as processes, all of this user's together; nobody limits root's."""
    limit, uid = resource.getrlimit(resource.RLIMIT_NPROC)[0], os.getuid()
    if limit == resource.RLIM_INFINITY or uid == 0:
        return
    used = 0
    for found in Path("/proc").glob("[0-9]*"):
        try:
            used += len(os.listdir(found / "task")) if found.stat().st_uid == uid else 0
        except OSError:  # it has ended
            continue
    if used + needed > limit:
        yield (
            f"found a limit of {limit} processes and threads, of which {used} run, needed {needed} more: raise it with "
            f"`ulimit -u {used + needed}`"
        )


ELSEWHERE = "name another place"
LACKS = {
    errno.EMFILE: "too many open files: raise the limit with `ulimit -n`",
    errno.ENFILE: "the system has too many open files: end other programs",
    errno.ENOMEM: "not enough memory: end other programs, or raise the limit with `ulimit -v`",
    errno.EAGAIN: "no more processes or threads are allowed: end others, or raise the limit with `ulimit -u`",
    errno.ENOSPC: f"no room on the disk: free some, or {ELSEWHERE}",
    errno.EDQUOT: f"the quota of the disk is used up: free some, or {ELSEWHERE}",
    errno.EROFS: f"the disk cannot be written to: {ELSEWHERE}",
}


def sentence(error: BaseException) -> str:
    """What the system lacked, and what to do, where that is what an error says; else ""."""
    code = getattr(error, "errno", None)
    if isinstance(error, MemoryError):
        code = errno.ENOMEM
    elif isinstance(error, RuntimeError) and "start new thread" in str(error):
        code = errno.EAGAIN
    if code not in LACKS or (code == errno.EAGAIN and not isinstance(error, RuntimeError | BlockingIOError)):
        return ""
    where = getattr(error, "filename", None)
    return f"{where}: {LACKS[code]}" if where else LACKS[code]
