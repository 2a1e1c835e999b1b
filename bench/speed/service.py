"""The service brought up for a benchmark: real processes and the stub, in a runtime folder of their own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import zmq

from bench import ROOT
from protocol.sockets import ControlClient
from protocol.transport import Context
from services.runtime.config import ScanMode

START_S = 60.0
SQUARE = '[skins.palm]\nport = "stub"\nbundle = "square16"\nframe_id = "palm"\n'
"""The stub's square skin, in skin.toml."""


BEGIN: dict[str, Callable[[Service], Any]] = {
    "untouched": lambda service: service.stub("release"),
    "still": lambda service: service.stub("press", x=0.01, y=0.0, force=3.0, seconds=600.0),
    "moving": lambda service: service.stub("scene", name="slide"),
}
"""What the stub is told so that the skin is so."""


def end_on_sigterm() -> None:
    """SIGTERM unwinds the program, so that what it started ends too."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))


@contextmanager
def running(*arguments: str, skin: str = "palm") -> Iterator[Service]:
    """`skin up ARGUMENTS` until the block ends; valid contact frames of `skin` come when it begins. Raises
    RuntimeError.
    """
    folder = Path(tempfile.mkdtemp(prefix="eitskin-bench", dir="/tmp"))  # short: a socket's path has 107 bytes
    before = os.environ.get("EITSKIN_RUNTIME")
    os.environ["EITSKIN_RUNTIME"] = str(folder)
    log = (folder / "log.txt").open("wb")
    process = subprocess.Popen([sys.executable, str(ROOT / "skin"), "up", *arguments], stdout=log, stderr=log)
    try:
        service = Service(folder, process)
        if not service.until(skin, lambda frame: frame["valid"], START_S):
            said = (folder / "log.txt").read_text()[-2000:]
            raise RuntimeError(f"no valid contact frame within {START_S:.0f} s: {said}")
        yield service
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
        log.close()
        shutil.rmtree(folder, ignore_errors=True)
        os.environ.pop("EITSKIN_RUNTIME")
        if before is not None:
            os.environ["EITSKIN_RUNTIME"] = before


@contextmanager
def running_square(scan: ScanMode, more: str = "") -> Iterator[Service]:
    """`running` with the stub's square skin as "palm", scanned so. more: further sections of skin.toml."""
    with tempfile.TemporaryDirectory(prefix="eitskin-bench-") as folder:
        config = Path(folder) / "skin.toml"
        config.write_text(f'{SQUARE}scan = "{scan}"\n{more}')
        with running("--config", str(config)) as service:
            yield service


class Service:
    """A running one, seen from outside."""

    def __init__(self, folder: Path, process: subprocess.Popen[bytes]) -> None:
        self.folder, self.process = folder, process

    def until(self, skin: str, fits: Callable[[dict[str, Any]], object], seconds: float) -> bool:
        """Whether a contact frame of this skin that fits came within so long."""
        contacts, end, found = Outside("contact", skin, self.folder), time.monotonic() + seconds, False
        while not found and time.monotonic() < end and self.process.poll() is None:
            got = contacts.recv(0.5)
            found = got is not None and bool(fits(got[0]))
        contacts.close()
        return found

    def stub(self, command: str, **arguments: Any) -> dict[str, Any]:
        return ControlClient("stub", 5.0).call(command, **arguments)

    def pids(self) -> dict[str, int]:
        """Process id of each stage and of the stub."""
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
                command = (entry / "cmdline").read_bytes().split(b"\0")
            except (OSError, IndexError):
                continue
            if parent == self.process.pid:
                module = next((c.decode() for c in command if c.startswith((b"services.", b"firmware_stub"))), "")
                found[module.removeprefix("services.").replace("firmware_stub", "stub")] = int(entry.name)
        return found

    def memory_bytes(self) -> dict[str, int]:
        """Resident memory of each process."""
        page = os.sysconf("SC_PAGE_SIZE")
        return {
            name: int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * page for name, pid in self.pids().items()
        }

    def cpu_s(self) -> dict[str, float]:
        """CPU seconds that each process has used."""
        used = {}
        for name, pid in self.pids().items():
            threads = Path(f"/proc/{pid}/task").iterdir()
            used[name] = sum(int((t / "schedstat").read_text().split()[0]) for t in threads) * 1e-9
        return used


def subscribed(folder: Path, processes: Iterable[str], *topics: bytes) -> zmq.Socket[bytes]:
    """To every message of these topics, as a controller that has none of the project's code."""
    socket = Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 100_000)
    for process in processes:
        socket.connect(f"ipc://{folder}/{process}.ipc")
    for topic in topics:
        socket.subscribe(topic)
    return socket


def heard(socket: zmq.Socket[bytes], seconds: float) -> list[tuple[bytes, int]]:
    """(message, when it came) of so long; nothing is decoded meanwhile."""
    found, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        if socket.poll(int(1000 * left) + 1):
            found.append((socket.recv(), time.monotonic_ns()))
    return found


class Outside:
    """A controller that has none of the project's code: the newest message of a topic, and when it came."""

    def __init__(self, topic: str, skin: str, folder: Path) -> None:
        self.socket = Context.instance().socket(zmq.SUB)
        self.socket.setsockopt(zmq.CONFLATE, 1)
        self.socket.connect(f"ipc://{folder}/publisher.ipc")
        self.socket.subscribe(f"{topic}/{skin}\0".encode())

    def recv(self, timeout_s: float) -> tuple[dict[str, Any], int] | None:
        """(frame, monotonic ns of its arrival), or None."""
        if not self.socket.poll(int(timeout_s * 1000)):
            return None
        message = self.socket.recv()
        at = time.monotonic_ns()
        return msgpack.unpackb(message[message.index(b"\0") + 1 :]), at

    def close(self) -> None:
        self.socket.close(0)
