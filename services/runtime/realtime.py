"""What a process asks of the kernel so that it is not kept waiting: a real-time priority, memory that stays in RAM,
its own processors.

Each is off unless skin.toml asks for it. Where the kernel refuses, the service runs without, and its status says so.
"""

from __future__ import annotations

import ctypes
import os
import resource

from services.runtime.config_sections import RealTime

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4  # linux/mman.h
CAP_IPC_LOCK = 14  # linux/capability.h


def apply(wanted: RealTime, process: str) -> list[str]:
    """Asks for what is wanted; returns what could not be had and why, for a person. To be called before threads begin:
    they inherit priority and processors.
    """
    refused = []
    if cpus := wanted.cpus.get(process):
        text = "some of them are not there"
        try:
            os.sched_setaffinity(0, cpus)
        except (OSError, ValueError, OverflowError) as why:
            text = _text(why)
        there = sorted(os.sched_getaffinity(0))
        if there != sorted(set(cpus)):
            found = ", ".join(map(str, there))
            refused.append(f"not on processors {', '.join(map(str, cpus))}: {text}; it runs on {found}")
    if wanted.priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted.priority))
        except OSError as why:
            refused.append(
                f"no real-time priority {wanted.priority}: {_text(why)}; allow it by `ulimit -r` or CAP_SYS_NICE"
            )
    if wanted.lock_memory and (problem := _lock_memory()):
        refused.append(f"memory is not locked: {problem}; allow it by `ulimit -l unlimited` or CAP_IPC_LOCK")
    return refused


def _lock_memory() -> str:
    """Lock memory; returns "" or what stands in the way. Pages stay in RAM once they were used; unused ones are not
    loaded.
    """
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY and not _may_lock():
        return "its amount is limited, and a process that reaches the limit gets no memory at all"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT):
        return os.strerror(ctypes.get_errno())
    return ""


def _may_lock() -> bool:
    with open("/proc/self/status", encoding="utf-8") as file:
        effective = next(int(line.split()[1], 16) for line in file if line.startswith("CapEff:"))
    return bool(effective >> CAP_IPC_LOCK & 1)


def _text(why: Exception) -> str:
    return (why.strerror if isinstance(why, OSError) else None) or str(why)
