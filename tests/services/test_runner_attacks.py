"""A whole process whose sockets are deleted or flooded: status says it, frames flow again within 2 s, memory stays."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.frames import DeltaFrame, StatusFrame
from tests.services.conftest import Board
from tests.services.test_runner import ROOT, Process, process  # noqa: F401  (a fixture)

pytestmark = pytest.mark.live

FLOOD = ROOT / "tests" / "protocol" / "flood.py"
CURED_S = 2.0
PATIENCE = 5  # times as long on a machine that does other things too


@contextlib.contextmanager
def flood(kind: str, address: str, count: int) -> Iterator[int]:
    """A peer that does too much; gives its process id."""
    popen = subprocess.Popen([sys.executable, str(FLOOD), kind, address, str(count)], stdout=subprocess.DEVNULL)
    try:
        yield popen.pid
    finally:
        popen.kill()
        popen.wait()


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def keep_feeding(process: Process, board: Board, seconds: float) -> tuple[float, list[str]]:  # noqa: F811
    """Frames for so long; the longest time without one that came out, and what status said."""
    end, last, longest, said = time.monotonic() + seconds, time.monotonic(), 0.0, []
    while time.monotonic() < end:
        frame = board.frame()
        frame.stamps["read"] = time.monotonic_ns()
        process.upstream.poll()
        process.upstream.send(frame)
        for out in process.take(0.045):
            if isinstance(out, DeltaFrame):
                longest, last = max(longest, time.monotonic() - last), time.monotonic()
            elif isinstance(out, StatusFrame):
                said += out.messages
    return max(longest, time.monotonic() - last), said


@pytest.mark.release
def test_deleted_sockets_are_bound_anew(process: Process, board: Board, runtime: Path) -> None:  # noqa: F811
    process.connect(board)
    for name in ("preprocessing.ipc", "preprocessing.ctl"):
        os.unlink(runtime / name)
    longest, said = keep_feeding(process, board, 4.0)
    assert longest < PATIENCE * CURED_S
    assert "preprocessing.ipc was deleted" in " ".join(said) and "preprocessing.ctl was deleted" in " ".join(said)
    assert process.control.call("status")["flowing"]


@pytest.mark.release
@pytest.mark.parametrize(
    ("kind", "socket", "count", "says"),
    [
        ("subscribe", "preprocessing.ipc", 50_000, "too many subscriptions"),
        ("command", "preprocessing.ctl", 3000, "control requests a second"),
    ],
)
def test_floods_are_named_and_frames_flow(
    process: Process,  # noqa: F811
    board: Board,
    runtime: Path,
    kind: str,
    socket: str,
    count: int,
    says: str,
) -> None:
    process.connect(board)
    keep_feeding(process, board, 1.0)
    before = resident_mb(process.popen.pid)
    with flood(kind, f"ipc://{runtime / socket}", count) as pid:
        longest, said = keep_feeding(process, board, 6.0)
    assert any(says in text and str(pid) in text for text in said), said
    assert longest < PATIENCE * CURED_S
    assert resident_mb(process.popen.pid) - before < 50
    longest, _ = keep_feeding(process, board, 1.0)
    assert longest < 1.0
    assert process.control.call("status")["flowing"]
