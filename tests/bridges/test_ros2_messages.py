"""What the ROS node publishes, made with the message types of rosbags, eitskin_msgs by its .msg files; needs no ROS."""

from __future__ import annotations

import math
import re
from functools import partial
from typing import Any

import numpy as np
import pytest

from bridges.export.to_ros2 import DEFINITIONS, _message, typestore
from bridges.ros2.eitskin_ros.eitskin_ros import messages
from protocol.frames import Contact, ContactFrame, ImageFrame, StatusFrame
from services.contacts.surface import Cylinder
from tests.bridges.conftest import PLACED
from tests.test_architecture import of

STORE = typestore()
ROS = messages.message_types(lambda of, name: partial(_message, STORE, f"{of}/msg/{name}"))
HEAD = messages.header(ROS, 5_000_000_007, "palm")


def read(message: Any) -> Any:
    """As a subscriber gets it."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, message.__msgtype__), message.__msgtype__)


def contact(number: int, x: float, y: float, force: float | None, **more: Any) -> Contact:
    wrench = [0.0, 0.0, -(force or 0), -y * (force or 0), x * (force or 0), 0.0]
    return Contact(id=number, position=[x, y, 0.0], area_m2=3e-4, wrench=wrench, force_n=force, **more)


def contacts(*found: Contact, valid: bool = True) -> ContactFrame:
    return ContactFrame(skin="palm", valid=valid, valid_for_s=0.25, contacts=list(found), reasons=["gap"])


def test_the_definitions_are_documented_and_depend_on_what_their_package_names() -> None:
    cmake = (DEFINITIONS.parent / "CMakeLists.txt").read_text()
    package = (DEFINITIONS.parent / "package.xml").read_text()
    assert {file.stem for file in DEFINITIONS.glob("*.msg")} == set(messages.TYPES["eitskin_msgs"].split())
    for file in DEFINITIONS.glob("*.msg"):
        text = file.read_text()
        assert f'"msg/{file.name}"' in cmake and text.startswith("# ")
        assert all(part.startswith("# ") for part in text.split("\n\n")), f"a field of {file.name} says nothing"
        for name in set(re.findall(r"^(\w+)/", text, re.MULTILINE)):
            assert f"find_package({name} REQUIRED)" in cmake and f"<depend>{name}</depend>" in package


def test_the_node_s_package_names_what_it_imports() -> None:
    package = (DEFINITIONS.parents[1] / "eitskin_ros" / "package.xml").read_text()
    needs = set(re.findall(r"<exec_depend>(\w+)</exec_depend>", package))
    imported = {name for each in of("bridges.ros2").values() for name in each.outside()}
    assert needs == imported - {"eitskin", "eitskin_ros", "numpy", "setuptools", "zmq"} | messages.TYPES.keys()


def test_contacts_carry_all_that_is_known_and_nothing_where_they_are_not_valid() -> None:
    tilted = contact(
        2**63,
        0.02,
        0.01,
        2.0,
        state="begin",
        normal=[0.0, -math.sin(0.3), math.cos(0.3)],
        orientation=0.4,
        position_sigma=[0.002, 0.001, 0.5],
        force_sigma_n=0.1,
        pressure_pa=5e3,
        velocity=[0.1, 0.0, 0.0],
    )
    frame = contacts(tilted, contact(3, 0, 0, None), contact(4, 0, 0, 1.0, state="end"))
    found = read(messages.contacts(ROS, HEAD, frame))
    assert (found.header.stamp.sec, found.header.stamp.nanosec, found.header.frame_id) == (5, 7, "palm")
    assert (found.valid, found.reasons, list(found.ended)) == (True, ["gap"], [4])
    first, second = found.contacts
    assert (first.id, first.state, second.state) == (2**63, messages.BEGIN, messages.HOLD)
    assert (first.force, first.force_sigma, first.peak_pressure, first.velocity.x) == (2.0, 0.1, 5e3, 0.1)
    assert (first.wrench.force.z, first.wrench.torque.x, first.wrench.torque.y) == (-2.0, -0.02, 0.04)
    assert math.isnan(second.force) and math.isnan(second.peak_pressure) and second.pose.covariance[0] == -1
    q = first.pose.pose.orientation
    up = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
    assert up == pytest.approx(tilted.normal, abs=1e-9)
    spread = first.pose.covariance.reshape(6, 6)
    sigmas, axes = np.linalg.eigh(spread[:3, :3])
    assert sigmas == pytest.approx([0, 0.001**2, 0.002**2], abs=1e-12) and not spread[3:].any()
    assert abs(axes[:, 0] @ tilted.normal) == pytest.approx(1)
    along = [math.cos(0.5), math.sin(0.5) * math.cos(0.3), math.sin(0.5) * math.sin(0.3)]
    assert abs(axes[:, 2] @ along) == pytest.approx(1)
    refused = read(messages.contacts(ROS, HEAD, contacts(tilted, valid=False)))
    assert (refused.valid, refused.contacts, refused.reasons) == (False, [], ["gap"])


def test_markers_delete_what_was_there_before_and_end_by_themselves() -> None:
    found = read(messages.markers(ROS, HEAD, contacts(contact(7, 0.02, 0, 2.0, force_sigma_n=0.1)))).markers
    assert [(m.action, m.ns, m.id) for m in found] == [(3, "", 0), *((0, ns, 7) for ns in ("patch", "force", "label"))]
    assert all((m.lifetime.sec, m.lifetime.nanosec) == (0, 250_000_000) for m in found[1:])
    assert [p.z for p in found[2].points] == pytest.approx([0.02, 0])  # from outside onto the skin
    assert found[3].text == "7 2.0 ± 0.1 N unknown"
    assert [m.action for m in read(messages.markers(ROS, HEAD, None)).markers] == [3]


def test_cloud_and_image_say_the_same() -> None:
    drop = np.zeros((4, 6), "<f4")
    drop[1, 4] = 0.5
    grid: dict[str, Any] = {"skin": "palm", "metres_per_pixel": 0.01, "origin": [-0.03, -0.02]}
    frame, untouched = ImageFrame(**grid, touched=True, image=drop, sigma=drop + 0.1), ImageFrame(**grid)
    cloud, empty = (read(messages.conductivity_drop(ROS, HEAD, each, None)) for each in (frame, untouched))
    points, none = (np.frombuffer(each.data.tobytes(), "<f4").reshape(-1, 5) for each in (cloud, empty))
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "conductivity_drop", "sigma"] and cloud.width == 24
    assert points[points[:, 3].argmax()] == pytest.approx([0.015, -0.005, 0, 0.5, 0.6])
    assert len(none) == 24 and not none[:, 3].any() and np.isnan(none[:, 4]).all() and not empty.is_dense
    wrapped: dict[str, Any] = {"kind": "cylinder", "radius_m": 0.03, "axis_degrees": 20.0}
    bent = read(messages.conductivity_drop(ROS, HEAD, frame, wrapped))
    places = np.frombuffer(bent.data.tobytes(), "<f4").reshape(-1, 5)[:, :3]
    on = Cylinder(0.03, math.radians(20.0))
    assert places == pytest.approx(np.array([on(*p).point for p in points[:, :2].astype(float)]), abs=1e-7)
    image = read(messages.image(ROS, HEAD, frame))
    pixels = np.frombuffer(image.data.tobytes(), "<f4").reshape(image.height, image.width)
    assert image.encoding == "32FC1" and pixels[4 - 1 - 1, 4] == np.float32(0.5)  # row 0 is the highest y


def test_a_pose_becomes_a_transform_or_nothing_a_silent_process_is_stale_and_names_are_those_of_ros() -> None:
    made, *none = (messages.transform(ROS, 10**9, info) for info in (PLACED, {**PLACED, "pose": [1]}, {}))
    at = read(made).transforms[0]
    assert (at.header.frame_id, at.child_frame_id, at.transform.translation.x) == ("wrist", "palm", 0.1)
    assert none == [None, None]
    frame = StatusFrame(skin="palm", process="inference", level="WARN", messages=["slow"], valid_for_s=3.0)
    said = [read(messages.of_process(ROS, frame, age_s)) for age_s in (0.5, 9.0)]
    assert [(s.level, s.message) for s in said] == [(1, "slow"), (3, "no status for 9 s; the last: slow")]
    electrodes = [read(messages.of_electrodes(ROS, "palm", states)) for states in (["ok", "open"], ["ok"], [])]
    assert [(s.level, s.message) for s in electrodes] == [(1, "1 open"), (0, "all ok"), (3, "not known")]
    assert [messages.ros_name(name) for name in ("palm", "left-arm", "2nd")] == ["palm", "left_arm", "_2nd"]
