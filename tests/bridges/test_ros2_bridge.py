"""The bridge to ROS 2 as a process, heard over DDS: who wants what, what is published and what is not."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from bridges.process import INTERRUPTED, Bridge, BridgeError, Handed, main
from bridges.ros2 import dds
from protocol.frames import ReferenceFrame
from protocol.sockets import AllReader
from tests.bridges.conftest import FakeService, RunningBridge

pytestmark = pytest.mark.live

DOMAIN = 120 + os.getpid() % 80


class Listener:
    """Reads one topic as ROS would."""

    participant: DomainParticipant | None = None

    def __init__(self, name: str, message: str, latched: bool = False, best_effort: bool = False) -> None:
        if Listener.participant is None:
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("CYCLONEDDS_URI", "")
                dds.configure("lo")
                Listener.participant = DomainParticipant(DOMAIN)
        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        qos = Qos(
            Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(100_000_000),
            Policy.History.KeepLast(10),
            durability,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        topic: Topic[Any] = Topic(Listener.participant, f"rt{name}", dds.idl_type(message))
        self._reader: DataReader[Any] = DataReader(Listener.participant, topic, qos)
        self.heard: list[Any] = []

    def poll(self) -> list[Any]:
        self.heard += self._reader.take(100)
        return self.heard

    def close(self) -> None:
        del self._reader


def wait_for(what: Callable[[], object]) -> None:
    end = time.monotonic() + 40
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


@pytest.fixture
def bridge(runtime: Path, fake: FakeService) -> Iterator[RunningBridge]:
    running = RunningBridge("ros2", runtime, f'interface = "lo"\ndomain = {DOMAIN}')
    try:
        running.status()
        yield running
    finally:
        running.close()


def test_only_what_is_wanted_is_subscribed_to(fake: FakeService, bridge: RunningBridge) -> None:
    time.sleep(0.5)
    assert bridge.status()["idle"] is True and not any(fake.subscribers.values())
    wrench = Listener("/eitskin/palm/wrench", "geometry_msgs/WrenchStamped")
    wait_for(wrench.poll)
    found = wrench.heard[0]
    assert (found.wrench.force.z, found.wrench.torque.y, found.header.frame_id) == (-3.0, 0.06, "palm")
    assert fake.subscribers["contact"] == 1 and not fake.subscribers["image"] and not fake.subscribers["shape"]
    status = bridge.status()
    assert status["flowing"] is True and status["idle"] is False
    wrench.close()
    wait_for(lambda: not any(fake.subscribers.values()))
    assert bridge.status()["idle"] is True


def test_what_is_not_valid_is_not_published_and_valid_says_so(fake: FakeService, bridge: RunningBridge) -> None:
    wrench = Listener("/eitskin/palm/wrench", "geometry_msgs/WrenchStamped")
    valid = Listener("/eitskin/palm/valid", "std_msgs/Bool")
    cloud = Listener("/eitskin/palm/pressure", "sensor_msgs/PointCloud2", best_effort=True)
    for each in (wrench, valid, cloud):
        wait_for(each.poll)
    assert valid.heard[-1].data is True
    fake.valid = False
    wait_for(lambda: valid.poll()[-1].data is False)
    time.sleep(0.5)
    for each in (wrench, valid, cloud):
        each.poll()
    offset = time.time() - time.monotonic()
    sampled = {scan: (at * 1e-9 + offset, good) for scan, at, good in fake.sent}
    first_bad = min(at for at, good in sampled.values() if not good)
    for each in (wrench, cloud):
        stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in each.heard]
        assert max(stamps) < first_bad - 0.01
    said = len(valid.heard)
    fake.silent = True
    wait_for(lambda: len(valid.poll()) > said + 3)
    assert valid.heard[-1].data is False and "not published" in str(bridge.status()["messages"])
    fake.valid, fake.silent = True, False
    wait_for(lambda: valid.poll()[-1].data is True)
    before = len(wrench.poll())
    wait_for(lambda: len(wrench.poll()) > before)
    for each in (wrench, valid, cloud):
        each.close()


def test_a_wrench_of_the_robot_becomes_the_reference_of_the_skin(runtime: Path, fake: FakeService) -> None:
    """By its own stamps; a stamp of another clock is never a time."""
    section = f'interface = "lo"\ndomain = {DOMAIN}\nreference.palm = {{ topic = "/ft/wrench", axis = "-z" }}'
    running = RunningBridge("ros2", runtime, section)
    reader = AllReader(["reference"], "palm")
    try:
        running.status()
        Listener("/somewhere", "std_msgs/Bool").close()  # there is a participant
        assert Listener.participant is not None
        sensor = dds.RosWriter(Listener.participant, "/ft/wrench", "geometry_msgs/WrenchStamped", "state")
        wait_for(lambda: sensor.wanted)

        def heard(stamp_ns: int) -> ReferenceFrame:
            header = {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": "ft"}
            while reader.recv(0.3) is not None:  # what was sent before
                pass
            for _ in range(50):  # best effort: what comes before the two have found each other is lost
                sensor.write({"header": header, "wrench": {"force": {"x": 1.0, "y": 2.0, "z": -2.5}}})
                frame = reader.recv(0.4)
                if isinstance(frame, ReferenceFrame):
                    assert frame.force_n == 2.5
                    return frame
            raise AssertionError(f"no reference came: {running.said()}")

        measured = time.monotonic_ns() - 40_000_000
        stamped = heard(measured + time.time_ns() - time.monotonic_ns())
        assert stamped.valid and stamped.stamps["sample"] == pytest.approx(measured, abs=2_000_000)
        unstamped = heard(0)
        assert unstamped.valid and 0 < time.monotonic_ns() - unstamped.stamps["sample"] < 5e9
        simulated = heard(5 * 10**9)
        assert not simulated.valid and simulated.reasons == ["clock"]
    finally:
        reader.close()
        running.close()


def test_the_pose_is_there_for_who_comes_late(bridge: RunningBridge) -> None:
    time.sleep(1.0)
    place = Listener("/tf_static", "tf2_msgs/TFMessage", latched=True)
    wait_for(place.poll)
    moved = place.heard[0].transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id, moved.transform.translation.x) == ("wrist", "palm", 0.1)
    place.close()


def test_settings_that_are_none_are_refused_in_a_line() -> None:
    for text in ("", "{", "[]", '{"skins": {}}', "nonsense"):
        with pytest.raises(BridgeError, match="skin bridge NAME"):
            Handed.read(text)


def test_a_domain_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID is 'many', expected a number from 0 to 232"):
        dds.domain_id(None)
    assert dds.domain_id(7) == 7
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert dds.domain_id(None) == 42


def test_what_the_user_says_of_cyclone_comes_after_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "<General/>")
    dds.configure("")
    ours, theirs = os.environ["CYCLONEDDS_URI"].split(",")
    assert "IgnoreTypeInformation" in ours and "Interfaces" not in ours and theirs == "<General/>"
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    dds.configure("")
    assert "NetworkInterface" not in os.environ["CYCLONEDDS_URI"]
    monkeypatch.setenv("CYCLONEDDS_URI", "")
    dds.configure("")
    assert 'NetworkInterface name="lo"' in os.environ["CYCLONEDDS_URI"]


def test_ctrl_c_while_it_is_being_made_ends_it_without_a_word(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(handed: Handed) -> Bridge:
        raise KeyboardInterrupt

    reach = {"addresses": {}, "secret_key": None, "server_keys": {}, "clients": None, "operators": None}
    told = {"skins": {}, "transport": {**reach, "insecure": False}, "options": {}, "log_level": "info"}
    monkeypatch.setenv("EITSKIN_BRIDGE", json.dumps(told))
    assert main("ros2", make) == INTERRUPTED and capsys.readouterr().err == ""
