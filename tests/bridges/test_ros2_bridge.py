"""The bridge to ROS 2 as a process, heard over DDS: who wants what, what is published; and its service `tare`."""

from __future__ import annotations

import random
import socket
import struct
import time
from pathlib import Path
from typing import Any

import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from bridges.ros2 import dds, rtps
from bridges.ros2.tare_service import TareService
from protocol.sockets import AllReader
from tests.bridges.conftest import FakeService, RunningBridge
from tests.waiting import until

pytestmark = pytest.mark.live

SECTION = 'interface = "lo"\ndomain = {}\nreference.palm = {{ topic = "/ft/wrench", axis = "-z" }}'
PEER, WRITER, OURS = b"\x01\x0f" + bytes(range(10)), b"\x00\x00\x12\x03", struct.pack(">HBB", 0, 1, 0x04)


class Listener:
    def __init__(self, participant: DomainParticipant, name: str, message: str) -> None:
        qos = Qos(
            Policy.Reliability.BestEffort if "PointCloud" in message else Policy.Reliability.Reliable(100_000_000),
            Policy.History.KeepLast(10),
            Policy.Durability.TransientLocal if "static" in name else Policy.Durability.Volatile,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        self.reader: Any = DataReader(participant, Topic(participant, f"rt{name}", dds.idl_type(message)), qos)
        self.heard: list[Any] = []

    def poll(self) -> list[Any]:
        self.heard += self.reader.take(100)
        return self.heard


def test_what_is_wanted_is_published_while_it_is_valid_and_nothing_else_is_subscribed_to(
    runtime: Path, fake: FakeService, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "")
    dds.configure("lo")
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert (dds.domain_id(None), dds.domain_id(7)) == (42, 7)
    participant, bridge = DomainParticipant(domain), RunningBridge("ros2", runtime, SECTION.format(domain))
    assert bridge.status()["idle"] is True and not any(fake.subscribers.values())
    moved = until(Listener(participant, "/tf_static", "tf2_msgs/TFMessage").poll)[0].transforms[0]  # sent long before
    assert (moved.header.frame_id, moved.child_frame_id, moved.transform.translation.x) == ("wrist", "palm", 0.1)
    wrench = Listener(participant, "/eitskin/palm/wrench", "geometry_msgs/WrenchStamped")
    found = until(wrench.poll)[0]
    assert (found.wrench.force.z, found.wrench.torque.y, found.header.frame_id) == (-3.0, 0.06, "palm")
    assert fake.subscribers["contact"] == 1 and not fake.subscribers["image"] and not fake.subscribers["shape"]
    valid = Listener(participant, "/eitskin/palm/valid", "std_msgs/Bool")
    cloud = Listener(participant, "/eitskin/palm/pressure", "sensor_msgs/PointCloud2")
    until(cloud.poll)
    assert until(valid.poll)[-1].data is True
    fake.valid = False
    until(lambda: valid.poll()[-1].data is False)
    said, fake.silent = len(valid.heard), True
    until(lambda: len(valid.poll()) > said + 3)
    assert valid.heard[-1].data is False and "not published" in str(bridge.status()["messages"])
    fake.valid, fake.silent = True, False
    until(lambda: valid.poll()[-1].data is True)
    before = len(wrench.poll()), len(cloud.poll())
    until(lambda: len(wrench.poll()) > before[0] and len(cloud.poll()) > before[1])
    offset = time.time() - time.monotonic()
    bad = [at * 1e-9 + offset for _, at, good in fake.sent if not good]
    for each in (wrench, cloud):
        stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in each.heard]
        assert not [at for at in stamps if min(abs(at - b) for b in bad) < 5e-3]
    reader = AllReader(["reference"], "palm")
    robots = dds.RosWriter(participant, "/ft/wrench", "geometry_msgs/WrenchStamped", "state")
    pressed = until(lambda: (robots.write({"wrench": {"force": {"z": -2.5}}}), reader.recv(0.1))[1])
    assert (pressed.force_n, pressed.valid) == (2.5, True)
    reader.close()
    wrench.reader = valid.reader = cloud.reader = None
    until(lambda: not any(fake.subscribers.values()) and bridge.status()["idle"] is True)
    bridge.close()


def test_a_request_is_carried_out_once_answered_by_its_number_and_nothing_that_arrives_stops_it(domain: int) -> None:
    calls: list[int] = []
    running = TareService(domain, "lo", {"/eitskin/palm": lambda: (calls.append(1) is None, "done")})
    peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    peer.bind(("127.0.0.1", 0))
    peer.settimeout(0.1)
    here, lease = rtps.locator(peer.getsockname()), struct.pack("<iI", 20, 0)
    told = [(rtps.METATRAFFIC_LOCATOR, here), (rtps.DEFAULT_LOCATOR, here), (rtps.LEASE, lease)]

    def say(*subs: bytes) -> None:
        peer.sendto(rtps.message(PEER, subs), ("127.0.0.1", running.port))

    def answer(number: int) -> bytes | None:
        """To a request, where it comes; asked again, as a reliable writer does."""
        say(rtps.data(rtps.SPDP_READER, rtps.SPDP_WRITER, 1, rtps.PL_CDR + rtps.parameter_list(told)))
        say(rtps.data(OURS, WRITER, number, b"\0\1\0\0\0\0\0\0"))
        try:
            found = [rtps.read_data(each) for each in rtps.parse(peer.recv(65536))[1] if each.kind == rtps.DATA]
        except TimeoutError:
            return None
        of = {got.inline[rtps.RELATED_OF_FAST_DDS][0][:24]: got.payload for got in found if got.writer[3] == 0x03}
        return of.get(PEER + WRITER + rtps.number_bytes(number))

    say(rtps.data(OURS, WRITER, 1, b"\0\1\0\0\0\0\0\0"))  # from nobody that we know
    first = until(lambda: answer(7))
    assert first is not None and first[4:5] == b"\1" and rtps.read_text(first[8:]) == "done"
    for _ in range(500):
        kind = random.choice([rtps.ACKNACK, rtps.HEARTBEAT, rtps.GAP, rtps.INFO_DST, rtps.DATA, 0x16, 0x99])
        say(rtps.sub(kind, random.randbytes(random.randrange(64)), random.randrange(256)))
    assert len(calls) == 1, "the request was sent again, and not carried out again"
    until(lambda: answer(9))
    assert len(calls) == 2
    running.close()
