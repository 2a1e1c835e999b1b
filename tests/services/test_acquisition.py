"""Acquisition: the link's state machine, the clock, the port, and a board that comes and goes."""

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.bundle import Bundle
from models.patterns import pattern
from protocol import link
from protocol.frames import STATUS_OPEN, RawFrame, pack
from protocol.scan_setting import COHERENT
from services.acquisition import SourceFeed, open_source
from services.board.boardlink import ANSWER_S, DEAD_SCANS, REFUSED_AGAIN_S, SILENT_S, BoardLink
from services.board.clock import DeviceClock
from services.board.port import PortError, explain
from services.board.scanning import Scanning
from services.board.source import Source
from services.recordings.file_source import FileSource, RecordingSource
from services.recordings.recording import RecordingWriter
from services.runtime.config import Skin
from tests.services.fake_board import FakeBoard, PtyBoard

pytestmark = pytest.mark.live

SCANNING = Scanning(pattern("pairs"), COHERENT, 40_000.0)


def talk(host: BoardLink, board: FakeBoard, start_s: float, seconds: float = 1.0) -> float:
    """Let both ends exchange what they have to say; returns the time at the end."""
    now = start_s
    while now < start_s + seconds:
        host.received(board.receive(host.to_send(now)), now)
        now += 0.02
    return now


def test_a_board_is_asked_checked_configured_and_started() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    assert host.state == "running" and not host.problem
    assert [type(m).__name__ for m in board.heard] == ["Hello", "Config", "Start"]
    assert board.config is not None and (board.config.scan == SCANNING.pattern).all()
    scans = host.received(board.scan(), now)
    assert [s.seq for s in scans] == [0] and len(scans[0].z) == 120


def test_a_slow_line_does_not_make_a_scan_younger() -> None:
    """What counts is when its first byte came; garbage before it says nothing about that."""
    for garbage, came_s in ((b"", 0.0), (b"\x07garbage", 0.02)):
        host, board = BoardLink(SCANNING, 0.0), FakeBoard()
        now = talk(host, board, 0.0, 0.2)
        data = board.scan()
        assert not host.received(garbage, now) and not host.received(b"\0" * bool(garbage) + data[:400], now + came_s)
        assert not host.received(data[400:800], now + 0.024)
        (scan,) = host.received(data[800:], now + 0.030)
        assert host.clock.host_ns(scan.device_us + scan.duration_us) == round((now + came_s) * 1e9)


def test_a_slow_line_is_looked_at_late_but_never_too_late() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    assert host.pause_s(now) == 0
    host.received((data := board.scan())[:100], now)
    assert host.pause_s(now) == 0  # nothing is known of the line yet
    host.received(data[100:], now + 0.011)
    host.received((data := board.scan())[:100], now + 0.045)
    assert 0.008 < (pause_s := host.pause_s(now + 0.045)) < 0.011
    assert len(host.received(data[100:], now + 0.045 + pause_s)) == 1  # it had come sooner:
    host.received(board.scan()[:100], now + 0.090)
    assert host.pause_s(now + 0.090) < pause_s / 2


def test_lost_commands_are_sent_again() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    host.received(board.receive(host.to_send(0.0)), 0.0)
    assert host.state == "config"
    host.to_send(0.1)  # lost on the line
    assert host.to_send(0.1 + ANSWER_S / 2) == b""
    talk(host, board, 0.1 + ANSWER_S)
    assert host.state == "running"


@pytest.mark.parametrize(
    ("ident", "expected"),
    [
        (link.Ident(schema_hash=0xDEADBEEF, firmware="other 2.0"), "'other 2.0' speaks schema deadbeef"),
        (link.Ident(schema_hash=link.SCHEMA_HASH, chip_id=0xA0A0), "0xa0a0, expected 0x5502: power-cycle"),
        (link.Ident(schema_hash=link.SCHEMA_HASH, electrodes=8), "has 8 electrodes"),
    ],
)
def test_a_board_that_does_not_fit_is_refused_by_name_and_tried_again(ident: link.Ident, expected: str) -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    good, board.ident = board.ident, ident
    now = talk(host, board, 0.0, 0.3)
    assert host.state == "refused" and expected in host.problem
    board.ident = good
    talk(host, board, now + REFUSED_AGAIN_S, 0.5)
    assert host.state == "running" and not host.problem


def test_missing_scans_are_counted_across_the_wrap() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    last = 0xFFFFFFFF
    for seq, gap in ((last - 6, False), (last - 5, False), (last - 2, True), (last - 1, False), (1, True), (2, False)):
        board.seq = seq
        assert len(host.received(board.scan(), now)) == 1
        assert host.reasons == {seq: ["gap"] if gap else []}
    assert host.counts["missing"] == 2 + 2  # two before the wrap; the last number and the 0 after it


def test_a_board_that_paused_between_two_scans_left_a_gap_although_its_numbers_go_on() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    host.received(board.scan(device_us=1_000_000), now)
    for device_us, gap in ((1_004_500, False), (1_304_500, True), (1_308_600, False)):
        assert len(host.received(board.scan(device_us=device_us), now + 1e-6 * (device_us - 1_000_000))) == 1
        assert list(host.reasons.values()) == [["gap"] if gap else []]


def test_repeated_and_older_scans_are_dropped() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    taken = []
    for seq in (0, 1, 1, 0, 2, 0xFFFFFFFF, 3):
        board.seq = seq
        taken += [scan.seq for scan in host.received(board.scan(), now)]
    assert taken == [0, 1, 2, 3]
    assert host.counts["repeated"] == 3 and host.counts["scans"] == 4 and host.counts["missing"] == 0


def test_scans_that_count_from_0_again_are_taken_after_a_start() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    board.seq = 1000
    host.received(board.scan(), now)
    board.seq = 0
    host.received(link.encode(link.Ack(link.Start.number, SCANNING.config)), now)  # of a START sent twice
    assert [scan.seq for scan in host.received(board.scan(), now)] == [0]
    board.seq = 500
    host.received(board.scan(), now)
    board.seq = 0  # the board began anew and did not say so: what it sends is old, so that it counts as silent
    while host.state == "running":
        assert not host.received(board.scan(), now)
        now += 0.1
        host.received(board.receive(host.to_send(now)), now)
        assert now < 2 * SILENT_S
    now = talk(host, board, now, 0.3)
    assert host.state == "running"
    assert [scan.seq for scan in host.received(board.scan(), now)] == [0]


def test_only_a_refusal_of_a_command_is_a_refusal() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    host.received(link.encode(link.Nak(of=0, reason=link.NakReason.UNKNOWN, text="what?")), now)
    assert host.state == "running" and not host.problem and host.counts["garbled"] == 1
    host.received(link.encode(link.Nak(of=link.Config.number, reason=99)), now)
    assert host.state == "refused" and host.problem == "the board refuses: reason 99"
    other = BoardLink(SCANNING, 0.0)
    other.received(link.encode(link.Nak(of=0, reason=link.NakReason.SCHEMA)), 0.0)
    assert other.state == "refused" and "SCHEMA" in other.problem


def test_a_reset_or_silent_board_is_configured_again() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    host.received(link.encode(link.Event(code=link.EventCode.BROWN_OUT, text="3.1 V")), now)
    assert host.state == "hello" and "3.1 V" in host.problem
    now = talk(host, board, now, 0.3)
    assert host.state == "running"
    now = talk(host, board, now + SILENT_S + 0.1, 0.3)
    assert host.state == "running" and host.counts["restarts"] == 2


def test_a_board_that_lost_its_registers_silently_is_configured_again() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    board.status = STATUS_OPEN
    for _ in range(DEAD_SCANS):
        host.received(board.scan(), now)
    assert host.state == "hello" and "no current" in host.problem
    board.status = 0
    talk(host, board, now, 0.3)
    assert host.state == "running" and sum(isinstance(m, link.Config) for m in board.heard) == 2


def test_a_deaf_port_is_explained() -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    board.deaf = True
    talk(host, board, 0.0, 3.0)
    assert "no answer to HELLO" in host.problem
    host.received(b"\0garbage that is no message\0" * 3, 3.0)
    host.problem = ""
    talk(host, board, 3.0, 1.0)
    assert "only noise" in host.problem


@settings(max_examples=40, deadline=None)
@given(st.lists(st.binary(max_size=200), max_size=10))
def test_garbage_at_any_moment_does_no_harm(pieces: list[bytes]) -> None:
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = 0.0
    for piece in pieces:
        host.received(piece, now)
        host.received(board.receive(host.to_send(now)), now)
        now += 0.05
    host.received(b"\0", now)
    talk(host, board, now + 2.0, 2.0)
    assert host.state == "running"
    assert len(host.received(board.scan(), now + 4.0)) == 1


u8, u16, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))
texts = st.text(max_size=20)
measured = st.integers(1, 512) | st.just(len(SCANNING.pattern))
intact = st.one_of(
    st.builds(link.Nak, of=u8, reason=u8, text=texts),
    st.builds(link.Ack, of=u8 | st.sampled_from([link.Config.number, link.Start.number]), value=u32),
    st.builds(link.Event, code=u16 | st.integers(0, 12), text=texts),
    st.builds(
        link.Ident,
        link_version=u8,
        schema_hash=u32 | st.just(link.SCHEMA_HASH),
        chip_id=u16 | st.just(link.CHIP_ID),
        unique_id=st.binary(min_size=12, max_size=12),
        capabilities=u32,
        electrodes=u8,
        max_scan=u16,
        firmware=texts,
    ),
    st.builds(
        lambda seq, us, duration, config, n, value: link.ScanFrame(
            seq, us, duration, config, np.full(n, value, np.complex64), np.full(n, seq & 15, np.uint8)
        ),
        u32, u64, u32, u16 | st.just(SCANNING.config), measured, st.floats(width=32),
    ),
    st.builds(link.Hello, schema_hash=u32),
    st.builds(link.Start, config=u16),
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(st.lists(intact, max_size=12), st.booleans())
def test_intact_messages_with_any_fields_do_no_harm(messages: list[link.Message], running: bool) -> None:
    """What a board of another make, or a broken one, may say: nothing raises, and a good board is found again."""
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2) if running else 0.0
    for message in messages:
        for scan in host.received(link.encode(message), now):
            middle_us = scan.device_us + scan.duration_us // 2
            assert -(2**63) <= host.clock.host_ns(middle_us) <= round(now * 1e9)
            assert host.clock.sigma_ns(middle_us) > 0
        host.received(board.receive(host.to_send(now)), now)
        now += 0.05
    now = talk(host, board, now + 2.0, 3.0)
    assert host.state == "running"
    assert len(host.received(board.scan(), now)) == 1


def test_the_clock_finds_the_boards_rate_through_late_arrivals() -> None:
    """A crystal 40 ppm fast, frames late by 1 ms and an exponential 0.5 ms: known offset and slope must come out."""
    rng, clock = np.random.default_rng(0), DeviceClock()
    for n in range(2000):
        true_s = n * 0.045
        late = 1e-3 + rng.exponential(0.5e-3)
        clock.observe(int(true_s * (1 + 40e-6) * 1e6) + 7_000_000, int((true_s + late) * 1e9) + 10**12)
    us = int(90.0 * (1 + 40e-6) * 1e6) + 7_000_000
    assert clock.host_ns(us) == pytest.approx(90.0e9 + 1e6 + 10**12, abs=150_000)
    assert clock.sigma_ns(us) < 150_000


def test_failures_to_open_say_what_to_do() -> None:
    assert "held by another program" in explain("/dev/ttyACM0", OSError("Could not exclusively lock port"))
    assert "plug the board in" in explain("/dev/ttyACM0", FileNotFoundError(2, "No such file"))
    assert "group" in explain("/dev/ttyACM0", PermissionError(13, "Permission denied"))


@pytest.fixture
def start(skin: Skin, bundle: Bundle) -> Iterator[Callable[[str], SourceFeed]]:
    feeds: list[SourceFeed] = []

    def make(port: str) -> SourceFeed:
        feeds.append(SourceFeed(open_source("palm", skin.model_copy(update={"port": port}), bundle)))
        return feeds[-1]

    yield make
    for feed in feeds:
        feed.close()


def first_frame(feed: SourceFeed, timeout_s: float = 10.0) -> RawFrame:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        frame = feed.recv()
        if isinstance(frame, RawFrame):
            return frame
        time.sleep(0.005)
    raise AssertionError(f"no frame: {feed.source.health().messages}")


def problem(feed: SourceFeed, text: str, timeout_s: float = 10.0) -> None:
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if any(text in m for m in feed.source.health().messages):
            return
        time.sleep(0.01)
    raise AssertionError(f"expected {text!r}, found {feed.source.health().messages}")


def test_a_board_is_read_unplugged_and_found_again_under_another_name(
    start: Callable[[str], SourceFeed], tmp_path: Path
) -> None:
    board = PtyBoard(tmp_path / "ttyACM0", FakeBoard())
    feed = start(str(tmp_path / "ttyACM0"))
    frame = first_frame(feed)
    assert frame.valid and frame.z[0] == 1 + 2j and frame.board == b"0123456789ab".hex()
    assert frame.stamps["sample"] < frame.stamps["read"] <= time.monotonic_ns()
    board.garbage = bytes(range(256)) * 4
    time.sleep(0.1)
    board.unplug()
    problem(feed, "cable")
    while feed.recv() is not None:
        pass
    assert feed.source.counts["line_bad_cobs"] + feed.source.counts["line_bad_crc"] > 0
    stranger = PtyBoard(tmp_path / "ttyACM1", FakeBoard(unique_id=b"another one!"))
    back = PtyBoard(tmp_path / "ttyACM2", FakeBoard())
    began = time.monotonic()
    frame = first_frame(feed)
    assert frame.board == b"0123456789ab".hex()
    assert time.monotonic() - began < 3.0  # 1 s on a machine of one's own
    stranger.unplug()
    back.unplug()


def test_a_missing_or_held_port_is_said_and_tried_again(start: Callable[[str], SourceFeed], tmp_path: Path) -> None:
    feed = start(str(tmp_path / "ttyUSB0"))
    problem(feed, "is not there")
    board = PtyBoard(tmp_path / "ttyUSB0", FakeBoard())
    first_frame(feed)
    feed.close()
    holder = os.open(tmp_path / "ttyUSB0", os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(holder, fcntl.LOCK_EX)
    second = start(str(tmp_path / "ttyUSB0"))
    problem(second, "held by another program")
    os.close(holder)
    first_frame(second)
    board.unplug()


def taken(source: Source, count: int) -> list[RawFrame]:
    """The frames that come before the source has a problem, at most `count`."""
    found: list[RawFrame] = []
    for frame in source.frames():
        if frame is not None:
            found.append(frame)
        if source.problem or len(found) == count:
            return found
    return found


def test_a_file_is_a_source_too(tmp_path: Path, skin: Skin, bundle: Bundle) -> None:
    values = np.arange(360, dtype=float).reshape(3, 120) + 1
    np.savez(tmp_path / "one.npz", untouched=values[:1], measurements=values[1:])
    np.savez(tmp_path / "own.npz", measurements=values[:2], reference=values[:2] + 0.5)
    expected = {
        "one.npz": [(1, "reference"), (121, "full"), (241, "full")],
        "own.npz": [
            (1.5, "reference"), (121.5, "reference"),
            (1.5, "reference"), (1, "full"), (121.5, "reference"), (121, "full"),
        ],
    }  # fmt: skip
    for name, those in expected.items():
        source = open_source("palm", skin.model_copy(update={"port": str(tmp_path / name)}), bundle)
        assert isinstance(source, FileSource)
        frames = taken(source, 100)
        assert [(f.z[0].real, f.kind) for f in frames] == those and "has ended" in source.problem
        reasons = ["replay"] + ["separate"] * (name == "own.npz")
        assert all(f.source == "replay" and f.reasons == reasons for f in frames)


def _npz(path: Path, **arrays: object) -> bytes:
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]
    return path.read_bytes()


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, skin: Skin, bundle: Bundle) -> None:
    path, ones = tmp_path / "x.npz", np.ones((2, 120))
    whole = _npz(path, measurements=ones, untouched=np.random.default_rng(0).random((64, 120)))
    broken = bytearray(whole)
    broken[len(whole) // 2 : len(whole) // 2 + 50] = bytes(50)
    cases = {
        "is no npz of plain arrays": [b"", b"PK\3\4", whole[:-30], whole[: len(whole) // 2], bytes(broken), b"x" * 9],
        "no array `measurements`": [_npz(path, measurement=ones)],
        "shape (2, 64), expected numbers of shape (n, 120)": [
            _npz(path, measurements=np.ones((2, 64)), untouched=ones)
        ],
        "3 rows, `measurements` 2": [_npz(path, measurements=ones, reference=np.ones((3, 120)))],
        "is datetime64[s]": [_npz(path, measurements=ones.astype("M8[s]"), untouched=ones)],
        "is <U3": [_npz(path, measurements=ones.astype("<U3"), untouched=ones)],
        "is [('a', '<f8')]": [_npz(path, measurements=ones.view([("a", "<f8")]), untouched=ones)],
    }
    for text, files in cases.items():
        for data in files:
            path.write_bytes(data)
            source = open_source("palm", skin.model_copy(update={"port": str(path)}), bundle)
            assert taken(source, 1) == []
            assert text in source.problem and str(path) in source.problem, source.problem


def _recording(path: Path, **frames: list[RawFrame | bytes]) -> None:
    with RecordingWriter(path, overwrite=True) as writer:
        for name, those in frames.items():
            for n, frame in enumerate(those):
                data = frame if isinstance(frame, bytes) else pack(frame).partition(b"\0")[2]
                writer.write(f"raw/{name}", data, n * 10**6)


def _raw(skin: str, scan: int) -> RawFrame:
    ones = np.ones(120, np.complex64)
    status = np.zeros(120, np.uint8)
    return RawFrame(skin=skin, scan=scan, z=ones, status=status, source="board", stamps={"sample": 1 + scan * 10**6})


def test_a_recording_is_a_source_of_one_skin_whatever_else_it_holds(tmp_path: Path, skin: Skin, bundle: Bundle) -> None:
    path = tmp_path / "x.mcap"
    source = open_source("palm", skin.model_copy(update={"port": str(path)}), bundle)
    assert isinstance(source, RecordingSource)
    _recording(path, sole=[_raw("sole", 9)], palm=[_raw("palm", 0), b"no frame", b"\x80", _raw("palm", 1)])
    frames = taken(source, 100)
    assert [(f.skin, f.scan, f.source, f.reasons) for f in frames] == [
        ("palm", 0, "replay", ["replay"]),
        ("palm", 1, "replay", ["replay"]),
    ]
    assert source.counts["malformed"] == 2 and "has ended" in source.problem


def test_a_recording_of_one_skin_serves_under_any_name(tmp_path: Path, skin: Skin, bundle: Bundle) -> None:
    path = tmp_path / "x.mcap"
    named = skin.model_copy(update={"port": str(path)})
    _recording(path, sole=[_raw("sole", 9)])
    assert [(f.skin, f.scan) for f in taken(open_source("palm", named, bundle), 9)] == [("palm", 9)]
    _recording(path, sole=[_raw("sole", 9)], heel=[_raw("heel", 3)])
    source = open_source("palm", named, bundle)
    assert taken(source, 9) == [] and "skins sole, heel, none called palm" in source.problem
    path.write_bytes(b"garbage")
    source = open_source("palm", named, bundle)
    assert taken(source, 9) == [] and "not a recording" in source.problem


def test_a_source_that_blocks_does_not_hold_up_a_stop(skin: Skin, bundle: Bundle) -> None:
    """Neither one stuck in a read nor one stuck in its close (a socket:// port waits there)."""
    free = threading.Event()

    class Stuck(Source):
        def frames(self) -> Iterator[RawFrame | None]:
            if self.name == "reading":
                free.wait(30)
            yield None

        def close(self) -> None:
            free.wait(30)

    feeds = [SourceFeed(Stuck(name, skin, bundle)) for name in ("reading", "closing")]
    time.sleep(0.05)
    try:
        for feed in feeds:
            began = time.monotonic()
            feed.close()
            assert time.monotonic() - began < 0.4
    finally:
        free.set()


def test_boards_that_go_while_the_process_ends_are_no_trouble(
    skin: Skin, bundle: Bundle, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ending, names = threading.Event(), ("ttyACM0", "ttyACM1")
    boards = [PtyBoard(tmp_path / name, FakeBoard()) for name in names]
    ports = [skin.model_copy(update={"port": str(tmp_path / name)}) for name in names]
    feeds = [SourceFeed(open_source("palm", port, bundle), ending=ending) for port in ports]
    for feed in feeds:
        first_frame(feed)
    ending.set()  # what closing the first one does
    for board in boards:
        board.unplug()
    for feed in feeds:
        feed.close()
    assert "cable" not in caplog.text and [feed.source.problem for feed in feeds] == ["", ""]


def test_port_errors_are_their_own_kind(tmp_path: Path) -> None:
    from services.board.port import Port

    with pytest.raises(PortError, match="is not there"):
        Port(str(tmp_path / "nothing"))
    for url in ("nonsense://x", "loop://?logging=nonsense", "loop://?nonsense=1"):
        with pytest.raises(PortError, match="cannot be opened"):
            Port(url)


def test_a_port_that_is_gone_says_so_without_the_systems_numbers() -> None:
    """pyserial's own text has the failure as a program prints it: (5, 'Input/output error')."""
    from services.board.port import Port

    master, slave = os.openpty()
    port = Port(os.ttyname(slave))
    os.close(slave)
    os.close(master)
    with pytest.raises(PortError) as gone:
        port.write(b"x")
    assert str(gone.value) == f"{port.url} is gone (input/output error): is the cable plugged in?"
    port.close()
