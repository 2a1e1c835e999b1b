"""Properties of segmentation and publishing that hold whatever comes in."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage

from models.bundle import Bundle
from models.shapes import KINDS, Shape, drop_image
from protocol.frames import SHAPES, ContactFrame, ImageFrame, pack, unpack
from services.contacts.images.segmentation import FLOOR, KERNEL, RELATIVE_FLOOR, segment
from services.publisher import Publishing
from services.runtime import persistence
from services.runtime.config import Skin
from tests.services.test_publishing import seen, told

FRAME_NS = 45_000_000
N = 48
M = 0.1 / N
NOTHING = np.zeros((0, 0), np.float32)
ALL = frozenset({"contact", "force", "shape"})

shapes = st.builds(
    Shape,
    st.sampled_from(KINDS),
    st.floats(-0.8, 0.8),
    st.floats(-0.8, 0.8),
    st.floats(0.08, 0.4),
    st.floats(0.03, 0.9),
    st.floats(0, 6),
    st.floats(1, 2.5),
)
scenes = st.lists(shapes, min_size=1, max_size=3)
pixels = st.one_of(
    st.floats(width=32, allow_nan=True, allow_infinity=True),
    st.floats(-1, 1, width=32),
    st.sampled_from([0.0, 1e-38, 3e38, -3e38, 0.3]),
)
wild_images = hnp.arrays(
    np.float32, st.tuples(st.integers(0, 12), st.integers(0, 12)), elements=pixels, fill=st.just(0)
)


def expectations(scene: list[Shape]) -> list[tuple[float, float]]:
    return [((s.x + 1) / 2 * N - 0.5, (s.y + 1) / 2 * N - 0.5) for s in scene]


@settings(max_examples=50, deadline=None)
@given(scenes, scenes, st.booleans())
def test_every_pixel_above_the_floor_is_one_touchs(scene: list[Shape], others: list[Shape], known: bool) -> None:
    """However a patch is split, nothing of the integrated drop is lost or counted twice; nor is a mask empty. What
    reaches the floor by single pixels only, which smoothing levels, is no touch.
    """
    image = drop_image([*scene, *others], N).astype(np.float32)
    found = segment(image, NOTHING, expectations(scene) if known else [])
    smooth = ndimage.correlate1d(ndimage.correlate1d(image.astype(float), KERNEL, 0), KERNEL, 1)
    above = float(image[smooth > max(FLOOR, RELATIVE_FLOOR * float(image.max()))].sum())
    total = sum(s.volume for s in found)
    if found:
        assert above * 0.999 <= total <= float(image.sum()) * 1.001
        assert total == pytest.approx(sum(s.volume for s in segment(image, NOTHING)), rel=1e-6)
    assert np.sum([s.mask for s in found], axis=0).max(initial=0) <= 1
    for s in found:
        assert s.mask.any() and s.area > 0 and s.peak > 0 and -math.pi / 2 <= s.orientation <= math.pi / 2
        assert 0 <= s.x <= N - 1 and 0 <= s.y <= N - 1


@settings(max_examples=20, deadline=None)
@given(scenes)
def test_what_is_found_turns_with_the_image(scene: list[Shape]) -> None:
    image = drop_image(scene, N).astype(np.float32)
    upright = sorted((s.peak, s.area) for s in segment(image, NOTHING))
    turned = sorted((s.peak, s.area) for s in segment(np.ascontiguousarray(np.rot90(image)), NOTHING))
    assume(len(upright) == len(turned))  # flat tops are told apart by their order in memory
    assert np.sum(upright) == pytest.approx(np.sum(turned), rel=0.1)


@pytest.fixture(scope="module")
def skin_stage(bundle: Bundle) -> Publishing:
    return Publishing("palm", Skin(port="stub", bundle="square16", frame_id="palm", network="none"), bundle)


@settings(max_examples=60, deadline=None)
@given(
    frames=st.lists(
        st.fixed_dictionaries(
            {
                "image": wild_images,
                "sigma": st.one_of(st.just(NOTHING), wild_images),
                "classes": st.one_of(
                    st.just(np.zeros((0, 0, 0), np.float32)),
                    hnp.arrays(np.float32, (len(SHAPES), 3, 3), elements=pixels),
                ),
                "touched": st.booleans(),
                "held": st.booleans(),
                "valid": st.booleans(),
                "metres_per_pixel": st.sampled_from([M, 0.0, 1e300, math.nan]),
                "origin": st.sampled_from([[-0.05, -0.05], [math.inf, 0.0], [1e200, 0.0]]),
            }
        ),
        min_size=1,
        max_size=6,
    )
)
def test_nothing_that_comes_in_makes_nan_come_out(skin_stage: Publishing, frames: list[dict[str, Any]]) -> None:
    skin_stage.reset()
    skin_stage.new_session()
    for scan, fields in enumerate(frames, 1):
        frame = ImageFrame(skin="palm", scan=scan, stamps={"sample": scan * FRAME_NS}, **fields)
        for out in skin_stage.everything(frame, ALL):
            back = unpack(pack(out))
            assert "non_finite" not in back.reasons or "non_finite" in out.reasons
            assert back.valid <= frame.valid
            if isinstance(out, ContactFrame):
                assert _finite(dataclasses.asdict(out)["contacts"])


touched = st.sets(st.integers(1, 4), max_size=3)  # ids that preprocessing gave
happenings = st.one_of(touched, touched, st.sampled_from(["lost", "reset", "reload", "anew"]))


class Book:
    """A publisher, and every id that it gave out. Touches are born with the first frame that has them."""

    def __init__(self, stage: Publishing) -> None:
        self.stage, self.scan = stage, 0
        self.born: dict[int, int] = {}
        self.last = 0  # of preprocessing's ids, which start from 1 again where it began anew
        self.states: list[dict[str, Any]] = []
        self.told: set[int] = set()
        self.gone: set[int] = set()

    def happen(self, what: Any, state: dict[str, Any] | None) -> None:
        self.scan += 1
        if what == "reset":
            self.stage.reset()
        elif what == "reload" and state is not None:
            self.stage.load(persistence.arrays(msgpack.unpackb(msgpack.packb(persistence.plain(state)))))
        elif what == "anew":
            self.born = {}
        elif isinstance(what, set):
            self.born = {number: self.born.get(number, self.scan) for number in what}
            self.look()
        self.states.append(self.stage.state())

    def look(self) -> None:
        age_s = {number: (self.scan - since) * FRAME_NS * 1e-9 for number, since in self.born.items()}
        touches = [told(n, (0.02 * (n - 2), 0.0, 0.006, 0.3), age_s=age_s[n]) for n in sorted(self.born)]
        (out,) = self.stage.process(seen(self.scan, *touches), frozenset({"contact"}))
        assert isinstance(out, ContactFrame)
        ids = [c.id for c in out.contacts]
        assert len(set(ids)) == len(ids), "an id twice in a frame"
        assert not self.gone & set(ids), "an id that had ended"
        begun = {c.id for c in out.contacts if c.state == "begin"}
        assert not begun & self.told, "a second begin"
        self.told |= set(ids)
        self.gone |= {c.id for c in out.contacts if c.state == "end"}


@settings(max_examples=60, deadline=None)
@given(st.lists(happenings, max_size=15), st.data())
def test_every_id_begins_and_ends_once_over_resets_and_states(
    skin_stage: Publishing, what: list[Any], data: st.DataObject
) -> None:
    skin_stage.reset()
    skin_stage.new_session()
    book = Book(skin_stage)
    for one in what:
        old = data.draw(st.sampled_from(book.states)) if one == "reload" and book.states else None
        book.happen(one, old)
    book.happen(set(), None)
    assert book.gone == book.told


@settings(max_examples=20, deadline=None)
@given(before=st.lists(touched, max_size=5), after=st.lists(touched, max_size=5))
def test_the_stage_goes_on_from_its_state_as_itself(
    skin_stage: Publishing, bundle: Bundle, before: list[set[int]], after: list[set[int]]
) -> None:
    skin_stage.reset()
    skin_stage.new_session()
    other = Publishing("palm", skin_stage.config, bundle)
    frames = [
        seen(scan, *(told(n, (0.02 * (n - 2), 0.0, 0.006, 0.3)) for n in sorted(touches)))
        for scan, touches in enumerate([*before, *after], 1)
    ]
    for frame in frames[: len(before)]:
        skin_stage.everything(frame, ALL)
    other.load(persistence.arrays(msgpack.unpackb(msgpack.packb(persistence.plain(skin_stage.state())))))
    for frame in frames[len(before) :]:
        for one, two in zip(skin_stage.everything(frame, ALL), other.everything(frame, ALL), strict=True):
            assert dataclasses.asdict(one) == dataclasses.asdict(two)


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
