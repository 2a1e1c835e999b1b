"""What the bridge to ROS 2 writes: read back by rosbags, whose definitions are its own."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace as Of
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bridges import views
from bridges.clock import WallClock
from bridges.ros2 import messages, reference
from bridges.ros2.cdr import encode
from bridges.ros2.definitions import TABLE, definition, full_name, nested
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, StatusFrame

STORE = get_typestore(Stores.ROS2_HUMBLE)
HEADER = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "palm"}


def read(message: str, value: dict[str, Any]) -> Any:
    return STORE.deserialize_cdr(encode(message, value), full_name(message))


def contact(number: int, x: float, y: float, force: float, **more: Any) -> Contact:
    wrench = [0.0, 0.0, -force, -y * force, x * force, 0.0]
    at: dict[str, Any] = {"position": [x, y, 0.0], "area_m2": 3e-4, "wrench": wrench, "state": "hold"}
    return Contact(id=number, force_sigma_n=0.1, **{**at, "force_n": force, **more})


def contacts(*found: Contact, reasons: tuple[str, ...] = ()) -> ContactFrame:
    return ContactFrame(skin="palm", valid=True, valid_for_s=0.25, contacts=list(found), reasons=list(reasons))


def test_every_message_is_read_by_others_as_they_define_it() -> None:
    for message in TABLE:
        found = read(message, {})
        assert STORE.serialize_cdr(found, full_name(message)).tobytes() == encode(message, {}), message
        parsed = get_types_from_msg(definition(message), full_name(message))
        assert set(parsed) == {full_name(name) for name in [message, *nested(message)]}
        assert all(fields == STORE.fielddefs[name][1] for name, (_, fields) in parsed.items()), message


def test_the_wrench_is_the_sum_of_those_that_are_there() -> None:
    frame = contacts(contact(1, 0.02, 0, 3.0), contact(2, -0.01, 0.03, 1.0), contact(3, 0, 0, 2.0, state="end"))
    found = read("geometry_msgs/WrenchStamped", messages.wrench(HEADER, views.present(frame)))
    assert (found.header.stamp.sec, found.header.stamp.nanosec, found.header.frame_id) == (5, 7, "palm")
    force, torque = found.wrench.force, found.wrench.torque
    assert (force.x, force.y, force.z, torque.x, torque.y) == pytest.approx((0, 0, -4.0, -0.03, 0.05))
    unknown = contacts(reasons=("uncalibrated_force",)), contacts(contact(1, 0, 0, 0.0, force_n=None))
    assert [views.has_forces(each) for each in (contacts(), frame, *unknown)] == [True, True, False, False]


def test_poses_have_z_along_the_normal_and_markers_end_by_themselves_and_when_the_contact_does() -> None:
    tilted = contact(7, 0.02, 0, 2.0, normal=[0.0, -math.sin(0.3), math.cos(0.3)], orientation=0.4)
    under = contact(2, 0, 0, 1.0, normal=[0.0, 0.0, -1.0])
    poses = read("geometry_msgs/PoseArray", messages.poses(HEADER, contacts(tilted, under))).poses
    q, down = (pose.orientation for pose in poses)
    up = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
    assert up == pytest.approx(tilted.normal, abs=1e-6) and 1 - 2 * (down.x**2 + down.y**2) == pytest.approx(-1)
    along = 1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z)
    assert along[1] / along[0] == pytest.approx(math.tan(0.4) * math.cos(0.3), abs=1e-6)
    found = read("visualization_msgs/MarkerArray", messages.markers(HEADER, contacts(contact(7, 0.02, 0, 2.0)), [3]))
    kinds = ("patch", "force", "label")
    assert {(m.ns, m.id, m.action) for m in found.markers} == {(ns, *at) for ns in kinds for at in ((7, 0), (3, 2))}
    put = {marker.ns: marker for marker in found.markers if marker.action == 0}
    assert all((m.lifetime.sec, m.lifetime.nanosec) == (0, 250_000_000) for m in put.values())
    assert [p.z for p in put["force"].points] == pytest.approx([0.02, 0])  # from outside onto the skin
    assert put["label"].text == "7 2.0 ± 0.1 N unknown"


def test_cloud_and_image_say_the_same() -> None:
    drop = np.zeros((4, 6), "<f4")
    drop[1, 4] = 0.5
    grid: dict[str, Any] = {"skin": "palm", "metres_per_pixel": 0.01, "origin": [-0.03, -0.02]}
    frame, untouched = ImageFrame(**grid, touched=True, image=drop, sigma=drop + 0.1), ImageFrame(**grid)
    cloud, empty = (read("sensor_msgs/PointCloud2", messages.cloud(HEADER, each)) for each in (frame, untouched))
    points, none = (np.frombuffer(each.data.tobytes(), "<f4").reshape(-1, 5) for each in (cloud, empty))
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "drop", "sigma"] and cloud.width == 24
    assert points[points[:, 3].argmax()] == pytest.approx([0.015, -0.005, 0, 0.5, 0.6])
    assert len(none) == 24 and not none[:, 3].any() and np.isnan(none[:, 4]).all() and not empty.is_dense
    image = read("sensor_msgs/Image", messages.image(HEADER, frame))
    pixels = np.frombuffer(image.data.tobytes(), "<f4").reshape(image.height, image.width)
    assert image.encoding == "32FC1" and pixels[4 - 1 - 1, 4] == np.float32(0.5)  # row 0 is the highest y


def test_the_pose_becomes_a_transform_or_nothing_and_a_process_that_says_nothing_more_is_stale() -> None:
    told = {"pose": [0.1, 0.2, 0.3, 0.0, 0.0, 1.0, 0.0], "parent_frame_id": "wrist", "frame_id": "palm"}
    made, *none = (messages.transform(10**9, InfoFrame(skin="palm", info=i)) for i in (told, {**told, "pose": [1]}, {}))
    at = read("tf2_msgs/TFMessage", {"transforms": [made]}).transforms[0]
    assert (at.header.frame_id, at.child_frame_id) == ("wrist", "palm") and none == [None, None]
    assert (at.transform.translation.z, at.transform.rotation.z) == (0.3, 1.0)
    frame = StatusFrame(skin="palm", process="inference", level="WARN", messages=["slow"], valid_for_s=3.0)
    said = [(s["level"], s["message"]) for s in (messages.of_status(frame, age_s) for age_s in (0.5, 9.0))]
    assert said == [(1, "slow"), (3, "no status for 9 s; the last: slow")]


def test_a_wrench_of_the_robot_becomes_the_reference_by_its_own_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Any] = []
    monkeypatch.setattr(reference, "RosReader", lambda *of: Of(take=lambda: taken))
    (palm,) = reference.references({"palm": {"topic": "/ft", "axis": "-z"}}, ["palm"], None, clock := WallClock())  # type: ignore[arg-type]
    now, sent = time.monotonic_ns(), time.monotonic_ns() - 10**8
    rows = [(now - 9 * 10**8 + clock.offset_ns, now - 9 * 10**8), (0, sent), (5 * 10**9, None)]
    for stamp, sample in rows:  # a stamp of 0 is none, one of another clock is never a time
        header = Of(stamp=Of(sec=stamp // 10**9, nanosec=stamp % 10**9))
        info = Of(source_timestamp=sent + clock.offset_ns)
        taken[:] = [Of(wrench=Of(force=Of(x=1.0, y=2.0, z=-2.5)), header=header, sample_info=info)]
        (frame,) = palm.frames()
        assert (frame.force_n, frame.valid, frame.reasons) == (2.5, sample is not None, [] if sample else ["clock"])
        assert frame.stamps["sample"] == sample if sample else frame.stamps["sample"] >= now
