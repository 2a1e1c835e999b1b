"""`skin top` as it is seen: in a terminal of 80 x 24, a real one (a pty), and drawn from frames."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, RawFrame, StatusFrame
from services.cli.monitor import Monitor
from services.cli.screen import screen

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
COLUMNS, LINES = 80, 24


def drawn(monitor: Monitor, coloured: bool = False) -> list[str]:
    """The lines that a terminal of 80 columns shows."""
    console = Console(
        width=COLUMNS, height=LINES, color_system="truecolor" if coloured else None, force_terminal=coloured
    )
    with console.capture() as captured:
        console.print(screen(monitor, COLUMNS, coloured=coloured, live=True))
    return [line.rstrip() for line in captured.get().splitlines()]


def image(touched: bool = True, held: bool = False, size: int = 96) -> ImageFrame:
    drop = np.zeros((size, size), np.float32)
    drop[80:90, 70:80] = 0.4
    return ImageFrame(
        skin="palm",
        touched=touched,
        held=held,
        image=drop,
        metres_per_pixel=0.1 / 96,
        origin=[-0.05, -0.05],
        valid=True,
    )


def without_image(touched: bool, held: bool, reconstructed: int = 0) -> ImageFrame:
    return ImageFrame(skin="palm", touched=touched, held=held, reconstructed=reconstructed, valid=True)


@pytest.fixture
def monitor(runtime: Path) -> Monitor:
    """As busy as it gets: more contacts and more to say than there is room for."""
    monitor, now = Monitor("palm"), time.monotonic()
    square = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
    monitor.take(InfoFrame(skin="palm", info={"geometry": {"outline": square}}), now)
    monitor.take(RawFrame(skin="palm", valid=True, z=np.ones(3, "c8"), status=np.zeros(3, "u1")), now)
    monitor.take(image(), now)
    contacts = [Contact(id=k, position=[0.01 * k, -0.02, 0.0], force_n=1.5 * k, shape="rectangle") for k in range(1, 7)]
    reasons = ["changing", "uncalibrated_force"]
    monitor.take(ContactFrame(skin="palm", valid=True, reasons=reasons, contacts=contacts), now)
    for name in ("acquisition", "preprocessing", "inference", "publisher", "stub"):
        said = [f"something that {name} has to say, in a sentence that is longer than any line of the terminal"] * 2
        monitor.take(StatusFrame(skin="palm", process=name, level="WARN", messages=said, cpu=0.123), now)
    return monitor


@pytest.mark.parametrize("coloured", [False, True])
def test_all_of_it_has_room_in_80_by_24(monitor: Monitor, coloured: bool) -> None:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in drawn(monitor, coloured)]
    assert len(lines) <= LINES and max(map(len, lines)) <= COLUMNS and "…" not in "".join(lines[1:])
    page = "\n".join(lines)
    for words in ("contacts valid", "q leaves", "y mm", "x mm", "+50", "-50", "conductivity drop 0", "S/m", "frames/s"):
        assert words in page, words
    for words in ("+10.0", "-20.0", "1.50 N", "rectangle", "and 2 more", "acquisition", "CPU %", "delay ms", "lost"):
        assert words in page, words
    skin = [line[6:38] for line in lines[1:17]]  # the whole skin: 16 lines of 32
    assert all(len(row) == 32 and " " not in row for row in skin)


def test_what_may_not_be_acted_on_says_so_first(monitor: Monitor) -> None:
    monitor.take(ContactFrame(skin="palm", valid=False, reasons=["stale_baseline"]), time.monotonic())
    assert "contacts NOT VALID, do not act on them (stale_baseline)" in drawn(monitor)[0]


def test_a_held_image_stays_and_says_so(monitor: Monitor) -> None:
    """A held frame brings no image again: the last one is still what is there."""
    monitor.take(without_image(touched=True, held=True), time.monotonic())
    page = drawn(monitor)
    assert any("@" in line for line in page[1:5]) or any("%" in line for line in page[1:5])
    assert any("image held: unchanged" in line for line in page)
    monitor.take(without_image(touched=False, held=False), time.monotonic())
    page = drawn(monitor)
    assert not any("@" in line[6:38] for line in page[1:17]) and not any("held" in line for line in page)
    # One that we never saw, as a late joiner: it cannot be shown.
    monitor.take(without_image(touched=True, held=True, reconstructed=7), time.monotonic())
    assert any("shown when it changes" in line for line in drawn(monitor))


def test_a_skin_is_drawn_to_its_edge_and_no_further(runtime: Path) -> None:
    monitor, angle = Monitor("sole"), np.linspace(0, 2 * np.pi, 64, endpoint=False)
    disc = 0.08 * np.stack([np.cos(angle), np.sin(angle)], 1)
    monitor.take(InfoFrame(skin="sole", info={"geometry": {"outline": disc}}), time.monotonic())
    monitor.take(RawFrame(skin="sole", z=np.ones(3, "c8"), status=np.zeros(3, "u1")), time.monotonic())
    lines = drawn(monitor)
    assert lines[1].startswith("  +80 ") and lines[1][6:14].strip() == "" and "." in lines[1][16:24]


def test_q_leaves_and_gives_the_terminal_back(runtime: Path) -> None:
    """In a pseudo-terminal of 80 x 24; no service needed for leaving."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
    before = termios.tcgetattr(theirs)
    environment = os.environ | {"TERM": "xterm-256color"}
    command = [sys.executable, str(ROOT / "skin"), "top"]
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    shown, end = b"", time.monotonic() + 60
    while b"waiting for frames" not in shown:
        assert time.monotonic() < end and process.poll() is None, shown
        if select.select([ours], [], [], 0.1)[0]:
            shown += os.read(ours, 65536)
    assert b"q leaves" in shown or b"leaves" in os.read(ours, 65536)
    os.write(ours, b"x")
    os.write(ours, b"q")
    while process.poll() is None:
        assert time.monotonic() < end, "q does not leave"
        if select.select([ours], [], [], 0.1)[0]:
            os.read(ours, 65536)
    assert process.returncode == 0 and termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)
