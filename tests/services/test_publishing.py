"""Publishing: segmentation, tracking, forces, wrenches, outlines."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from services.contacts.tracking import LOST_FRAMES
from services.publishing import Publishing

from models.bundle import Bundle
from models.pressure import FOAM
from protocol.frames import BegunTouch, ContactFrame, ForceFrame, Frame, ImageFrame, PartFrame, ShapeFrame, pack, unpack
from services.contacts.outline import outline
from services.runtime import persistence
from services.runtime.config import Skin

N, M = 96, 0.1 / 96
CONTACT = frozenset({"contact"})
ALL = frozenset({"contact", "force", "shape"})
NOTHING = np.zeros((0, 0), np.float32)
AXIS = -0.05 + (np.arange(N) + 0.5) * M


def discs(*touches: tuple[float, float, float, float]) -> NDArray[np.float32]:
    """Image of discs (x, y, radius [m], drop [S/m]) with edges one pixel soft."""
    image = np.zeros((N, N))
    for x, y, radius, drop in touches:
        distance = np.hypot(AXIS[None, :] - x, AXIS[:, None] - y)
        image = np.maximum(image, drop * np.clip((radius - distance) / M + 0.5, 0, 1))
    return image.astype(np.float32)


def image_frame(image: NDArray[np.float32], scan: int = 1, **fields: Any) -> ImageFrame:
    return ImageFrame(
        skin="palm",
        scan=scan,
        valid=True,
        stamps={"sample": scan * 45_000_000},
        touched=bool(image.size),
        image=image,
        metres_per_pixel=M,
        origin=[-0.05, -0.05],
        **fields,
    )


@pytest.fixture
def stage(skin: Skin, bundle: Bundle) -> Publishing:
    return Publishing("palm", skin, bundle)


@pytest.fixture
def of_peak(skin: Skin, bundle: Bundle) -> Publishing:
    """Forces by the peak drop, 10 N a S/m: what an image shows of it is exact, where that of pressure is a mean over
    sizes, for images that no network makes as sharp as these discs.
    """
    return Publishing("palm", skin.model_copy(update={"reads": "peak"}), bundle)


def settled(stage: Publishing, frame: ImageFrame) -> ContactFrame:
    """Contacts of the second of two equal images: what appears beside others has to appear twice."""
    contacts(stage, frame)
    stamps = {"sample": frame.stamps["sample"] + 45_000_000}
    return contacts(stage, dataclasses.replace(frame, scan=frame.scan + 1, stamps=stamps))


def contacts(stage: Publishing, frame: Frame) -> ContactFrame:
    out = stage.process(frame, CONTACT)[0]
    assert isinstance(out, ContactFrame)
    unpack(pack(out))
    return out


def test_position_force_area_and_wrench_of_a_touch(stage: Publishing, of_peak: Publishing) -> None:
    frame = image_frame(discs((0.02, -0.01, 0.01, 0.3)))
    (exact,) = contacts(of_peak, frame).contacts
    assert exact.force_n == pytest.approx(3.0, rel=0.01)
    assert exact.wrench == pytest.approx([0, 0, -3.0, 0.01 * 3.0, 0.02 * 3.0, 0], rel=0.02, abs=1e-9)
    (c,) = contacts(stage, frame).contacts
    assert c.position == pytest.approx([0.02, -0.01, 0], abs=M / 10)
    assert c.force_n == pytest.approx(3.0, rel=0.04) and abs(c.force_n - 3.0) < c.force_sigma_n < 0.15 * c.force_n
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
    image = discs((0.02, -0.01, 0.01, drop))
    out = contacts(stage, image_frame(image))
    assert out.valid == valid
    assert reason is None or reason in out.reasons
    held = contacts(stage, image_frame(image, scan=2, held=True))
    assert held.valid == valid
    assert contacts(stage, image_frame(discs((0.02, -0.01, 0.01, 0.3)), scan=3)).valid


def test_a_force_far_beyond_the_calibration_is_not_valid(skin: Skin, bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "law.json").write_text('{"newtons_per_siemens": 10, "most_n": 2}')
    stage = Publishing("palm", skin.model_copy(update={"calibration": tmp_path / "law.json"}), bundle)
    for drop, valid in ((0.35, True), (0.45, False)):
        out = contacts(stage, image_frame(discs((0.0, 0.0, 0.01, drop))))
        assert out.valid == valid and "extrapolated" in out.reasons


def test_each_touch_is_cut_at_half_its_own_peak(stage: Publishing, of_peak: Publishing) -> None:
    """A 5 N touch and one of 0.36 N (6 mm) side by side: one threshold for both would lose the weak one."""
    frame = image_frame(discs((-0.02, 0.0, 0.01, 0.5), (0.02, 0.0, 0.006, 0.1)))
    assert [c.force_n for c in settled(of_peak, frame).contacts] == pytest.approx([5, 1], rel=0.02)
    strong, weak = settled(stage, frame).contacts
    assert (strong.force_n, weak.force_n) == pytest.approx((5, 0.36), rel=0.06)
    assert weak.position[0] == pytest.approx(0.02, abs=M / 5)
    assert weak.area_m2 == pytest.approx(math.pi * 0.006**2, rel=0.06)


def test_noise_makes_no_contacts_and_moves_none(stage: Publishing) -> None:
    rng = np.random.default_rng(0)
    noise = lambda s: (s * rng.standard_normal((N, N))).astype(np.float32)  # noqa: E731
    assert contacts(stage, image_frame(noise(0.004))).contacts == []
    for scan in range(2, 12):
        out = contacts(stage, image_frame(discs((0.0, 0.02, 0.01, 0.3)) + noise(0.02), scan))
        assert len([c for c in out.contacts if c.state != "end"]) == 1
        assert out.contacts[0].position[:2] == pytest.approx([0.0, 0.02], abs=M / 2)


def test_uncertainty_of_force_and_confidence_come_from_the_images(stage: Publishing, of_peak: Publishing) -> None:
    image = discs((0, 0, 0.01, 0.1))
    (exact,) = contacts(of_peak, image_frame(image, sigma=np.full((N, N), 0.02, np.float32))).contacts
    assert exact.force_sigma_n == pytest.approx(0.2)
    (sure,) = contacts(stage, image_frame(image, sigma=np.full((N, N), 0.02, np.float32))).contacts
    (unsure,) = contacts(stage, image_frame(image, 2, sigma=np.full((N, N), 0.1, np.float32))).contacts
    assert 0.02 < sure.force_sigma_n < 0.1 < 0.3 < unsure.force_sigma_n
    assert unsure.confidence < 0.9 < 0.99 < sure.confidence


def test_a_touch_begins_lasts_and_ends_once(stage: Publishing) -> None:
    seen = []
    contacts(stage, image_frame(NOTHING, 1))
    for scan, there in enumerate([True] * 4 + [False] * 4, 2):
        image = discs((0.001 * scan, 0, 0.01, 0.3)) if there else NOTHING
        seen.append([(c.id, c.state) for c in contacts(stage, image_frame(image, scan)).contacts])
    assert seen == [[(1, "begin")], *[[(1, "hold")]] * 3, *[[]] * LOST_FRAMES, [(1, "end")], [], []][: len(seen)]
    assert contacts(stage, image_frame(discs((0, 0, 0.01, 0.3)), 20)).contacts[0].id == 2


def held_frame(scan: int, reconstructed: int, **fields: Any) -> ImageFrame:
    """As inference sends it: without the image."""
    frame = image_frame(NOTHING, scan, held=True, reconstructed=reconstructed, **fields)
    frame.touched = True
    return frame


def test_held_frames_keep_contacts_and_say_so(stage: Publishing) -> None:
    (before,) = contacts(stage, image_frame(discs((0.01, 0, 0.01, 0.3)), reconstructed=1)).contacts
    for scan in (2, 3):
        out = contacts(stage, held_frame(scan, 1))
        assert out.held and out.valid and not stage.lacks and [(c.id, c.state) for c in out.contacts] == [(1, "hold")]
        assert out.contacts[0].position == before.position and out.contacts[0].force_n == before.force_n


def test_a_held_image_that_never_came_is_asked_for(stage: Publishing) -> None:
    """Passed by, or of before we started: nothing may be said of the touch until the image comes again."""
    contacts(stage, image_frame(discs((0.01, 0, 0.01, 0.3)), 1, reconstructed=1))
    for scan, frame in ((5, held_frame(5, 4)), (6, held_frame(6, 1, session="f" * 16))):
        out = contacts(stage, frame)
        assert stage.lacks and not out.valid and "gap" in out.reasons and out.contacts == [], scan
    image = discs((-0.02, 0.0, 0.01, 0.3))
    out = contacts(stage, image_frame(image, 7, held=True, reconstructed=4))
    assert out.valid and not stage.lacks
    out = contacts(stage, image_frame(image, 8, held=True, reconstructed=4))  # a jump is told when it is seen twice
    assert out.valid and any(c.position[0] == pytest.approx(-0.02, abs=1e-3) for c in out.contacts)


def test_what_appears_twice_is_seen_twice_in_an_image_that_came_once(stage: Publishing) -> None:
    contacts(stage, image_frame(NOTHING, 1))
    two = image_frame(discs((-0.02, 0.0, 0.01, 0.5), (0.02, 0.0, 0.006, 0.2)), 2, reconstructed=2)
    assert len(contacts(stage, two).contacts) == 1
    assert len(contacts(stage, held_frame(3, 2)).contacts) == 2


def test_the_state_carries_the_held_image(stage: Publishing, skin: Skin, bundle: Bundle) -> None:
    """A recording may begin while a touch is held: its replay gives the same contacts, in a session of its own."""
    contacts(stage, image_frame(NOTHING, 1))
    two = image_frame(discs((-0.02, 0.0, 0.01, 0.5), (0.02, 0.0, 0.006, 0.2)), 2, reconstructed=2, session="a" * 16)
    contacts(stage, two)
    twin = Publishing("palm", skin, bundle)
    twin.load(persistence.arrays(persistence.plain(stage.state())))
    for scan in (3, 4):
        ours, theirs = (contacts(s, held_frame(scan, 2, session=n * 16)) for s, n in ((stage, "a"), (twin, "b")))
        assert len(ours.contacts) == 2 and pack(ours) == pack(theirs)


def test_a_touch_that_was_there_before_anybody_looked_does_not_begin(stage: Publishing) -> None:
    """After a start, and for who wakes a publisher that slept: no `begin` of an old touch, no `end` of one that nobody
    was told of.
    """
    image = discs((0.01, 0.0, 0.01, 0.3))
    (first,) = contacts(stage, image_frame(image, 1)).contacts
    assert first.state == "hold"
    stage.wake()
    (again,) = contacts(stage, image_frame(image, 2)).contacts
    assert again.state == "hold" and again.id > first.id, "no id is used twice"
    stage.wake()
    assert contacts(stage, image_frame(NOTHING, 100)).contacts == []
    (new,) = contacts(stage, image_frame(image, 101)).contacts
    assert new.state == "begin"


def test_a_touch_after_a_time_in_which_nobody_could_look_does_not_begin(stage: Publishing) -> None:
    contacts(stage, image_frame(NOTHING, 1))
    unseen = image_frame(NOTHING, 2)
    unseen.valid, unseen.reasons = False, ["late"]
    assert not contacts(stage, unseen).valid
    (c,) = contacts(stage, image_frame(discs((0.01, 0.0, 0.01, 0.3)), 60)).contacts
    assert c.state == "hold"


def test_a_held_image_that_was_never_seen_is_looked_at(stage: Publishing) -> None:
    """The publisher may have slept, or been passed by, while a touch began: no "nothing touches" for as long as it
    is held.
    """
    assert contacts(stage, image_frame(NOTHING, 1)).contacts == []
    (c,) = contacts(stage, image_frame(discs((0.02, 0.0, 0.01, 0.3)), 9, held=True)).contacts
    assert c.position[0] == pytest.approx(0.02, abs=1e-3)
    moved = settled(stage, image_frame(discs((-0.02, 0.0, 0.01, 0.3)), 12, held=True)).contacts
    assert [c.position[0] for c in moved if c.state != "end"] == [pytest.approx(-0.02, abs=1e-3)]


def test_a_part_after_an_image_that_left_something_says_that_it_changes(stage: Publishing) -> None:
    """A touch that waits for its second image, or is not explained, is not shown: a part shows it no more."""

    def part(after: int) -> ContactFrame:
        stamps = {"sample": after * 45_000_000 + 4_000_000}
        return contacts(stage, PartFrame(skin="palm", scan=after, part=2, valid=True, stamps=stamps, after=after))

    one, two = discs((0.02, 0.01, 0.01, 0.2)), discs((0.02, 0.01, 0.01, 0.2), (-0.02, -0.02, 0.01, 0.2))
    seen = [
        (image_frame(one, 1, residual=0.0, reconstructed=1), True),
        (image_frame(one, 2, residual=0.0, reconstructed=2), False),
        (image_frame(two, 3, residual=0.0, reconstructed=3), True),
        (image_frame(two, 4, residual=0.0, reconstructed=4), False),
        (image_frame(two, 5, residual=0.3, reconstructed=5), True),
    ]
    for frame, changing in seen:
        contacts(stage, frame)
        after = part(frame.scan)
        assert after.valid and ("changing" in after.reasons) == changing, frame.scan


def begun(scan: int, after: int, drop: float = 0.3) -> PartFrame:
    began = BegunTouch(
        position=[0.02, -0.01],
        sigma=[0.001, 0.0005, 0.25],
        drop=drop,
        drop_sigma=0.1 * drop,
        integral=drop * math.pi * 0.01**2,
        unexplained=0.01,
    )
    return PartFrame(
        skin="palm", scan=scan, part=3, valid=True, stamps={"sample": scan * 4_500_000}, after=after, began=began
    )


def test_a_touch_that_began_is_a_contact_before_any_image_and_the_image_is_of_the_same(stage: Publishing) -> None:
    first = image_frame(NOTHING, 1)
    assert contacts(stage, first).contacts == []
    made = stage.process(begun(12, after=1), ALL)
    assert [type(frame) for frame in made] == [ContactFrame, ForceFrame], "a shape needs an image"
    (c,) = contacts(stage, begun(13, after=1)).contacts
    assert c.state == "begin" and c.position[:2] == pytest.approx([0.02, -0.01])
    assert c.position_sigma == [0.001, 0.0005, 0.25]
    assert c.force_n == pytest.approx(3.0, rel=0.1) and c.area_m2 == pytest.approx(math.pi * 0.01**2, rel=1e-6)
    grows = image_frame(np.zeros((N, N), np.float32), 2, reconstructed=2)
    grows.reasons = ["changing"]
    kept = stage.process(grows, ALL)
    assert isinstance(kept[0], ContactFrame) and [each.id for each in kept[0].contacts] == [c.id]
    assert isinstance(kept[2], ShapeFrame) and kept[2].ids == [c.id] and "changing" in kept[0].reasons
    seen = contacts(stage, image_frame(discs((0.02, -0.01, 0.01, 0.3)), 3, residual=0.0, reconstructed=3))
    assert [each.id for each in seen.contacts] == [c.id] and "changing" not in seen.reasons
    gone = image_frame(np.zeros((N, N), np.float32), 4, reconstructed=4, residual=0.0)
    gone.reasons = ["changing"]
    assert all(each.state == "end" for each in contacts(stage, gone).contacts), "an image had shown it"


def test_a_touch_that_began_and_is_not_believed_is_not_silently_left_out(stage: Publishing) -> None:
    contacts(stage, image_frame(NOTHING, 1))
    part = begun(12, after=1)
    assert part.began is not None
    part.began.unexplained = 0.9
    out = contacts(stage, part)
    assert not out.contacts and "changing" in out.reasons


@pytest.mark.parametrize(
    "wrong", [{"position": [1e30, 0.0]}, {"position": [0.3, 0.0]}, {"drop": 0.0}, {"integral": 1e300, "drop": 1e-300}]
)
def test_a_touch_that_began_where_or_as_none_can_is_not_valid(stage: Publishing, wrong: dict[str, Any]) -> None:
    contacts(stage, image_frame(NOTHING, 1))
    part = begun(12, after=1)
    assert part.began is not None
    part.began = dataclasses.replace(part.began, **wrong)
    out = contacts(stage, part)
    assert not out.valid and not out.contacts and "non_finite" in out.reasons


def test_a_touch_that_began_is_not_kept_by_empty_images_for_long(stage: Publishing) -> None:
    contacts(stage, image_frame(NOTHING, 1))
    contacts(stage, begun(12, after=1))

    def blank(scan: int) -> ImageFrame:
        frame = image_frame(np.zeros((N, N), np.float32), scan, reconstructed=scan)
        frame.reasons = ["changing"]
        return frame

    again = Publishing("palm", stage.config, Bundle.load("square16"))
    again.load(stage.state())
    late = contacts(again, blank(100)).contacts
    assert all(c.state == "end" for c in late) and len({c.id for c in late}) == len(late), "four seconds later"
    present = [any(c.state != "end" for c in contacts(stage, blank(scan)).contacts) for scan in range(2, 12)]
    assert present[0] and not any(present[5:])


def test_an_id_never_holds_and_ends_in_one_frame(stage: Publishing) -> None:
    image = discs((0.02, 0.0, 0.01, 0.3))
    (before,) = contacts(stage, image_frame(image, 1)).contacts
    after = contacts(stage, image_frame(image, 100, held=True)).contacts  # nobody looked for four seconds
    assert [c.state for c in after if c.id == before.id] == ["end"] and len({c.id for c in after}) == len(after)


def test_force_and_shape_are_no_more_valid_than_the_contacts(stage: Publishing) -> None:
    for image in (np.full((N, N), np.nan, np.float32), discs((0.0, 0.0, 0.02, 1.2))):
        out = stage.process(image_frame(image), ALL)
        assert [frame.valid for frame in out] == [False] * 3 and all(frame.reasons == out[0].reasons for frame in out)


def test_velocity_is_that_of_the_slide(stage: Publishing) -> None:
    for scan in range(40):
        (c,) = contacts(stage, image_frame(discs((-0.02 + 0.001 * scan, 0, 0.01, 0.3)), scan)).contacts
    assert c.velocity == pytest.approx([0.001 / 0.045, 0, 0], rel=0.05, abs=1e-3)


def test_force_and_shape_are_made_only_when_wanted(stage: Publishing, of_peak: Publishing) -> None:
    frame = image_frame(discs((-0.02, 0, 0.01, 0.5), (0.02, 0.01, 0.01, 0.2)))
    settled(of_peak, frame)
    exact = of_peak.process(frame, ALL)[1]
    assert isinstance(exact, ForceFrame) and exact.force_n == pytest.approx(7.0, rel=0.01)
    assert exact.wrench[2] == pytest.approx(-7.0, rel=0.01)
    settled(stage, frame)
    assert len(stage.process(frame, CONTACT)) == 1
    _, force, shape = stage.process(frame, ALL)
    assert isinstance(force, ForceFrame) and isinstance(shape, ShapeFrame)
    assert force.force_n == pytest.approx(7.0, rel=0.05)
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
    shape = stage.process(image_frame(bar), ALL)[2]
    assert isinstance(shape, ShapeFrame)
    assert shape.orientation[0] == pytest.approx(math.pi / 4, abs=0.02)


def test_shape_class_is_the_mean_over_the_touch(stage: Publishing) -> None:
    classes = np.full((5, 24, 24), 0.05, np.float32)
    classes[4] = 0.8
    (c,) = contacts(stage, image_frame(discs((0.02, 0.01, 0.01, 0.3)), classes=classes)).contacts
    assert c.shape == "L" and c.shape_probability == pytest.approx(0.8)


def test_a_doubtful_shape_is_named_with_its_probability(stage: Publishing) -> None:
    """Readers choose how sure is sure; only a bundle without a network has no answer."""
    disc = discs((0.02, 0.01, 0.01, 0.3))
    classes = np.full((5, 24, 24), 0.19, np.float32)
    classes[1] = 0.24
    (c,) = contacts(stage, image_frame(disc, classes=classes)).contacts
    assert c.shape == "triangle" and c.shape_probability == pytest.approx(0.24)
    (c,) = contacts(stage, image_frame(disc, 2, classes=np.zeros((0, 0, 0), np.float32))).contacts
    assert c.shape == "unknown" and c.shape_probability is None


def _shoelace(polygon: list[list[float]]) -> float:
    x, y = np.array(polygon).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_frames_that_stay_invalid_are_a_warning(stage: Publishing) -> None:
    """For `skin status` and `skin doctor`: each process may be well, and still nobody learns of a touch."""
    for scan in range(1, 130):
        frame = image_frame(NOTHING, scan)
        frame.valid, frame.reasons = False, ["out_of_distribution"]
        contacts(stage, frame)
    health = stage.health()
    assert health.level == "WARN" and "out_of_distribution" in health.messages[0]
    contacts(stage, image_frame(NOTHING, 130))
    assert stage.health().level == "OK"
