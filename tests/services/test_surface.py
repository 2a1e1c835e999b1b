"""A skin wrapped round a cylinder: where places of its sheet are in space, and that contacts come from there."""

import numpy as np
import pytest

from models.shapes import Shape
from services.contacts.placing import placement
from services.contacts.surface import Cylinder, Plane, rotation
from services.runtime.config import ConfigError, Pose, Skin, Surface
from tests.services.stub_skin import StubSkin

RADIUS = 0.04  # m: a forearm
FLAT = Skin(port="stub", bundle="square16", frame_id="palm", network="none")


@pytest.mark.parametrize(("axis", "x", "y"), [(0.0, 0.0, 0.0), (30.0, 0.03, 0.01), (200.0, -0.035, -0.04)])
def test_the_sheet_lies_on_the_cylinder_and_is_not_stretched(axis, x, y):
    surface = Cylinder(RADIUS, np.radians(axis))
    at, step = surface(x, y), 1e-6
    direction = np.array([np.cos(np.radians(axis)), np.sin(np.radians(axis)), 0.0])
    from_axis = at.point - [0, 0, -RADIUS]
    from_axis -= (from_axis @ direction) * direction
    np.testing.assert_allclose(from_axis / RADIUS, at.normal, atol=1e-12)  # outward
    for along, dx, dy in ((at.along_x, step, 0.0), (at.along_y, 0.0, step)):
        slope = (surface(x + dx, y + dy).point - surface(x - dx, y - dy).point) / (2 * step)
        np.testing.assert_allclose(along, slope, atol=1e-8)
    frame = np.stack([at.along_x, at.along_y, at.normal])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)


def test_a_quarter_of_the_way_round():
    """By hand: at pi/2 times the radius along x, on the side of the arm, looking along x."""
    at = Cylinder(RADIUS, np.pi / 2)(RADIUS * np.pi / 2, 0.02)
    for found, expected in ((at.point, [RADIUS, 0.02, -RADIUS]), (at.normal, [1, 0, 0]), (at.along_x, [0, 0, -1])):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    wide, flat = Cylinder(1e4, 0.7)(0.03, 0.01), Plane()(0.03, 0.01)
    np.testing.assert_allclose(np.r_[wide.point, wide.normal], np.r_[flat.point, flat.normal], atol=1e-5)


def pressed(**fields):
    """The contact of a press on the stub's sheet, and the frame it is given in."""
    stub = StubSkin(80.0, skin=FLAT.model_copy(update=fields))
    frame = [stub.feel((Shape("circle", 0.5, -0.3, 0.25, 0.3),)).contact for _ in range(6)][-1]
    (contact,) = frame.contacts
    (ended,) = [c for _ in range(4) for c in stub.feel(()).contact.contacts if c.state == "end"]
    assert ended.sheet == contact.sheet and ended.normal == contact.normal, "it ends where it was"
    return contact, frame.frame_id


@pytest.mark.parametrize("axis", [90.0, 0.0])
def test_contacts_of_a_wrapped_skin_are_on_the_cylinder(axis):
    contact, frame_id = pressed(surface=Surface(kind="cylinder", radius_m=RADIUS, axis_degrees=axis))
    truth, round_ = Cylinder(RADIUS, np.radians(axis))(0.025, -0.015), 0 if axis == 90.0 else 1
    position, normal = np.array(contact.position), np.array(contact.normal)
    assert np.hypot(position[round_], position[2] + RADIUS) == pytest.approx(RADIUS)
    np.testing.assert_allclose(position, truth.point, atol=2e-3)
    np.testing.assert_allclose(normal, truth.normal, atol=0.05)
    assert frame_id == "palm" and contact.sheet == pytest.approx([0.025, -0.015], abs=2e-3) and contact.force_n > 0
    np.testing.assert_allclose(contact.wrench[:3], -contact.force_n * normal, atol=1e-9)
    np.testing.assert_allclose(contact.wrench[3:], np.cross(position, contact.wrench[:3]), atol=1e-9)


def test_contacts_in_the_links_frame():
    """The forearm's z is its axis: the sheet's y. The sheet's centre is on the arm's x side, half way along."""
    pose = Pose(parent="forearm", position_m=(RADIUS, 0.0, 0.12), quaternion_xyzw=(0.5, 0.5, 0.5, 0.5))
    np.testing.assert_allclose(rotation(pose.quaternion_xyzw)[:, 1:], [[0, 1], [0, 0], [1, 0]], atol=1e-12)
    contact, frame_id = pressed(surface=Surface(kind="cylinder", radius_m=RADIUS), pose=pose, contacts_in="parent")
    x, y, z = contact.position
    assert frame_id == "forearm" and np.hypot(x, y) == pytest.approx(RADIUS)
    assert z == pytest.approx(0.12 - 0.015, abs=2e-3) and np.arctan2(y, x) == pytest.approx(0.025 / RADIUS, abs=0.05)
    np.testing.assert_allclose(contact.normal, [x / RADIUS, y / RADIUS, 0], atol=1e-9)


def test_a_flat_skin_says_what_it_always_did_and_one_that_is_wider_than_the_arm_is_round_is_refused():
    contact, _ = pressed()
    assert contact.position[2] == 0.0 and contact.normal == [0.0, 0.0, 1.0] and contact.sheet is None
    skin = FLAT.model_copy(update={"surface": Surface(kind="cylinder", radius_m=0.01)})
    with pytest.raises(ConfigError, match="reaches 100 mm round a cylinder of 63 mm .* correct radius_m"):
        placement(skin, 0.05 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), "palm")
