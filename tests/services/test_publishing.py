"""Publishing: contacts of the touches that the measurements tell, forces, wrenches, outlines of images."""

import dataclasses
import math

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models.pressure import FOAM
from models.pressure import disc as area
from protocol import frames as wire
from protocol.frames import ContactFrame, EstimatedTouch, ForceFrame, ImageFrame, PartFrame, ShapeFrame
from services.contacts.images.outline import outline
from services.publisher import Publishing
from services.runtime import persistence

N, M = 96, 0.1 / 96
CONTACT, ALL = frozenset({"contact"}), frozenset({"contact", "force", "shape"})
NOTHING = np.zeros((0, 0), np.float32)
AXIS = -0.05 + (np.arange(N) + 0.5) * M
ONE = (0.02, -0.01, 0.01, 0.3)  # x, y, radius [m], drop [S/m]


def discs(*touches):
    """Image of discs with edges one pixel soft."""
    image = np.zeros((N, N))
    for x, y, radius, drop in touches:
        distance = np.hypot(AXIS[None, :] - x, AXIS[:, None] - y)
        image = np.maximum(image, drop * np.clip((radius - distance) / M + 0.5, 0, 1))
    return image.astype(np.float32)


def told(number, disc=ONE, **fields):
    """A disc as the measurements tell it."""
    x, y, radius, drop = disc
    strength = math.pi * radius**2 * drop / (1 - min(drop, 1.0) / 2)
    made = {
        "position": [x, y], "sigma": [0.001, 0.0005, 0.25], "radius_m": radius, "radius_sigma": 0.02, "drop": drop,
        "drop_sigma": 0.01 * drop, "strength": strength, "strength_sigma": 0.01 * strength, "z2": 1e4,
    }  # fmt: skip
    return EstimatedTouch(id=number, **(made | fields))


def seen(scan, *touches, image=None, **fields):
    """Those touches, and the image of them; each is as old as its id says it can be: it began with its first frame."""
    made = discs(*((*t.position, t.radius_m, t.drop) for t in touches)) if image is None and touches else image
    return ImageFrame(
        skin="palm", scan=scan, valid=True, stamps={"sample": scan * 45_000_000}, touched=bool(touches),
        image=NOTHING if made is None else made, metres_per_pixel=M, origin=[-0.05, -0.05], estimates=list(touches),
        reconstructed=fields.pop("reconstructed", scan), **fields,
    )  # fmt: skip


def held(scan, *touches, of, **fields):
    return seen(scan, *touches, held=True, reconstructed=of, **{"image": NOTHING} | fields)


def part(scan, *touches):
    stamps = {"sample": scan * 45_000_000 + 4_000_000}
    return PartFrame(skin="palm", scan=scan, part=3, valid=True, stamps=stamps, after=scan, estimates=list(touches))


@pytest.fixture
def stage(skin, bundle):
    return Publishing("palm", skin, bundle)


@pytest.fixture
def of_peak(skin, bundle):
    """Forces by the peak drop, 10 N a S/m: what an image shows of it is exact, that of pressure a mean over sizes."""
    return Publishing("palm", skin.model_copy(update={"reads": "peak"}), bundle)


def contacts(stage, frame):
    (out,) = stage.process(frame, CONTACT)
    return wire.unpack(wire.pack(out)) if out.valid else out


def only(stage, frame):
    (contact,) = contacts(stage, frame).contacts
    return contact


def test_position_force_area_and_wrench_of_a_touch(stage, of_peak):
    frame = seen(1, told(1, velocity=[0.03, -0.01]))
    exact = only(of_peak, frame)
    assert exact.force_n == pytest.approx(3.0, rel=0.01)
    assert exact.wrench == pytest.approx([0, 0, -3.0, 0.01 * 3.0, 0.02 * 3.0, 0], rel=0.02, abs=1e-9)
    c = only(stage, frame)
    assert c.position == pytest.approx([0.02, -0.01, 0], abs=1e-9) and c.position_sigma == [0.001, 0.0005, 0.25]
    assert abs(c.force_n - 3.0) < c.force_sigma_n < 0.15 * c.force_n
    assert abs(c.pressure_pa - float(FOAM.pressure(0.3))) < c.pressure_sigma_pa < 0.5 * c.pressure_pa
    assert c.area_m2 == pytest.approx(area(0.01), rel=0.03) and [*c.velocity, *c.normal] == [0.03, -0.01, 0, 0, 0, 1]
    assert c.wrench == pytest.approx([0, 0, -c.force_n, 0.01 * c.force_n, 0.02 * c.force_n, 0], rel=0.02, abs=1e-9)


def test_what_no_touch_can_be_or_is_far_beyond_the_calibration_is_not_valid(stage, skin, bundle, tmp_path):
    for drop, valid, reasons in (
        (0.45, True, set()), (0.7, True, {"extrapolated"}), (0.97, True, {"extrapolated"}),
        (1.05, False, {"out_of_distribution"}),
    ):  # fmt: skip
        touch = told(1, (0.02, -0.01, 0.01, drop))
        out = contacts(stage, seen(1, touch))
        assert out.valid == valid and reasons <= set(out.reasons), drop
        assert contacts(stage, held(2, touch, of=1)).valid == valid and contacts(stage, seen(3, told(1))).valid
    (tmp_path / "law.json").write_text('{"newtons_per_siemens": 10, "most_n": 2}')
    stage = Publishing("palm", skin.model_copy(update={"calibration": tmp_path / "law.json"}), bundle)
    for drop in (0.35, 0.45):
        out = contacts(stage, seen(round(100 * drop), told(1, (0.0, 0.0, 0.01, drop))))
        assert out.valid == (drop < 0.4) and "extrapolated" in out.reasons


def test_each_touch_has_its_own_part_of_the_image_and_noise_in_one_makes_no_other_outline(stage, of_peak):
    """A 5 N touch and one of 0.36 N (6 mm) side by side: one threshold for both would lose the weak one."""
    frame = seen(1, told(1, (-0.02, 0.0, 0.01, 0.5)), told(2, (0.02, 0.0, 0.006, 0.1)))
    assert [c.force_n for c in contacts(of_peak, frame).contacts] == pytest.approx([5, 1], rel=0.02)
    strong, weak = contacts(stage, frame).contacts
    assert (strong.force_n, weak.force_n) == pytest.approx((5, 0.36), rel=0.1)
    assert weak.area_m2 == pytest.approx(area(0.006), rel=0.06)
    noise = np.random.default_rng(0).standard_normal((12, N, N)).astype(np.float32)
    assert all(c.state == "end" for c in contacts(stage, seen(2, image=discs(ONE) + 0.004 * noise[0])).contacts)
    for scan in range(3, 12):
        c = only(stage, seen(scan, told(3), image=discs(ONE) + 0.02 * noise[scan]))
        assert c.area_m2 == pytest.approx(area(0.01), rel=0.1)


def test_uncertainty_of_force_and_confidence_come_from_the_measurements(stage):
    weak = (0.0, 0.0, 0.01, 0.1)
    strength = told(1, weak).strength
    sure = only(stage, seen(1, told(1, weak, strength_sigma=0.01 * strength)))
    unsure = only(stage, seen(2, told(1, weak, strength_sigma=0.3 * strength, z2=1.0)))
    assert 0.01 < sure.force_sigma_n < 0.15 < 0.25 < unsure.force_sigma_n
    assert unsure.confidence < 0.9 < 0.99 < sure.confidence


def test_a_touch_begins_lasts_and_ends_once(stage):
    said = []
    contacts(stage, seen(1))
    for scan, there in enumerate([True] * 4 + [False] * 4, 2):
        touches = [told(7, (0.001 * scan, 0, 0.01, 0.3), age_s=0.045 * (scan - 2))] if there else []
        said.append([(c.id, c.state) for c in contacts(stage, seen(scan, *touches)).contacts])
    assert said == [[(1, "begin")], *[[(1, "hold")]] * 3, [(1, "end")], [], [], []]
    assert only(stage, seen(20, told(8))).id == 2


def test_held_frames_keep_contacts_and_an_image_that_never_came_is_asked_for_and_the_touch_told_without(stage):
    """Passed by, or of before we started: what it looks like is not known until the image comes again."""
    contacts(stage, seen(1))
    before = only(stage, seen(2, told(1)))
    for scan in (3, 4):
        out = contacts(stage, held(scan, told(1, age_s=0.045 * (scan - 2)), of=2))
        assert out.held and out.valid and not stage.lacks and [(c.id, c.state) for c in out.contacts] == [(1, "hold")]
        assert out.contacts[0].area_m2 == before.area_m2 and out.contacts[0].force_n == before.force_n
    contacts(stage, seen(5))
    for frame in (held(6, told(2), of=4), held(7, told(2), of=1, session="f" * 16)):
        assert only(stage, frame).area_m2 == pytest.approx(area(0.01), rel=1e-6) and stage.lacks
    c = only(stage, held(8, told(2), of=4, image=discs((0.02, -0.01, 0.012, 0.3))))
    assert not stage.lacks and c.area_m2 == pytest.approx(area(0.012), rel=0.05)


def test_the_state_carries_what_touches_look_like(stage, skin, bundle):
    """A recording may begin while a touch is held: its replay gives the same contacts, in a session of its own."""
    contacts(stage, seen(1))
    touches = told(1, (-0.02, 0.0, 0.01, 0.5)), told(2, (0.02, 0.0, 0.006, 0.2))
    contacts(stage, seen(2, *touches, session="a" * 16))
    twin = Publishing("palm", skin, bundle)
    twin.load(persistence.arrays(persistence.plain(stage.state())))
    for scan in (3, 4):
        later = [dataclasses.replace(t, age_s=0.045 * (scan - 2)) for t in touches]
        ours, theirs = (contacts(s, held(scan, *later, of=2, session=n * 16)) for s, n in ((stage, "a"), (twin, "b")))
        assert len(ours.contacts) == 2 and wire.pack(ours) == wire.pack(theirs)


def test_a_touch_that_was_there_before_anybody_looked_does_not_begin(stage):
    """After a start, and for who wakes a publisher that slept; nor has it an `end` that nobody was told of."""
    first = only(stage, seen(1, told(1, age_s=5.0)))
    stage.wake()
    assert first.state == only(stage, seen(2, told(1, age_s=5.045))).state == "hold"
    stage.wake()
    assert contacts(stage, seen(100)).contacts == []
    new = only(stage, seen(101, told(2)))
    assert new.state == "begin" and new.id > first.id, "no id is used twice"
    contacts(stage, seen(102))
    assert only(stage, seen(160, told(3, began=False))).state == "hold", "it was not seen to begin"


def test_a_touch_is_a_contact_before_any_image_and_the_image_is_of_the_same(stage):
    assert contacts(stage, seen(1)).contacts == []
    made = [type(frame) for frame in stage.everything(part(1, told(1)), ALL)]
    assert made == [ContactFrame, ForceFrame], "a shape needs an image"
    c = only(stage, part(1, told(1)))
    assert c.state == "begin" and c.position[:2] == pytest.approx([0.02, -0.01])
    assert c.force_n == pytest.approx(3.0, rel=0.1) and c.area_m2 == pytest.approx(area(0.01), rel=1e-6)
    kept = stage.everything(seen(2, told(1, age_s=0.045)), ALL)
    assert [each.id for each in kept[0].contacts] == [c.id] == kept[2].ids
    moved = only(stage, part(2, told(1, (0.023, -0.012, 0.01, 0.3), age_s=0.05)))
    assert moved.id == c.id and moved.position[:2] == pytest.approx([0.023, -0.012], abs=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"position": [x, 0.0]} for x in (1e30, math.nan, 0.3)), {"drop": -0.1}, {"drop": math.inf},
        {"radius_m": math.nan}, {"strength": 1e300}, {"sigma": [math.inf, 0.0, 0.0]},
    ],
)  # fmt: skip
def test_a_touch_where_or_as_none_can_be_is_not_valid(stage, wrong):
    contacts(stage, seen(1))
    for frame in (part(1, told(1, **wrong)), seen(2, told(1, **wrong), image=discs(ONE))):
        out = contacts(stage, frame)
        assert not out.valid and not out.contacts and "non_finite" in out.reasons


def test_force_and_shape_are_made_when_wanted_and_no_more_valid_than_the_contacts(stage, of_peak):
    frame = seen(1, told(1, (-0.02, 0, 0.01, 0.5)), told(2, (0.02, 0.01, 0.01, 0.2)))
    exact = of_peak.everything(frame, ALL)[1]
    assert (exact.force_n, exact.wrench[2]) == pytest.approx((7.0, -7.0), rel=0.01)
    assert len(stage.everything(frame, CONTACT)) == 1
    _, force, shape = stage.everything(frame, ALL)
    assert isinstance(force, ForceFrame) and isinstance(shape, ShapeFrame)
    assert force.force_n == pytest.approx(7.0, rel=0.08) and force.wrench[2] == pytest.approx(-force.force_n, rel=1e-6)
    assert len(shape.outlines) == len(shape.ids) == 2
    assert [shoelace(polygon) for polygon in shape.outlines] == pytest.approx([area(0.01)] * 2, rel=0.04)
    out = stage.everything(seen(2, told(3, (0.0, 0.0, 0.02, 1.2))), ALL)
    assert [frame.valid for frame in out] == [False] * 3 and all(frame.reasons == out[0].reasons for frame in out)
    nan, inf = np.full((N, N), math.nan, np.float32), [math.inf, 0.0]
    for k, changed in enumerate(({"image": nan}, {"origin": inf}, {"metres_per_pixel": math.nan}), 3):
        for out in stage.everything(dataclasses.replace(seen(k, told(k + 1)), **changed), ALL):
            assert "non_finite" not in wire.unpack(wire.pack(out)).reasons or "non_finite" in out.reasons


def shoelace(polygon):
    """Its area; positive: counter-clockwise."""
    x, y = np.array(polygon).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_outline_of_a_rectangle_with_a_notch():
    mask = np.pad(np.ones((4, 5), bool), ((1, 1), (2, 1)))
    mask[1, 2] = False
    found = outline(mask, 1.0, [10.0, 20.0])
    expected = [[17.0, 21.0], [17.0, 25.0], [12.0, 25.0], [12.0, 22.0], [13.0, 22.0], [13.0, 21.0]]
    assert sorted(found) == sorted(expected) and shoelace(found) == mask.sum()


def test_an_image_tells_orientation_and_shape_with_its_probability(stage):
    """Readers choose how sure is sure; only a bundle without a network has no answer."""
    u, v = (AXIS[None, :] + AXIS[:, None]) / math.sqrt(2), (-AXIS[None, :] + AXIS[:, None]) / math.sqrt(2)
    bar = np.where((abs(u) < 0.02) & (abs(v) < 0.005), 0.3, 0).astype(np.float32)
    shape = stage.everything(seen(1, told(1, (0.0, 0.0, 0.0113, 0.3)), image=bar), ALL)[2]
    assert shape.orientation[0] == pytest.approx(math.pi / 4, abs=0.02)
    contacts(stage, seen(1))
    said = ((0.05, 0.05, 0.05, 0.05, 0.8), "L"), ((0.19, 0.24, 0.19, 0.19, 0.19), "triangle")
    for scan, (probabilities, name) in enumerate(said, 2):
        classes = np.tile(np.array(probabilities, np.float32)[:, None, None], (1, 24, 24))
        c = only(stage, seen(scan, told(1), classes=classes))
        assert c.shape == name and c.shape_probability == pytest.approx(max(probabilities)), "the mean over the touch"
    c = only(stage, seen(4, told(1), classes=np.zeros((0, 0, 0), np.float32)))
    assert c.shape == "unknown" and c.shape_probability is None


def test_frames_that_stay_invalid_are_a_warning(stage):
    """Each process may be well, and still nobody learns of a touch."""

    def invalid(scan, *reasons):
        contacts(stage, dataclasses.replace(seen(scan), valid=False, reasons=[*reasons]))
        return stage.health()

    assert {invalid(scan, "stale_baseline").level for scan in range(1, 100)} == {"OK"}
    said = [invalid(scan, "gap", "out_of_distribution") for scan in range(100, 130)][-1]
    assert said.level == "WARN" and said.messages[0].startswith("no frame has been valid for 6 s: gap (")
    assert "out_of_distribution" in said.messages[0] and "stale_baseline" not in said.messages[0]
    contacts(stage, seen(130))
    assert stage.health().level == "OK"
    said = [invalid(scan, "gap") for scan in (2000, 4000, 131, 250)]  # a clock that begins anew begins the spell anew
    assert [each.level for each in said] == ["OK", "WARN", "OK", "WARN"]


def test_a_touch_of_a_preprocessing_that_began_anew_is_another_one(stage):
    first, held = (only(stage, seen(scan, told(1, age_s=0.045 * scan))) for scan in (1, 2))
    new, ended = contacts(stage, seen(3, told(1))).contacts
    assert first.id == held.id == ended.id != new.id and ended.state == "end"


touched = st.sets(st.integers(1, 4), max_size=3)  # ids that preprocessing gave
happenings = st.one_of(touched, touched, st.sampled_from(["lost", "reset", "reload", "anew"]))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(happenings, max_size=15), st.data())
def test_every_id_begins_and_ends_once_over_resets_and_states(stage, what, data):
    """Touches are born with the first frame that has them; `anew`: preprocessing counts from 1 again."""
    stage.reset()
    stage.new_session()
    born, states, told_of, gone = {}, [], set(), set()
    for scan, one in enumerate([*what, set()], 1):
        if one == "reset":
            stage.reset()
        elif one == "reload" and states:
            state = persistence.plain(data.draw(st.sampled_from(states)))
            stage.load(persistence.arrays(msgpack.unpackb(msgpack.packb(state))))
        elif one == "anew":
            born = {}
        elif isinstance(one, set):
            born = {number: born.get(number, scan) for number in one}
            ages = {n: (scan - since) * 0.045 for n, since in sorted(born.items())}
            touches = [told(n, (0.02 * (n - 2), 0.0, 0.006, 0.3), age_s=age_s) for n, age_s in ages.items()]
            (out,) = stage.process(seen(scan, *touches), CONTACT)
            ids = {c.id for c in out.contacts}
            assert len(ids) == len(out.contacts), "an id twice in a frame"
            assert not gone & ids, "an id that had ended"
            assert not told_of & {c.id for c in out.contacts if c.state == "begin"}, "a second begin"
            told_of |= ids
            gone |= {c.id for c in out.contacts if c.state == "end"}
        states.append(stage.state())
    assert gone == told_of
