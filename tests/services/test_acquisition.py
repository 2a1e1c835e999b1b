"""Acquisition: the link's state machine, the port, files as sources, and a board that comes and goes."""

import contextlib
import os
import select
import socket
import threading
import time
import tty
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import serial
import serial.rfc2217
from hypothesis import given, settings
from hypothesis import strategies as st

from models.patterns import pattern
from protocol import link
from protocol.frames import STATUS_OPEN, RawFrame, pack
from protocol.scan_setting import COHERENT
from services.acquisition import SourceFeed, open_source
from services.board.boardlink import BoardLink
from services.board.host_time import HostTime
from services.board.other_end import OtherEnd
from services.board.port import Port
from services.board.scanning import Scanning
from services.board.source import BoardSource
from services.recordings.recording import RecordingWriter
from tests.waiting import until

SCANNING = Scanning(pattern("pairs"), COHERENT, 40_000.0)


class FakeBoard:
    """The firmware: bytes in, bytes out. No physics: all Z are 1 + 2j."""

    def __init__(self, unique_id=b"0123456789ab"):
        self.ident = link.Ident(schema_hash=link.SCHEMA_HASH, unique_id=unique_id, firmware="fake 1.0")
        self.decoder, self.heard, self.config = link.Decoder(), [], None
        self.running = self.deaf = False
        self.seq = self.status = 0
        self._scanned = (0, 0)  # number of the last scan, when it began [us]

    def receive(self, data):
        out = b""
        for message in self.decoder.feed(data):
            self.heard.append(message)
            if self.deaf:
                continue
            if isinstance(message, link.Hello):
                out += link.encode(self.ident)
            elif isinstance(message, link.Config):
                self.config = message
                out += link.encode(link.Ack(of=message.number, value=message.config))
            elif isinstance(message, link.Start):
                self.running, self.seq = True, 0
                out += link.encode(link.Ack(of=message.number, value=message.config))
        return out

    def scan(self, device_us=None):
        """The next scan; without a time, one that follows the scan before without a pause."""
        if device_us is None:
            ahead = (self.seq - self._scanned[0] + 2**31) % 2**32 - 2**31
            device_us = max(0, self._scanned[1] + ahead * 4000)
        self._scanned, n = (self.seq, device_us), len(self.config.scan)
        z, status = np.full(n, 1 + 2j, np.complex64), np.full(n, self.status, np.uint8)
        self.seq += 1
        return link.encode(link.ScanFrame(self._scanned[0], device_us, 4000, self.config.config, z, status))


class PtyBoard:
    """A FakeBoard behind a pty, linked at `path`, scanning all the time in a thread."""

    def __init__(self, path, board):
        self.board, self.path, self.garbage = board, path, b""
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        path.symlink_to(os.ttyname(self.slave))
        self._stop, self._thread = threading.Event(), threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        began = time.monotonic()
        while not self._stop.is_set():
            with contextlib.suppress(OSError):
                if select.select([self.master], [], [], 0.01)[0]:
                    os.write(self.master, self.board.receive(os.read(self.master, 4096)))
                os.write(self.master, self.garbage)
                self.garbage = b""
                if self.board.running:
                    os.write(self.master, self.board.scan(int((time.monotonic() - began) * 1e6)))

    def unplug(self):
        self._stop.set()
        self._thread.join()
        self.path.unlink(missing_ok=True)
        os.close(self.master)
        os.close(self.slave)


def talk(host, board, start_s, seconds=1.0):
    """Let both ends exchange what they have to say; returns the time at the end."""
    now = start_s
    while now < start_s + seconds:
        host.received(board.receive(host.to_send(now)), now)
        now += 0.02
    return now


def running():
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2)
    assert host.state == "running" and not host.problem
    return host, board, now


def test_a_board_is_asked_checked_configured_and_started_and_asked_again_where_a_command_is_lost():
    host, board, now = running()
    assert [type(m).__name__ for m in board.heard] == ["Hello", "Config", "Start"]
    assert (board.config.scan == SCANNING.pattern).all()
    scans = host.received(board.scan(), now)
    assert [s.seq for s in scans] == [0] and len(scans[0].z) == 120
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    host.received(board.receive(host.to_send(0.0)), 0.0)
    assert host.state == "config" and host.to_send(0.1)  # lost on the line
    assert host.to_send(0.55) == b""
    talk(host, board, 0.65)
    assert host.state == "running"


def test_a_slow_line_makes_no_scan_younger_and_is_looked_at_late_but_never_too_late():
    """What counts is when its first byte came; garbage before it says nothing about that."""
    for garbage, came_s in ((b"", 0.0), (b"\x07garbage", 0.02)):
        host, board, now = running()
        data = board.scan()
        assert not host.received(garbage, now) and not host.received(b"\0" * bool(garbage) + data[:400], now + came_s)
        assert not host.received(data[400:800], now + 0.024)
        (scan,) = host.received(data[800:], now + 0.030)
        assert host.clock.host_ns(scan.device_us + scan.duration_us) == round((now + came_s) * 1e9)
    host, board, now = running()
    host.received((data := board.scan())[:100], now)
    assert host.pause_s(now) == 0  # nothing is known of the line yet
    host.received(data[100:], now + 0.011)
    host.received((data := board.scan())[:100], now + 0.045)
    assert 0.008 < (pause_s := host.pause_s(now + 0.045)) < 0.011
    host.received(data[100:], now + 0.045 + pause_s)  # it had come sooner:
    host.received(board.scan()[:100], now + 0.090)
    assert host.pause_s(now + 0.090) < pause_s / 2


def test_a_board_that_does_not_fit_is_refused_by_name_and_tried_again():
    for change, expected in (
        ({"schema_hash": 0xDEADBEEF}, "'fake 1.0' speaks schema deadbeef"),
        ({"chip_id": 0xA0A0}, "0xa0a0, expected 0x5502: power-cycle"), ({"electrodes": 8}, "has 8 electrodes"),
    ):  # fmt: skip
        host, board = BoardLink(SCANNING, 0.0), FakeBoard()
        good, board.ident = board.ident, replace(board.ident, **change)
        now = talk(host, board, 0.0, 0.3)
        assert host.state == "refused" and expected in host.problem
        board.ident = good
        talk(host, board, now + 1.0, 0.5)
        assert host.state == "running" and not host.problem


def test_missing_repeated_and_older_scans_are_told_by_their_numbers_and_times():
    last = 0xFFFFFFFF
    host, board, now = running()
    for seq, gap in ((last - 6, False), (last - 5, False), (last - 2, True), (last - 1, False), (1, True), (2, False)):
        board.seq = seq
        assert len(host.received(board.scan(), now)) == 1 and host.reasons == {seq: ["gap"] if gap else []}
    assert host.counts["missing"] == 2 + 2  # two before the wrap; the last number and the 0 after it
    host, board, now = running()
    taken = []
    for board.seq in (0, 1, 1, 0, 2, last, 3):
        taken += [scan.seq for scan in host.received(board.scan(), now)]
    assert taken == [0, 1, 2, 3]
    assert host.counts["repeated"] == 3 and host.counts["scans"] == 4 and host.counts["missing"] == 0
    host, board, now = running()
    host.received(board.scan(device_us=1_000_000), now)
    for device_us, gap in ((1_004_500, False), (1_304_500, True), (1_308_600, False)):  # it paused; its numbers go on
        assert len(host.received(board.scan(device_us=device_us), now + 1e-6 * (device_us - 1_000_000))) == 1
        assert list(host.reasons.values()) == [["gap"] if gap else []]


def test_scans_that_count_from_0_again_are_taken_after_a_start():
    host, board, now = running()
    board.seq = 1000
    host.received(board.scan(), now)
    board.seq = 0
    host.received(link.encode(link.Ack(link.Start.number, SCANNING.config)), now)  # of a START sent twice
    assert [scan.seq for scan in host.received(board.scan(), now)] == [0]
    board.seq = 500
    host.received(board.scan(), now)
    board.seq = 0  # it began anew and did not say so: what it sends is old, so that it counts as silent
    while host.state == "running":
        assert not host.received(board.scan(), now)
        now += 0.1
        host.received(board.receive(host.to_send(now)), now)
        assert now < 2.0
    now = talk(host, board, now, 0.3)
    assert host.state == "running" and [scan.seq for scan in host.received(board.scan(), now)] == [0]


def test_what_a_board_says_of_itself_and_a_silent_or_dead_one():
    host, board, now = running()
    host.received(link.encode(link.Nak(of=0, reason=link.NakReason.UNKNOWN, text="what?")), now)
    assert host.state == "running" and not host.problem and host.counts["garbled"] == 1
    for text, said in (("", "reason 99"), ("no\x1b[2J", "no\\x1b[2J")):
        host.received(link.encode(link.Nak(of=link.Config.number, reason=99, text=text)), now)
        assert host.state == "refused" and host.problem == f"the board refuses: {said}"
    host, board, now = running()
    host.received(link.encode(link.Event(code=link.EventCode.BROWN_OUT, text="3.1 V")), now)
    assert host.state == "hello" and "3.1 V" in host.problem
    now = talk(host, board, now, 0.3)
    host.received(board.scan(), now)
    for later_s, restarts in ((0.9, 1), (1.1, 2)):
        host.to_send(now + later_s)
        assert host.counts["restarts"] == restarts, "silent for a second"
    now = talk(host, board, now + 1.2, 0.3)
    board.status = STATUS_OPEN  # it lost its registers and says nothing
    for n in range(10):
        assert host.state == "running", n
        host.received(board.scan(), now)
    assert host.state == "hello" and "no current" in host.problem
    board.status = 0
    talk(host, board, now, 0.3)
    assert host.state == "running" and sum(isinstance(m, link.Config) for m in board.heard) == 4


def sent(n, schema=link.SCHEMA_HASH):
    """A scan as some board sends it, of other values each time."""
    z = np.random.default_rng(n).normal(size=120).astype(np.complex64)
    return link.encode(link.ScanFrame(n, n * 4000, 4000, 7, z, np.zeros(120, np.uint8)), schema)


def slower(data, times=8):
    """What a receiver makes of bytes whose bits take so many of its own."""
    bits = [b for byte in data for b in (0, *(byte >> i & 1 for i in range(8)), 1) for _ in range(times)] + [1] * 10
    out, at = bytearray(), 0
    while 0 in bits[at:]:
        at = bits.index(0, at)
        out.append(sum(bit << i for i, bit in enumerate((bits[at + 1 : at + 9] + [1] * 8)[:8])))
        at += 10
    return bytes(out)


NMEA = b"$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,M,55.2,M,,*76\r\n"
# what a device or a network sends -> what is said of it, and what more where it closes the connection
AT_PORTS = {
    "silence": (b"", "", "no answer to HELLO, and nothing else comes"),
    "a plug": (b"\0\xff", "", "no answer to HELLO, and nothing else comes"),
    "low line": (b"\0" * 50, "", "nothing but bytes of 0 or 255"),
    "text": (b"1.50 2.25 [red]\x1b[31m\r\n" * 9, "", 'found text, "1.50 2.25 [red]\\x1b[31m": is it the board'),
    "nmea": (NMEA * 3, "", '(NMEA), which sends "$GPGGA,092750.000,5321.6802,N,00630.3372,W,1,8,1.03,61.7,..."'),
    "echo": (link.encode(link.Hello(schema_hash=link.SCHEMA_HASH)), "", "our own HELLO comes back"),
    "noise": (np.random.default_rng(1).bytes(4000), "", "neither text nor a board's, "),
    "slower": (slower(sent(1)), "", "a line slower than our 921600 baud"),
    "one way": (sent(1) + sent(2), "", "does not answer HELLO: look at the wire"),
    "schema": (sent(1, 0xBAD0F00D) + sent(2, 0xBAD0F00D), "", "frames of schema bad0f00d"),
    "cut": (b"".join(sent(n)[:200] + sent(n)[260:] for n in range(4)), "", "none of them whole"),
    "held": (b"", "socket://h:1", "the connection is taken and nothing is said"),
    "busy": (b"Port already in use\r\n", "socket://h:1", 'busy gateway, which sends "Port already in use", and closes'),
    "busy, after a greeting": (
        b"\xff\xfb\1*** gw ***\r\nport occupied\r\n", "socket://h:1", 'gateway, which sends "port occupied", and closes'
    ),
    "http": (b"HTTP/1.1 503 busy\r\n\r\n", "socket://h:1", "found a web server (HTTP)"),
    "no telnet": ("ready\r\n".encode("utf-16"), "", "neither text nor a board's, "),
    "blank lines": (b"\r\n" * 9, "socket://h:1", 'found text, "\\x0d\\x0a'),
    "telnet": (b"\xff\xfd\x18login: ", "socket://h:1", "found a telnet server"),
}  # fmt: skip


@pytest.mark.parametrize("name", AT_PORTS)
def test_what_is_no_board_is_named_by_what_it_sends(name):
    data, url, says = AT_PORTS[name]
    host = BoardLink(SCANNING, 0.0, OtherEnd(url or "/dev/ttyACM0"))
    for at in range(0, len(data), 900):
        host.received(data[at : at + 900], 0.1)
    host.to_send(1.0)
    assert host.problem == ""
    host.to_send(2.0)
    closed = host.lost("/dev/ttyACM0 is gone")
    assert says in (closed if "closes" in says else host.problem) and host.problem.startswith("no board at ")
    assert f", and {'closes the connection' if url else 'is gone'}: " in closed or len(data) < 3, closed


class Quick(HostTime):
    slept_s = 0.0  # which takes no time

    def now_ns(self):
        return super().now_ns() + round(self.slept_s * 1e9)

    def sleep(self, seconds):
        self.slept_s += seconds


@pytest.mark.live
def test_a_gateway_that_closes_is_heard_out_and_asked_less_and_less_often(skin, bundle):
    with socket.create_server(("127.0.0.1", 0)) as gateway:

        def answer():
            for _ in range(4):
                client, _ = gateway.accept()
                client.sendall(b"Port already in use\r\n")
                client.close()

        threading.Thread(target=answer, daemon=True).start()
        url = f"socket://127.0.0.1:{gateway.getsockname()[1]}"
        source, said, slept_s = BoardSource("palm", skin.model_copy(update={"port": url}), bundle, Quick()), set(), {}
        for _ in source.frames():
            said.add(source.problem)
            slept_s.setdefault(source.counts["disconnects"], source.host.slept_s)
            if source.counts["disconnects"] == 4:
                break
        source.close()
    (one,) = said - {""}
    assert 'found a busy gateway, which sends "Port already in use", and closes the connection' in one
    assert (np.diff(list(slept_s.values()), 2) > 0).all() and slept_s[4] > 2.0


u8, u32, u64, config = *(st.integers(0, 2**bits - 1) for bits in (8, 32, 64)), st.just(SCANNING.config)
lists = (st.integers(1, 512) | st.just(120)).map(lambda n: np.zeros(n, np.uint8))
intact = st.one_of(
    st.builds(link.Nak, of=u8, reason=u8), st.builds(link.Ack, of=u8, value=u32), st.builds(link.Event, code=u8),
    st.builds(link.Ident, link_version=u8, schema_hash=u32 | st.just(link.SCHEMA_HASH), electrodes=u8, max_scan=u8),
    st.builds(lambda z, *more: link.ScanFrame(*more, z.astype(np.complex64), z), lists, u32, u64, u32, u8 | config),
).map(link.encode)  # fmt: skip


@settings(max_examples=120)
@given(st.lists(intact | st.binary(max_size=200), max_size=12), st.booleans())
def test_garbage_and_intact_messages_with_any_fields_do_no_harm(pieces, started):
    """What a board of another make, or a broken one, may say: nothing raises, and a good board is found again."""
    host, board = BoardLink(SCANNING, 0.0), FakeBoard()
    now = talk(host, board, 0.0, 0.2) if started else 0.0
    for piece in pieces:
        for scan in host.received(piece, now):
            middle_us = scan.device_us + scan.duration_us // 2
            assert -(2**63) <= host.clock.host_ns(middle_us) <= round(now * 1e9) and host.clock.sigma_ns(middle_us) > 0
        host.received(board.receive(host.to_send(now)), now)
        now += 0.05
    host.received(b"\0", now)
    now = talk(host, board, now + 2.0, 3.0)
    assert host.state == "running" and len(host.received(board.scan(), now)) == 1


@pytest.mark.live
def test_a_port_of_another_computer_is_opened_by_rfc2217():
    """Through pyserial's own gateway, with a loopback plug for a board."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def gateway():
            client, _ = server.accept()
            plug = serial.serial_for_url("loop://", timeout=0)
            manager = serial.rfc2217.PortManager(plug, SimpleNamespace(write=client.sendall))
            with client, contextlib.suppress(OSError):
                while data := client.recv(1024):
                    plug.write(b"".join(manager.filter(data)))
                    client.sendall(b"".join(manager.escape(plug.read(4096))))

        threading.Thread(target=gateway, daemon=True).start()
        with contextlib.closing(Port(f"rfc2217://127.0.0.1:{server.getsockname()[1]}")) as port:
            port.write(b"hello")
            assert until(lambda: port.read(0.1)) == b"hello"


@pytest.mark.live
def test_a_board_is_read_unplugged_and_found_again_under_another_name(skin, bundle, tmp_path):
    def problem(feed, text):
        until(lambda: any(text in message for message in feed.source.health().messages))

    feed = SourceFeed(open_source("palm", skin.model_copy(update={"port": str(tmp_path / "ttyACM0")}), bundle))
    problem(feed, "is not there")
    board, frame = PtyBoard(tmp_path / "ttyACM0", FakeBoard()), until(feed.recv)
    assert frame.valid and frame.z[0] == 1 + 2j and frame.board == b"0123456789ab".hex()
    assert frame.stamps["sample"] < frame.stamps["read"] <= time.monotonic_ns()
    board.garbage = bytes(range(256)) * 4
    until(lambda: feed.source.counts["line_bad_cobs"] + feed.source.counts["line_bad_crc"])
    board.unplug()
    problem(feed, "cable")
    while feed.recv() is not None:
        pass
    stranger = PtyBoard(tmp_path / "ttyACM1", FakeBoard(unique_id=b"another one!"))
    back = PtyBoard(tmp_path / "ttyACM2", FakeBoard())
    assert until(feed.recv).board == b"0123456789ab".hex()
    feed.source.ending.set()  # the process is on its way out: a board that goes too is no trouble
    stranger.unplug()
    back.unplug()
    feed.close()
    assert feed.source.problem == ""


@pytest.fixture
def taken(skin, bundle, tmp_path):
    """The frames of a file that come before the source has a problem."""

    def take(name):
        source, found = open_source("palm", skin.model_copy(update={"port": str(tmp_path / name)}), bundle), []
        for frame in source.frames():
            found += [frame] if frame is not None else []
            if source.problem:
                break
        return found, source

    return take


def test_a_file_is_a_source_too_and_one_that_cannot_be_read_is_named(tmp_path, taken):
    values, path = np.arange(360, dtype=float).reshape(3, 120) + 1, tmp_path / "x.npz"
    before = [(1.5, "reference"), (121.5, "reference")]
    own = [*before, before[0], (1, "full"), before[1], (121, "full")]
    for arrays, those, reasons in (
        ((values[1:], values[:1], None), [(1, "reference"), (121, "full"), (241, "full")], ["replay"]),
        ((values[:2], None, values[:2] + 0.5), own, ["replay", "separate"]),
    ):
        names = ("measurements", "untouched", "reference")
        np.savez(path, **{k: v for k, v in zip(names, arrays, strict=True) if v is not None})
        frames, source = taken("x.npz")
        assert [(f.z[0].real, f.kind) for f in frames] == those and "has ended" in source.problem
        assert all(f.source == "replay" and f.reasons == reasons for f in frames)
    np.savez(path, measurements=values[:, :64], untouched=values)
    for text in ("shape (3, 64), expected numbers of shape (n, 120)", "is no npz of plain arrays"):
        frames, source = taken("x.npz")
        assert not frames and text in source.problem and str(path) in source.problem, source.problem
        path.write_bytes(b"PK\3\4")


def test_a_recording_is_a_source_of_one_skin_whatever_else_it_holds(tmp_path, taken):
    ones, status = np.ones(120, np.complex64), np.zeros(120, np.uint8)

    def recording(**scans):
        with RecordingWriter(tmp_path / "x.mcap", overwrite=True) as writer:
            for name, those in scans.items():
                for n, scan in enumerate(those):
                    if isinstance(scan, int):
                        stamps = {"sample": 1 + scan * 10**6}
                        raw = RawFrame(skin=name, scan=scan, z=ones, status=status, source="board", stamps=stamps)
                        scan = pack(raw).partition(b"\0")[2]
                    writer.write(f"raw/{name}", scan, n * 10**6)
        frames, source = taken("x.mcap")
        return [(f.skin, f.scan, f.source, f.reasons) for f in frames], source

    found, source = recording(sole=[9], palm=[0, b"no frame", b"\x80", 1])
    assert found == [("palm", 0, "replay", ["replay"]), ("palm", 1, "replay", ["replay"])]
    assert source.counts["malformed"] == 2 and "has ended" in source.problem
    assert recording(sole=[9])[0] == [("palm", 9, "replay", ["replay"])], "the only one serves under any name"
    found, source = recording(sole=[9], heel=[3])
    assert not found and "skins sole, heel, none called palm" in source.problem
