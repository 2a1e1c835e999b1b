"""Skins without a model or network of their own: measured, registered, of other outlines, round a cylinder."""

import numpy as np
import pytest

from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from models import bundle, geometry, manifest
from models.bundle import Bundle
from models.forward import ForwardModel
from models.linearise import linearise
from models.shapes import Shape
from services.calibration.fields import half_width, sample, sensitivities
from services.calibration.register_command import register_presses
from services.contacts.surface import Cylinder, Plane, placement, rotation
from services.pipeline import Pipeline
from services.runtime.config import ConfigError, Pose, Skin, Surface
from tests.services.curves import stages_of
from tests.services.stub_skin import StubSkin, present, whole_scan

NOISE = 1e-4
FORCE_N = 3.0  # of a press of strength 1


class MeasuredSkin:
    """A disc of hydrogel: its measurements answer to presses as the bundle says, each by a gain of its own."""

    def __init__(self):
        self.rng = np.random.default_rng(4)
        bundle = Bundle.load("disc16")
        self.reach, self.sensitivities = half_width(bundle), sensitivities(bundle, 1.5)
        self.gains = self.rng.uniform(0.7, 1.4, len(bundle.pattern))
        self.gains *= 0.02 / np.abs(self.at((0.0, 0.0))).mean()
        self.z0 = self.rng.uniform(100, 200, len(bundle.pattern))

    def at(self, place, strength=1.0):
        """(K,) relative change by a press at a place [m]."""
        return np.asarray(strength * self.gains * sample(self.sensitivities, np.array([place]), self.reach)[0])

    def registered(self, folder):
        radius, angle = 0.8 * self.reach * np.sqrt(self.rng.uniform(0, 1, 60)), self.rng.uniform(0, 2 * np.pi, 60)
        xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
        strength = self.rng.uniform(0.5, 1.5, len(xy))
        untouched = self.z0 * (1 + 1e-3 * self.rng.standard_normal((len(xy), len(self.z0))))
        change = np.array([self.at((x, y), s) for (x, y), s in zip(xy, strength, strict=True)])
        presses = {"untouched": untouched, "touched": untouched * (1 + change), "xy": xy, "force": FORCE_N * strength}
        register_presses(presses, "disc16", len(xy), folder)
        return folder


class Felt:
    """Its frames, through the stages."""

    def __init__(self, skin, bundle):
        config = Skin(port="stub", bundle=str(bundle), frame_id="skin")
        self.skin, self.pipeline, self.scan, self.gain = skin, Pipeline(config), 0, 1.0
        self.rng = np.random.default_rng(1)  # the same whichever tests run
        self.feel(0.0, 70)
        self.pipeline.pre.command("tare", {})  # no model says whether something touched at the start
        assert not present(self.feel(0.0, 5)[-1])

    def feel(self, change, scans):
        return [self._result(change) for _ in range(scans)]

    def _result(self, change):
        self.scan += 1
        z = self.gain * self.skin.z0 * (1 + change) * (1 + NOISE * self.rng.standard_normal(len(self.skin.z0)))
        return self.pipeline.run(whole_scan(z, self.scan, device_us=self.scan * 45_000))


@pytest.fixture(scope="module")
def skin():
    return MeasuredSkin()


@pytest.fixture(scope="module")
def registered(skin, tmp_path_factory):
    return skin.registered(tmp_path_factory.mktemp("skins") / "mine")


@pytest.fixture(params=["measured", "registered"])
def felt(request, skin, registered):
    return Felt(skin, registered if request.param == "registered" else "disc16")


def test_a_touch_begins_stays_and_ends(felt):
    first, *rest = felt.feel(felt.skin.at((0.02, 0.01)), 40)
    (begun,) = first.contact.contacts
    assert first.contact.valid and begun.state == "begin"
    twin = Felt(felt.skin, felt.pipeline.pre.config.bundle)  # that goes on from its state
    for stage, other in zip(stages_of(felt.pipeline), stages_of(twin.pipeline), strict=True):
        other.load(stage.state())
    twin.scan = felt.scan
    for result in [*rest, *twin.feel(felt.skin.at((0.02, 0.01)), 2)]:
        (contact,) = present(result)
        assert result.contact.valid and (contact.id, contact.state) == (begun.id, "hold")
        assert np.hypot(contact.position[0] - 0.02, contact.position[1] - 0.01) < 0.01
    left, after = felt.feel(0.0, 2)
    assert [(c.id, c.state) for c in left.contact.contacts] == [(begun.id, "end")] and not after.contact.contacts


def test_a_touch_that_slides_keeps_its_number(felt):
    ids, off = set[int](), list[float]()
    for x in np.linspace(-0.03, 0.03, 41):  # 33 mm/s
        (result,) = felt.feel(felt.skin.at((float(x), 0.02)), 1)
        for contact in present(result):
            ids.add(contact.id)
            off.append(float(np.hypot(contact.position[0] - x, contact.position[1] - 0.02)))
    assert len(ids) == 1 and len(off) >= 40 and np.median(off) < 0.008


def test_a_second_touch_has_a_number_of_its_own(felt):
    one = felt.skin.at((0.03, 0.0))
    (first,) = present(felt.feel(one, 3)[-1])
    both = present(felt.feel(one + felt.skin.at((-0.03, -0.01)), 4)[-1])
    assert len(both) == 2 and first.id in [contact.id for contact in both]
    (last,) = present(felt.feel(one, 3)[-1])
    assert last.id == first.id


def test_what_foam_remembers_drift_and_gain_are_no_touches(felt):
    press = felt.skin.at((0.0, 0.03))
    assert all(present(result) for result in felt.feel(press, 100))
    felt.feel(0.02 * press, 2)
    assert all(result.contact.valid and not result.contact.contacts for result in felt.feel(0.02 * press, 40))
    felt.feel(0.0, 40)
    felt.gain = 1.02
    felt.feel(0.0, 4)
    for _ in range(200):  # 0.2 %/s
        felt.gain *= 1 + 1e-4
        (result,) = felt.feel(0.0, 1)
        assert result.contact.valid and not result.contact.contacts


def test_a_registered_skin_tells_force_and_place(skin, registered):
    felt = Felt(skin, registered)
    (contact,) = present(felt.feel(skin.at((0.02, -0.02), 1.2), 3)[-1])
    assert contact.force_n is not None and contact.force_sigma_n is not None and contact.position_sigma is not None
    assert abs(contact.force_n - 1.2 * FORCE_N) < 0.15 * FORCE_N and contact.position_sigma[0] < 0.005
    assert np.hypot(contact.position[0] - 0.02, contact.position[1] + 0.02) < 0.004  # its map's grid is 2.7 mm wide


ELL = [[0, 0], [100, 0], [100, 50], [50, 50], [50, 100], [0, 100]]  # mm
SKINS = {
    "disc12": {"radius": 30, "electrodes": {"width": 5, "count": 12}},
    "ell16": {"outline": ELL, "electrodes": {"width": 7.5, "count": 16, "first": 12.5}},
}
PRESSES = {  # m, in the skin's frame, and how far off a contact may be: 3 % of the skin's side
    "disc12": ([(0.0, 0.0), (0.012, -0.008), (-0.005, 0.017)], 1.8e-3),
    "ell16": ([(-0.02, -0.02), (0.03, -0.028), (-0.026, 0.03)], 3e-3),
}


@pytest.mark.parametrize("name", ["disc12", pytest.param("ell16", marks=pytest.mark.release)])
def test_presses_are_found_where_they_are(name, tmp_path):
    """The skin's bundle, and its stub: board and sheet on another mesh."""
    skin = geometry.from_dict({"name": name, "unit": "mm", "contact_impedance": 0.01, **SKINS[name]})
    matrices = linearise(ForwardModel(skin), "model")
    made = bundle.write(tmp_path / name, manifest.describe(name, skin, matrices), matrices)
    config, sheet = Skin(port="stub", bundle=str(made.path), frame_id=name, network="none"), Sheet(str(made.path))
    stub = StubSkin(tare=False, skin=config, bundle=made)

    def feel(world, scans):
        return [stub.see(sheet.transfer(world)) for _ in range(scans)][-1]

    rest = feel(World(), 80)
    if rest.contact.reasons == ["stale_baseline"]:  # the L's mesh and the stub's differ too much to be sure: one tare
        stub.pipeline.pre.command("tare", {})
        rest = feel(World(), 8)
    assert rest.contact.valid and not rest.contact.contacts, rest.contact.reasons
    places, most = PRESSES[name]
    for x, y in places:
        contact = feel(World(touches=(Touch("circle", x, y, 0.006, 0.3),)), 8).contact
        assert contact.valid and len(contact.contacts) == 1, (x, y, contact.reasons)
        found = contact.contacts[0].position
        assert np.hypot(found[0] - x, found[1] - y) < most, (x, y, found)
        assert not feel(World(), 12).contact.contacts


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
