"""The RTPS of the service `tare`: what is written is read back, what is none is dropped, and no bytes stop it.

That a genuine ROS 2 client gets its answer is in test_ros2_node.py.
"""

from __future__ import annotations

import random
import socket
import struct
import time
from collections.abc import Iterator

import pytest

from bridges.ros2 import rtps
from bridges.ros2.tare_service import TareService

pytestmark = pytest.mark.live

PEER = b"\x01\x0f" + bytes(range(10))
WRITER, READER = b"\x00\x00\x12\x03", b"\x00\x01\x04"
OURS = struct.pack(">HBB", 0, 1, 0x04)


def test_what_is_written_is_read_back() -> None:
    inline = rtps.parameter_list([(rtps.RELATED, b"x" * 24)])
    said = rtps.message(PEER, [rtps.data(OURS, WRITER, (3 << 32) + 7, b"\0\1\0\0body", inline)], bytes(12))
    prefix, subs = rtps.parse(said)
    _, found = list(subs)
    arrived = rtps.read_data(found)
    assert prefix == PEER and (arrived.reader, arrived.writer, arrived.number) == (OURS, WRITER, (3 << 32) + 7)
    assert arrived.inline == {rtps.RELATED: [b"x" * 24]} and arrived.payload == b"\0\1\0\0body"
    for missing in ([], [5], [5, 36, 99]):
        ack = rtps.acknack(OURS, WRITER, 5, missing, 1)
        (found,) = rtps.parse(rtps.message(PEER, [ack]))[1]
        assert rtps.number_set(found.body, 8) == (5, missing)
    assert rtps.addresses([rtps.locator(("127.0.0.1", 7411)), b"\x10" + bytes(23), b"short"]) == [("127.0.0.1", 7411)]
    assert rtps.read_text(rtps.text("rr/eitskin")) == "rr/eitskin"


def test_bytes_that_are_none_are_refused_by_name_and_by_nothing_else() -> None:
    random.seed(5)
    good = rtps.message(PEER, [rtps.data(OURS, WRITER, 1, b"\0\3\0\0" + rtps.parameter_list([(5, b"abcd")]))], PEER)
    for _ in range(3000):
        bad = bytearray(good)
        for _ in range(random.randint(1, 4)):
            bad[random.randrange(len(bad))] = random.randrange(256)
        del bad[random.randrange(20, len(bad) + 1) :]
        try:
            for each in rtps.parse(bytes(bad))[1]:
                if each.kind == rtps.DATA:
                    arrived = rtps.read_data(each)
                    rtps.parameters(arrived.payload, 4)
                rtps.number_set(each.body, 8)
        except (rtps.Malformed, struct.error):
            pass


class Client:
    """As much of a ROS client as asks one thing of the service."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.2)
        self._to = ("127.0.0.1", port)

    def say(self, *subs: bytes) -> None:
        self.socket.sendto(rtps.message(PEER, subs), self._to)

    def announce(self) -> None:
        here = rtps.locator(self.socket.getsockname())
        told = [(rtps.METATRAFFIC_LOCATOR, here), (rtps.DEFAULT_LOCATOR, here), (rtps.LEASE, struct.pack("<iI", 20, 0))]
        payload = rtps.PL_CDR + rtps.parameter_list(told)
        self.say(rtps.data(rtps.SPDP_READER, rtps.SPDP_WRITER, 1, payload))

    def ask(self, number: int) -> None:
        self.say(rtps.data(OURS, WRITER, number, b"\0\1\0\0\0\0\0\0"))

    def replies(self, seconds: float) -> dict[int, bytes]:
        """Number of the request -> answer."""
        found, end = {}, time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                raw = self.socket.recv(65536)
            except TimeoutError:
                continue
            for each in rtps.parse(raw)[1]:
                if each.kind == rtps.DATA and (got := rtps.read_data(each)).writer[3] == 0x03:
                    (identity,) = got.inline[rtps.RELATED_OF_FAST_DDS]
                    assert identity[:16] == PEER + WRITER
                    found[rtps.number_at(identity, 16)] = got.payload
            if found:
                break
        return found


@pytest.fixture
def service() -> Iterator[tuple[TareService, list[float]]]:
    calls: list[float] = []
    made = TareService(131, "lo", {"/eitskin/palm": lambda: (bool(calls.append(time.time())) or True, "done")})
    try:
        yield made, calls
    finally:
        made.close()


def test_a_request_is_carried_out_once_and_answered_by_its_number(service: tuple[TareService, list[float]]) -> None:
    running, calls = service
    client = Client(running.port)
    client.ask(1)  # from nobody that we know
    assert client.replies(0.5) == {} and not calls
    client.announce()
    client.ask(7)
    (answer,) = client.replies(10.0).values()
    assert answer[4:5] == b"\1" and rtps.read_text(answer[8:]) == "done" and len(calls) == 1
    for _ in range(3):
        client.ask(7)  # sent again, as a reliable writer does
    client.replies(0.5)
    assert len(calls) == 1
    client.ask(8)
    assert 8 in client.replies(10.0) and len(calls) == 2


def test_nothing_that_arrives_stops_it(service: tuple[TareService, list[float]]) -> None:
    running, calls = service
    client = Client(running.port)
    client.announce()
    random.seed(6)
    huge = rtps.heartbeat(OURS, WRITER, 1, (1 << 62), 1)
    client.say(huge, rtps.heartbeat(OURS, WRITER, -(1 << 62), 1 << 62, 2))
    client.say(rtps.sub(rtps.GAP, OURS + WRITER + rtps.number_bytes(1) + rtps.number_bytes(1 << 60) + bytes(4)))
    for _ in range(500):
        kind = random.choice([rtps.ACKNACK, rtps.HEARTBEAT, rtps.GAP, rtps.INFO_DST, rtps.DATA, 0x16, 0x99])
        client.say(rtps.sub(kind, random.randbytes(random.randrange(64)), random.randrange(256)))
        client.socket.sendto(random.randbytes(random.randrange(200)), ("127.0.0.1", running.port))
    for _ in range(20):  # a datagram may be lost behind so many others: a client sends its request again
        client.announce()
        client.ask(5)
        if 5 in client.replies(1.0):
            break
    assert len(calls) == 1
