"""Publishing: contacts of the touches that the measurements tell, forces, wrenches, outlines of images."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.pressure import FOAM
from protocol.frames import (
    ContactFrame,
    EstimatedTouch,
    ForceFrame,
    Frame,
    ImageFrame,
    PartFrame,
    ShapeFrame,
    pack,
    unpack,
)
from services.contacts.images.outline import outline
from services.publisher import Publishing
from services.runtime import persistence
from services.runtime.config import Skin

N, M = 96, 0.1 / 96
CONTACT = frozenset({"contact"})
ALL = frozenset({"contact", "force", "shape"})
NOTHING = np.zeros((0, 0), np.float32)
AXIS = -0.05 + (np.arange(N) + 0.5) * M


Disc = tuple[float, float, float, float]  # x, y, radius [m], drop [S/m]


def discs(*touches: Disc) -> NDArray[np.float32]:
    """Image of discs with edges one pixel soft."""
    image = np.zeros((N, N))
    for x, y, radius, drop in touches:
        distance = np.hypot(AXIS[None, :] - x, AXIS[:, None] - y)
        image = np.maximum(image, drop * np.clip((radius - distance) / M + 0.5, 0, 1))
    return image.astype(np.float32)


def told(number: int, disc: Disc, **fields: Any) -> EstimatedTouch:
    """A disc as the measurements tell it."""
    x, y, radius, drop = disc
    strength = math.pi * radius**2 * drop / (1 - min(drop, 1.0) / 2)
    made: dict[str, Any] = {
        "id": number,
        "position": [x, y],
        "sigma": [0.001, 0.0005, 0.25],
        "radius_m": radius,
        "radius_sigma": 0.02,
        "drop": drop,
        "drop_sigma": 0.01 * drop,
        "strength": strength,
        "strength_sigma": 0.01 * strength,
        "z2": 1e4,
    }
    return EstimatedTouch(**(made | fields))


def seen(scan: int, *touches: EstimatedTouch, image: NDArray[np.float32] | None = None, **fields: Any) -> ImageFrame:
    """Those touches, and the image of them; each is as old as its id says it can be: it began with its first frame."""
    made = discs(*((*t.position, t.radius_m, t.drop) for t in touches)) if image is None and touches else image
    return ImageFrame(
        skin="palm",
        scan=scan,
        valid=True,
        stamps={"sample": scan * 45_000_000},
        touched=bool(touches),
        image=NOTHING if made is None else made,
        metres_per_pixel=M,
        origin=[-0.05, -0.05],
        estimates=list(touches),
        reconstructed=fields.pop("reconstructed", scan),
        **fields,
    )


def part(scan: int, *touches: EstimatedTouch) -> PartFrame:
    stamps = {"sample": scan * 45_000_000 + 4_000_000}
    return PartFrame(skin="palm", scan=scan, part=3, valid=True, stamps=stamps, after=scan, estimates=list(touches))


@pytest.fixture
def stage(skin: Skin, bundle: Bundle) -> Publishing:
    return Publishing("palm", skin, bundle)


@pytest.fixture
def of_peak(skin: Skin, bundle: Bundle) -> Publishing:
    """Forces by the peak drop, 10 N a S/m: what an image shows of it is exact, where that of pressure is a mean over
    sizes, for images that no network makes as sharp as these discs.
    """
    return Publishing("palm", skin.model_copy(update={"reads": "peak"}), bundle)


def contacts(stage: Publishing, frame: Frame) -> ContactFrame:
    out = stage.process(frame, CONTACT)[0]
    assert isinstance(out, ContactFrame)
    unpack(pack(out))
    return out


ONE = (0.02, -0.01, 0.01, 0.3)


def test_position_force_area_and_wrench_of_a_touch(stage: Publishing, of_peak: Publishing) -> None:
    frame = seen(1, told(1, ONE))
    (exact,) = contacts(of_peak, frame).contacts
    assert exact.force_n == pytest.approx(3.0, rel=0.01)
    assert exact.wrench == pytest.approx([0, 0, -3.0, 0.01 * 3.0, 0.02 * 3.0, 0], rel=0.02, abs=1e-9)
    (c,) = contacts(stage, frame).contacts
    assert c.position == pytest.approx([0.02, -0.01, 0], abs=1e-9) and c.position_sigma == [0.001, 0.0005, 0.25]
    assert c.force_n is not None and c.force_sigma_n is not None
    assert abs(c.force_n - 3.0) < c.force_sigma_n < 0.15 * c.force_n
    assert c.pressure_pa is not None and c.pressure_sigma_pa is not None
    assert abs(c.pressure_pa - float(FOAM.pressure(0.3))) < c.pressure_sigma_pa < 0.5 * c.pressure_pa
    assert c.area_m2 == pytest.approx(math.pi * 0.01**2, rel=0.03)
    assert c.wrench == pytest.approx([0, 0, -c.force_n, 0.01 * c.force_n, 0.02 * c.force_n, 0], rel=0.02, abs=1e-9)
    assert c.normal == [0, 0, 1]


@pytest.mark.parametrize(
    ("drop", "valid", "reason"),
    [
        (0.45, True, None),
        (0.7, True, "extrapolated"),
        (0.97, True, "extrapolated"),
        (1.05, False, "out_of_distribution"),
    ],
)
def test_what_no_touch_can_be_is_not_valid(stage: Publishing, drop: float, valid: bool, reason: str | None) -> None:
    touch = told(1, (0.02, -0.01, 0.01, drop))
    out = contacts(stage, seen(1, touch))
    assert out.valid == valid
    assert reason is None or reason in out.reasons
    assert contacts(stage, seen(2, touch, held=True, image=NOTHING, reconstructed=1)).valid == valid
    assert contacts(stage, seen(3, told(1, ONE))).valid


def test_a_force_far_beyond_the_calibration_is_not_valid(skin: Skin, bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "law.json").write_text('{"newtons_per_siemens": 10, "most_n": 2}')
    stage = Publishing("palm", skin.model_copy(update={"calibration": tmp_path / "law.json"}), bundle)
    for scan, (drop, valid) in enumerate(((0.35, True), (0.45, False)), 1):
        out = contacts(stage, seen(scan, told(1, (0.0, 0.0, 0.01, drop))))
        assert out.valid == valid and "extrapolated" in out.reasons


def test_each_touch_has_its_own_part_of_the_image(stage: Publishing, of_peak: Publishing) -> None:
    """A 5 N touch and one of 0.36 N (6 mm) side by side: one threshold for both would lose the weak one."""
    frame = seen(1, told(1, (-0.02, 0.0, 0.01, 0.5)), told(2, (0.02, 0.0, 0.006, 0.1)))
    assert [c.force_n for c in contacts(of_peak, frame).contacts] == pytest.approx([5, 1], rel=0.02)
    strong, weak = contacts(stage, frame).contacts
    assert (strong.force_n, weak.force_n) == pytest.approx((5, 0.36), rel=0.1)
    assert weak.area_m2 == pytest.approx(math.pi * 0.006**2, rel=0.06)


def test_an_image_without_a_touch_makes_no_contact_and_noise_in_one_no_other_outline(stage: Publishing) -> None:
    rng = np.random.default_rng(0)
    noise = lambda s: (s * rng.standard_normal((N, N))).astype(np.float32)  # noqa: E731
    assert contacts(stage, seen(1, image=discs(ONE) + noise(0.004))).contacts == []
    for scan in range(2, 12):
        touch = told(1, (0.0, 0.02, 0.01, 0.3))
        (c,) = contacts(stage, seen(scan, touch, image=discs((0.0, 0.02, 0.01, 0.3)) + noise(0.02))).contacts
        assert c.area_m2 == pytest.approx(math.pi * 0.01**2, rel=0.1)


def test_uncertainty_of_force_and_confidence_come_from_the_measurements(stage: Publishing) -> None:
    weak = (0.0, 0.0, 0.01, 0.1)
    strength = told(1, weak).strength
    (sure,) = contacts(stage, seen(1, told(1, weak, strength_sigma=0.01 * strength))).contacts
    (unsure,) = contacts(stage, seen(2, told(1, weak, strength_sigma=0.3 * strength, z2=1.0))).contacts
    assert sure.force_sigma_n is not None and unsure.force_sigma_n is not None
    assert 0.01 < sure.force_sigma_n < 0.15 < 0.25 < unsure.force_sigma_n
    assert unsure.confidence < 0.9 < 0.99 < sure.confidence


def test_a_touch_begins_lasts_and_ends_once(stage: Publishing) -> None:
    said = []
    contacts(stage, seen(1))
    for scan, there in enumerate([True] * 4 + [False] * 4, 2):
        touches = [told(7, (0.001 * scan, 0, 0.01, 0.3), age_s=0.045 * (scan - 2))] if there else []
        said.append([(c.id, c.state) for c in contacts(stage, seen(scan, *touches)).contacts])
    assert said == [[(1, "begin")], *[[(1, "hold")]] * 3, [(1, "end")], [], [], []]
    assert contacts(stage, seen(20, told(8, ONE))).contacts[0].id == 2


def test_held_frames_keep_contacts_and_say_so(stage: Publishing) -> None:
    contacts(stage, seen(1))
    (before,) = contacts(stage, seen(2, told(1, ONE))).contacts
    for scan in (3, 4):
        touch = told(1, ONE, age_s=0.045 * (scan - 2))
        out = contacts(stage, seen(scan, touch, held=True, image=NOTHING, reconstructed=2))
        assert out.held and out.valid and not stage.lacks and [(c.id, c.state) for c in out.contacts] == [(1, "hold")]
        assert out.contacts[0].area_m2 == before.area_m2 and out.contacts[0].force_n == before.force_n


def test_a_held_image_that_never_came_is_asked_for_and_the_touch_told_without(stage: Publishing) -> None:
    """Passed by, or of before we started: what it looks like is not known until the image comes again."""
    bar = told(1, ONE)
    for scan, frame in (
        (5, seen(5, bar, held=True, image=NOTHING, reconstructed=4)),
        (6, seen(6, bar, held=True, image=NOTHING, reconstructed=1, session="f" * 16)),
    ):
        (c,) = contacts(stage, frame).contacts
        assert stage.lacks and c.area_m2 == pytest.approx(math.pi * 0.01**2, rel=1e-6), scan
    (c,) = contacts(stage, seen(7, bar, held=True, image=discs((0.02, -0.01, 0.012, 0.3)), reconstructed=4)).contacts
    assert not stage.lacks and c.area_m2 == pytest.approx(math.pi * 0.012**2, rel=0.05)


def test_the_state_carries_what_touches_look_like(stage: Publishing, skin: Skin, bundle: Bundle) -> None:
    """A recording may begin while a touch is held: its replay gives the same contacts, in a session of its own."""
    contacts(stage, seen(1))
    touches = told(1, (-0.02, 0.0, 0.01, 0.5)), told(2, (0.02, 0.0, 0.006, 0.2))
    contacts(stage, seen(2, *touches, session="a" * 16))
    twin = Publishing("palm", skin, bundle)
    twin.load(persistence.arrays(persistence.plain(stage.state())))
    for scan in (3, 4):
        later = [dataclasses.replace(t, age_s=0.045 * (scan - 2)) for t in touches]
        frames = (seen(scan, *later, held=True, image=NOTHING, reconstructed=2, session=n * 16) for n in ("a", "b"))
        ours, theirs = (contacts(s, frame) for s, frame in zip((stage, twin), frames, strict=True))
        assert len(ours.contacts) == 2 and pack(ours) == pack(theirs)


def test_a_touch_that_was_there_before_anybody_looked_does_not_begin(stage: Publishing) -> None:
    """After a start, and for who wakes a publisher that slept: no `begin` of an old touch, no `end` of one that nobody
    was told of.
    """
    (first,) = contacts(stage, seen(1, told(1, ONE, age_s=5.0))).contacts
    assert first.state == "hold"
    stage.wake()
    (again,) = contacts(stage, seen(2, told(1, ONE, age_s=5.045))).contacts
    assert again.state == "hold"
    stage.wake()
    assert contacts(stage, seen(100)).contacts == []
    (new,) = contacts(stage, seen(101, told(2, ONE))).contacts
    assert new.state == "begin" and new.id > first.id, "no id is used twice"


def test_a_touch_that_was_not_seen_to_begin_does_not_begin(stage: Publishing) -> None:
    contacts(stage, seen(1))
    (c,) = contacts(stage, seen(60, told(1, ONE, began=False))).contacts
    assert c.state == "hold"


def test_a_touch_is_a_contact_before_any_image_and_the_image_is_of_the_same(stage: Publishing) -> None:
    assert contacts(stage, seen(1)).contacts == []
    made = stage.everything(part(1, told(1, ONE)), ALL)
    assert [type(frame) for frame in made] == [ContactFrame, ForceFrame], "a shape needs an image"
    (c,) = contacts(stage, part(1, told(1, ONE))).contacts
    assert c.state == "begin" and c.position[:2] == pytest.approx([0.02, -0.01])
    assert c.force_n == pytest.approx(3.0, rel=0.1) and c.area_m2 == pytest.approx(math.pi * 0.01**2, rel=1e-6)
    kept = stage.everything(seen(2, told(1, ONE, age_s=0.045)), ALL)
    assert isinstance(kept[0], ContactFrame) and [each.id for each in kept[0].contacts] == [c.id]
    assert isinstance(kept[2], ShapeFrame) and kept[2].ids == [c.id]


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [1e30, 0.0]},
        {"position": [math.nan, 0.0]},
        {"position": [0.3, 0.0]},
        {"drop": -0.1},
        {"radius_m": math.nan},
        {"drop": math.inf},
        {"strength": 1e300},
        {"sigma": [math.inf, 0.0, 0.0]},
    ],
)
def test_a_touch_where_or_as_none_can_be_is_not_valid(stage: Publishing, wrong: dict[str, Any]) -> None:
    contacts(stage, seen(1))
    for frame in (part(1, told(1, ONE, **wrong)), seen(2, told(1, ONE, **wrong), image=discs(ONE))):
        out = contacts(stage, frame)
        assert not out.valid and not out.contacts and "non_finite" in out.reasons


def test_an_id_never_holds_and_ends_in_one_frame(stage: Publishing) -> None:
    """A preprocessing that began anew counts from 1 again."""
    (before,) = contacts(stage, seen(1, told(1, ONE))).contacts
    after = contacts(stage, seen(100, told(1, ONE))).contacts
    assert [c.state for c in after if c.id == before.id] == ["end"] and len({c.id for c in after}) == len(after)


def test_force_and_shape_are_no_more_valid_than_the_contacts(stage: Publishing) -> None:
    touch = told(1, (0.0, 0.0, 0.02, 1.2))
    for image in (np.full((N, N), np.nan, np.float32), None):
        out = stage.everything(seen(1, touch, image=image), ALL)
        assert [frame.valid for frame in out] == [False] * 3 and all(frame.reasons == out[0].reasons for frame in out)


def test_force_and_shape_are_made_only_when_wanted(stage: Publishing, of_peak: Publishing) -> None:
    frame = seen(1, told(1, (-0.02, 0, 0.01, 0.5)), told(2, (0.02, 0.01, 0.01, 0.2)))
    exact = of_peak.everything(frame, ALL)[1]
    assert isinstance(exact, ForceFrame) and exact.force_n == pytest.approx(7.0, rel=0.01)
    assert exact.wrench[2] == pytest.approx(-7.0, rel=0.01)
    assert len(stage.everything(frame, CONTACT)) == 1
    _, force, shape = stage.everything(frame, ALL)
    assert isinstance(force, ForceFrame) and isinstance(shape, ShapeFrame)
    assert force.force_n == pytest.approx(7.0, rel=0.08)
    assert force.wrench[2] == pytest.approx(-force.force_n, rel=1e-6)
    assert len(shape.outlines) == len(shape.ids) == 2
    for polygon, area in zip(shape.outlines, (0.01, 0.01), strict=True):
        assert _shoelace(polygon) == pytest.approx(math.pi * area**2, rel=0.04)  # positive: counter-clockwise


def test_outline_of_a_rectangle_with_a_notch() -> None:
    mask = np.zeros((6, 8), bool)
    mask[1:5, 2:7] = True
    mask[1, 2] = False
    found = outline(mask, 1.0, [10.0, 20.0])
    expected = [[17, 21], [17, 25], [12, 25], [12, 22], [13, 22], [13, 21]]
    assert sorted(found) == sorted([[float(a), float(b)] for a, b in expected])
    assert _shoelace(found) == mask.sum()


def test_orientation_is_the_long_axis(stage: Publishing) -> None:
    u = (AXIS[None, :] + AXIS[:, None]) / math.sqrt(2)
    v = (-AXIS[None, :] + AXIS[:, None]) / math.sqrt(2)
    bar = np.where((abs(u) < 0.02) & (abs(v) < 0.005), 0.3, 0).astype(np.float32)
    shape = stage.everything(seen(1, told(1, (0.0, 0.0, 0.0113, 0.3)), image=bar), ALL)[2]
    assert isinstance(shape, ShapeFrame)
    assert shape.orientation[0] == pytest.approx(math.pi / 4, abs=0.02)


def test_shape_class_is_the_mean_over_the_touch(stage: Publishing) -> None:
    classes = np.full((5, 24, 24), 0.05, np.float32)
    classes[4] = 0.8
    (c,) = contacts(stage, seen(1, told(1, ONE), classes=classes)).contacts
    assert c.shape == "L" and c.shape_probability == pytest.approx(0.8)


def test_a_doubtful_shape_is_named_with_its_probability(stage: Publishing) -> None:
    """Readers choose how sure is sure; only a bundle without a network has no answer."""
    classes = np.full((5, 24, 24), 0.19, np.float32)
    classes[1] = 0.24
    (c,) = contacts(stage, seen(1, told(1, ONE), classes=classes)).contacts
    assert c.shape == "triangle" and c.shape_probability == pytest.approx(0.24)
    (c,) = contacts(stage, seen(2, told(1, ONE), classes=np.zeros((0, 0, 0), np.float32))).contacts
    assert c.shape == "unknown" and c.shape_probability is None


def _shoelace(polygon: list[list[float]]) -> float:
    x, y = np.array(polygon).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_frames_that_stay_invalid_are_a_warning(stage: Publishing) -> None:
    """For `skin status` and `skin doctor`: each process may be well, and still nobody learns of a touch."""
    for scan in range(1, 130):
        frame = seen(scan)
        frame.valid, frame.reasons = False, ["out_of_distribution"]
        contacts(stage, frame)
    health = stage.health()
    assert health.level == "WARN" and "out_of_distribution" in health.messages[0]
    contacts(stage, seen(130))
    assert stage.health().level == "OK"
