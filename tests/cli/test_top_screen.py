"""`skin top` and `skin compare`: what they make of frames, drawn in 80 x 24, and in a real terminal (a pty)."""

import contextlib
import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, RawFrame, StatusFrame, TrueTouch, TruthFrame
from protocol.runtime import host_id
from services.cli import monitor as of_monitor
from services.cli.heatmap import LETTERS, draw
from services.cli.monitor import Monitor
from services.cli.screen import screen
from services.cli.truth import pairs
from tests.needs import ROOT
from tests.waiting import until

COLUMNS, LINES = 80, 24
NOW = 1000.0  # s


@pytest.fixture
def monitor(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> Monitor:
    made = Monitor("palm")
    made.started_s = NOW - 2
    monkeypatch.setattr(of_monitor.time, "monotonic", lambda: NOW)
    return made


def raw(age_s: float = 0.01, **changes) -> RawFrame:
    stamps = {"sample": round((NOW - age_s) * 1e9), "read": round((NOW - age_s / 5) * 1e9)}
    empty = {"z": np.ones(3, "c8"), "status": np.zeros(3, "u1"), "stamps": stamps}
    return RawFrame(**{"skin": "palm", "host": host_id(), **empty, **changes})


def image(size: int = 96, **more) -> ImageFrame:
    drop = np.zeros((size, size), np.float32)
    drop[80:90, 70:80] = 0.4
    more = {"metres_per_pixel": 0.1 / 96, "origin": [-0.05, -0.05], **more} if size else more
    return ImageFrame(**{"skin": "palm", "touched": True, "image": drop, "valid": True, **more})


def test_rates_and_latencies_are_counted_from_frames_of_this_host(monitor: Monitor) -> None:
    monitor.take(raw(0.2), NOW - 6)  # longer ago than the window
    for age_ms in range(1, 101):
        monitor.take(raw(1e-3 * age_ms), NOW)
    row = monitor.snapshot()["topics"]["raw"]
    assert (row["rate_hz"], row["age_ms"]) == (50, 0)
    assert row["latency_ms"] == {"p50": 51, "p99": 100} and row["since_read_ms"] == {"p50": 10.2, "p99": 20}
    for change in ({"source": "replay"}, {"host": "elsewhere"}):
        monitor.topics["raw"].arrivals.clear()
        monitor.take(raw(**change), NOW)
        assert monitor.snapshot()["topics"]["raw"]["latency_ms"] == {"p50": None, "p99": None}


def test_what_a_process_says_is_of_its_last_second_and_stale_when_it_is_silent(monitor: Monitor) -> None:
    counts = {"networks_run": 100, "held": 0, "untouched": 0}
    for more in ({}, {"networks_run": 105, "held": 10, "untouched": 5}):
        monitor.take(StatusFrame(skin="palm", process="inference", level="OK", counters=counts | more), NOW)
    assert monitor.snapshot()["processes"]["inference"]["skipped"] == {"untouched": 0.25, "held": 0.5}
    for age_s, level, said in ((3.4, "OK", []), (3.6, "STALE", ["silent for 4 s"])):
        monitor.take(StatusFrame(skin="palm", process="inference", level="OK"), NOW - age_s)
        row = monitor.snapshot()["processes"]["inference"]
        assert (row["level"], row["messages"]) == (level, said)


def test_the_picture_has_up_above_and_right_on_the_right() -> None:
    lines = draw(image().image, 0.05, cells=32, coloured=False).plain.splitlines()
    marked = {(row, column) for row, text in enumerate(lines) for column, c in enumerate(text) if c == LETTERS[-2]}
    assert marked and all(row <= 3 and 22 <= column <= 27 for row, column in marked)
    lines = draw(None, 0.05, [(-0.03, 0.0)], None, cells=32, coloured=False).plain.splitlines()
    assert [(row, text.index("X")) for row, text in enumerate(lines) if "X" in text] == [(7, 6)]


def test_each_true_touch_meets_the_nearest_contact() -> None:
    touches = [TrueTouch(shape="circle", x=x, y=0.0, radius_m=0.01, drop=0.3, force_n=3.0) for x in (0.03, -0.03)]
    found = [Contact(id=1, position=[-0.029, 0.0, 0.0], force_n=2.9), Contact(id=2, state="end", position=[0.03, 0, 0])]
    rows = pairs(TruthFrame(skin="palm", touches=touches), ContactFrame(skin="palm", contacts=found))
    assert rows[0]["found"] is None  # the contact that ended is none
    assert rows[1]["found"]["id"] == 1 and rows[1]["found"]["error_mm"] == pytest.approx(1.0)


def drawn(monitor: Monitor) -> list[str]:
    """The lines that a terminal of 80 columns shows."""
    console = Console(width=COLUMNS, height=LINES, color_system=None)
    with console.capture() as captured:
        console.print(screen(monitor, COLUMNS, coloured=False, live=True))
    return [line.rstrip() for line in captured.get().splitlines()]


@pytest.fixture
def busy(monitor: Monitor) -> Monitor:
    """As busy as it gets: more contacts and more to say than there is room for."""
    square = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
    contacts = [Contact(id=k, position=[0.01 * k, -0.02, 0.0], force_n=1.5 * k, shape="rectangle") for k in range(1, 7)]
    touched = ContactFrame(skin="palm", valid=True, reasons=["changing"], contacts=contacts)
    said = ["something to say, in a sentence that is longer than any line of the terminal is" * 2] * 2
    processes = ("acquisition", "preprocessing", "inference", "publisher", "stub")
    frames = [StatusFrame(skin="palm", process=name, level="WARN", messages=said, cpu=0.123) for name in processes]
    frames += [InfoFrame(skin="palm", info={"geometry": {"outline": square}}), raw(valid=True), image(), touched]
    for frame in frames:
        monitor.take(frame, NOW)
    return monitor


def test_all_of_it_has_room_in_80_by_24_and_says_whether_contacts_are_valid(busy: Monitor) -> None:
    lines = drawn(busy)
    assert len(lines) <= LINES and max(map(len, lines)) <= COLUMNS and "…" not in "".join(lines[1:])
    for words in ("contacts valid", "conductivity drop 0", "+10.0", "-20.0", "1.50 N", "and 2 more", "acquisition"):
        assert words in "\n".join(lines), words
    busy.take(ContactFrame(skin="palm", valid=False, reasons=["stale_baseline"]), NOW)
    assert "contacts NOT VALID, do not act on them (stale_baseline)" in drawn(busy)[0]


def test_a_held_image_stays_and_says_so(busy: Monitor) -> None:
    busy.take(image(0, held=True), NOW)
    page = drawn(busy)
    assert any(c in line[6:38] for line in page[1:5] for c in "@%") and "image held: unchanged" in "".join(page)
    busy.take(image(0, touched=False), NOW)
    page = drawn(busy)
    assert not any(c in line[6:38] for line in page[1:17] for c in "@%") and "held" not in "".join(page)


@pytest.mark.live
def test_q_leaves_and_gives_the_terminal_back(runtime: Path) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, COLUMNS, 0, 0))
    os.set_blocking(ours, False)
    before, shown = termios.tcgetattr(theirs), bytearray()
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    command, environment = [sys.executable, ROOT / "skin", "top"], os.environ | {"TERM": "xterm-256color"}
    process = subprocess.Popen(command, env=environment, **pipes)

    def read() -> bytes:
        with contextlib.suppress(BlockingIOError):
            shown.extend(os.read(ours, 65536))
        return bytes(shown)

    try:
        until(lambda: b"waiting for frames" in read() and b"leaves" in read(), process)
        os.write(ours, b"xq")
        until(lambda: read() and process.poll() is not None)
    finally:
        process.kill()
    assert process.returncode == 0 and termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)
