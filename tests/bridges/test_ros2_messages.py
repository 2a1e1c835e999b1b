"""What the bridge to ROS 2 writes: read back by rosbags, whose definitions are its own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bridges import views
from bridges.clock import WallClock
from bridges.ros2 import messages
from bridges.ros2.cdr import encode
from bridges.ros2.definitions import TABLE, definition, full_name, nested
from bridges.ros2.names import topic_base
from protocol.frames import Contact, ContactFrame, ImageFrame, InfoFrame, StatusFrame

STORE = get_typestore(Stores.ROS2_HUMBLE)
HEADER = {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "palm"}


def read(message: str, value: dict[str, Any]) -> Any:
    return STORE.deserialize_cdr(encode(message, value), full_name(message))


def contact(number: int, x: float, y: float, force: float | None, state: str = "hold") -> Contact:
    fz = -(force or 0.0)
    return Contact(
        id=number,
        state=state,
        position=[x, y, 0.0],
        area_m2=3e-4,
        force_n=force,
        force_sigma_n=0.1,
        wrench=[0.0, 0.0, fz, y * fz, -x * fz, 0.0],
    )


def contacts(*found: Contact, reasons: tuple[str, ...] = ()) -> ContactFrame:
    return ContactFrame(skin="palm", valid=True, valid_for_s=0.25, contacts=list(found), reasons=list(reasons))


@pytest.mark.parametrize("message", TABLE)
def test_an_empty_message_reads_as_ros_defaults(message: str) -> None:
    """Every field at its place: an independent reader takes all bytes, and finds zeros, "" and w = 1."""
    told = STORE.types.get(full_name(message))
    assert told is not None, f"rosbags knows no {message}"
    found = read(message, {})
    assert STORE.serialize_cdr(found, full_name(message)).tobytes() == encode(message, {})


@pytest.mark.parametrize("message", TABLE)
def test_the_definition_is_the_one_that_others_have(message: str) -> None:
    """`ros2msg` text of ours, parsed by rosbags, gives the fields that rosbags has itself."""
    from rosbags.typesys import get_types_from_msg

    parsed = get_types_from_msg(definition(message), full_name(message))
    assert set(parsed) == {full_name(name) for name in [message, *nested(message)]}
    for name, (_, fields) in parsed.items():
        assert fields == STORE.fielddefs[name][1], name


def test_a_field_that_a_message_has_not_is_refused() -> None:
    with pytest.raises(KeyError, match="geometry_msgs/Vector3 has no field w"):
        encode("geometry_msgs/WrenchStamped", {"wrench": {"force": {"x": 1.0, "w": 2.0}}})


def test_the_wrench_is_the_sum_of_those_that_are_there() -> None:
    frame = contacts(contact(1, 0.02, 0.0, 3.0), contact(2, -0.01, 0.03, 1.0), contact(3, 0, 0, 2.0, state="end"))
    found = read("geometry_msgs/WrenchStamped", messages.wrench(HEADER, views.present(frame)))
    assert (found.header.stamp.sec, found.header.stamp.nanosec, found.header.frame_id) == (5, 7, "palm")
    force, torque = found.wrench.force, found.wrench.torque
    assert (force.x, force.y, force.z) == (0, 0, -4.0)
    assert torque.x == pytest.approx(-0.03) and torque.y == pytest.approx(0.06 - 0.01)
    nothing = read("geometry_msgs/WrenchStamped", messages.wrench(HEADER, []))
    assert (nothing.wrench.force.z, nothing.wrench.torque.x) == (0.0, 0.0)


def test_a_skin_without_a_force_law_has_no_wrench() -> None:
    assert views.has_forces(contacts())
    assert views.has_forces(contacts(contact(1, 0, 0, 2.0)))
    assert not views.has_forces(contacts(reasons=("uncalibrated_force",)))
    assert not views.has_forces(contacts(contact(1, 0, 0, None)))


def test_poses_have_z_along_the_normal_and_x_along_the_patch() -> None:
    tilted = contact(1, 0.01, 0.02, 1.0)
    tilted.normal, tilted.orientation = [0.0, -math.sin(0.3), math.cos(0.3)], 0.4
    under = contact(2, 0, 0, 1.0)
    under.normal = [0.0, 0.0, -1.0]
    found = read("geometry_msgs/PoseArray", messages.poses(HEADER, contacts(tilted, under))).poses
    for pose, each in zip(found, (tilted, under), strict=True):
        q = pose.orientation
        x, y, z, w = q.x, q.y, q.z, q.w
        assert x * x + y * y + z * z + w * w == pytest.approx(1)
        up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        assert up == pytest.approx(each.normal, abs=1e-6)
    q = found[0].orientation
    along = np.array([1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)])
    assert along[:2] / along[0] == pytest.approx([1, math.tan(0.4) * math.cos(0.3)], abs=1e-6)


def test_markers_end_by_themselves_and_when_the_contact_does() -> None:
    found = read("visualization_msgs/MarkerArray", messages.markers(HEADER, contacts(contact(7, 0.02, 0, 2.0)), [3]))
    put = [marker for marker in found.markers if marker.action == 0]
    gone = [marker for marker in found.markers if marker.action == 2]
    assert {marker.ns for marker in put} == {marker.ns for marker in gone} == {"patch", "force", "label"}
    assert {marker.id for marker in put} == {7} and {marker.id for marker in gone} == {3}
    assert all(m.lifetime.sec == 0 and m.lifetime.nanosec == 250_000_000 for m in put)
    arrow = next(marker for marker in put if marker.ns == "force")
    assert arrow.points[0].z == pytest.approx(0.02) and arrow.points[1].z == 0  # from outside onto the skin
    assert next(marker for marker in put if marker.ns == "label").text == "7 2.0 ± 0.1 N unknown"
    hard = replace(contact(7, 0.02, 0, 2.0), pressure_pa=6400.0, pressure_sigma_pa=900.0)
    found = read("visualization_msgs/MarkerArray", messages.markers(HEADER, contacts(hard), []))
    assert next(m for m in found.markers if m.ns == "label").text == "7 2.0 ± 0.1 N 6.4 ± 0.9 kPa unknown"


def test_cloud_and_image_say_the_same() -> None:
    drop = np.zeros((4, 6), "<f4")
    drop[1, 4] = 0.5
    frame = ImageFrame(
        skin="palm", touched=True, image=drop, sigma=drop + 0.1, metres_per_pixel=0.01, origin=[-0.03, -0.02]
    )
    cloud = read("sensor_msgs/PointCloud2", messages.cloud(HEADER, frame))
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 5)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "drop", "sigma"] and cloud.width == 24
    assert points[points[:, 3].argmax()] == pytest.approx([0.015, -0.005, 0, 0.5, 0.6])
    image = read("sensor_msgs/Image", messages.image(HEADER, frame))
    pixels = np.frombuffer(image.data.tobytes(), "<f4").reshape(image.height, image.width)
    assert image.encoding == "32FC1" and pixels[4 - 1 - 1, 4] == np.float32(0.5)  # row 0 is the highest y


def test_an_untouched_image_is_of_zeros_whose_uncertainty_is_not_known() -> None:
    frame = ImageFrame(skin="palm", metres_per_pixel=0.01, origin=[-0.03, -0.02])
    cloud = read("sensor_msgs/PointCloud2", messages.cloud(HEADER, frame))
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 5)
    assert len(points) == 6 * 4 and not points[:, 3].any() and np.isnan(points[:, 4]).all() and not cloud.is_dense


def test_the_pose_becomes_a_transform_or_nothing() -> None:
    told = {"pose": [0.1, 0.2, 0.3, 0.0, 0.0, 1.0, 0.0], "parent_frame_id": "wrist", "frame_id": "palm"}
    found = messages.transform(1_000_000_000, InfoFrame(skin="palm", info=told))
    assert found is not None
    read_back = read("tf2_msgs/TFMessage", {"transforms": [found]}).transforms[0]
    assert (read_back.header.frame_id, read_back.child_frame_id) == ("wrist", "palm")
    assert read_back.transform.translation.z == 0.3 and read_back.transform.rotation.z == 1.0
    for wrong in ({**told, "pose": [1, 2]}, {**told, "pose": None}, {**told, "frame_id": ""}, {}):
        assert messages.transform(1_000_000_000, InfoFrame(skin="palm", info=wrong)) is None


def test_a_process_that_says_nothing_more_is_stale() -> None:
    frame = StatusFrame(skin="palm", process="inference", level="WARN", messages=["slow"], valid_for_s=3.0)
    fresh, old = messages.of_status(frame, 0.5), messages.of_status(frame, 9.0)
    assert (fresh["level"], fresh["message"]) == (1, "slow")
    assert (old["level"], old["message"]) == (3, "no status for 9 s; the last: slow")


def test_ros_time_follows_the_systems_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic_ns", lambda: 5_000)
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000_000_000_000)
    clock = WallClock()
    assert clock.time_ns(2_000_005_000) == 1_700_000_002_000_000_000
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_010_000_000_000)
    clock.measure()
    assert clock.time_ns(2_000_005_000) == 1_700_000_012_000_000_000 and clock.steps == 1


@pytest.mark.parametrize(
    ("skin", "base"), [("palm", "/eitskin/palm"), ("left-hand", "/eitskin/left_hand"), ("3", "/eitskin/_3")]
)
def test_names_are_those_that_ros_allows(skin: str, base: str) -> None:
    assert topic_base(skin) == base
