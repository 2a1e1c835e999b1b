"""Properties of segmentation, tracking and publishing that hold whatever comes in."""

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
from numpy.typing import NDArray
from scipy import ndimage
from services.contacts.motion import Patch
from services.contacts.tracking import Tracker
from services.publishing import Publishing

from models.bundle import Bundle
from models.shapes import KINDS, Shape, drop_image
from models.uncertainty import FLOOR, RELATIVE_FLOOR
from protocol.frames import SHAPES, ContactFrame, ImageFrame, pack, unpack
from services.contacts.segmentation import KERNEL, segment
from services.runtime import persistence
from services.runtime.config import Skin

FRAME_NS = 45_000_000
N = 48
M = 0.1 / N
NOTHING = np.zeros((0, 0), np.float32)
ALL = frozenset({"contact", "force", "shape"})

places = st.floats(-0.05, 0.05)
patches = st.builds(Patch, places, places, st.floats(1e-6, 1e-3), st.floats(0.002, 0.02), st.floats(0.0, 1.0))
lists = st.lists(patches, max_size=4)
happenings = st.one_of(lists, lists, st.sampled_from(["still", "reset", "reload", "pause", "same time"]))
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


class Session:
    """A tracker, and the book of every id that it gave out."""

    def __init__(self) -> None:
        self.tracker, self.now = Tracker(), FRAME_NS
        self.states: list[dict[str, Any]] = []
        self.present: set[int] = set()
        self.begun: set[int] = set()
        self.gone: set[int] = set()

    def happen(self, what: Any, load: dict[str, Any] | None) -> None:
        self.now += 2_000_000_000 if what == "pause" else 0 if what == "same time" else FRAME_NS
        if what == "still":
            self._end(self.tracker.still(self.now))
        elif what == "reset":
            self.tracker.reset()
        elif what == "reload" and load is not None:
            self.tracker.load(persistence.arrays(msgpack.unpackb(msgpack.packb(persistence.plain(load)))))
        elif isinstance(what, list):
            tracks, ended = self.tracker.update(what, self.now)
            confirmed = [t for t in tracks if t is not None]
            ids = [t.id for t in confirmed]
            assert len(tracks) == len(what) and len(set(ids)) == len(ids), "an id twice in a frame"
            assert not self.gone & set(ids), "an id that had ended"
            new = {t.id for t in confirmed if t.age == 1}
            assert not new & self.begun, "a second begin"
            assert set(ids) - new <= self.begun, "a touch that never began"
            self.begun |= new
            self._end(ended)
            assert not {t.id for t in ended} & set(ids), "ended and there"
            assert all(math.isfinite(v) for t in confirmed for v in (t.x, t.y, t.vx, t.vy, t.pp, t.pv, t.vv, t.size))
        self.states.append(self.tracker.state())

    def _end(self, tracks: list[Any]) -> None:
        ids = [t.id for t in tracks]
        assert len(set(ids)) == len(ids) and not self.gone & set(ids), "a second end"
        assert set(ids) <= self.begun, "the end of what never began"
        self.gone |= set(ids)

    def finish(self) -> None:
        self.happen("pause", None)
        self.happen([], None)


@settings(max_examples=80, deadline=None)
@given(st.lists(happenings, max_size=15), st.data())
def test_every_id_begins_and_ends_once_over_resets_and_states(what: list[Any], data: st.DataObject) -> None:
    session = Session()
    for one in what:
        old = data.draw(st.sampled_from(session.states)) if one == "reload" and session.states else None
        session.happen(one, old)
    session.finish()
    assert session.gone == session.begun


def generic(one: Patch, k: int) -> Patch:
    """Moved and grown by next to nothing, so that no two are equal: between equals the order may decide."""
    return one._replace(x=one.x + 1e-5 * math.sin(7 * k), size=one.size * (1 + 0.01 * math.sin(3 * k)))


@settings(max_examples=50, deadline=None)
@given(st.lists(lists, max_size=10), st.randoms(use_true_random=False))
def test_the_order_of_what_is_seen_does_not_matter(frames: list[list[Patch]], random: Any) -> None:
    one, other = Tracker(), Tracker()
    names: dict[int, int] = {}
    for n, alike in enumerate(frames, 1):
        seen = [generic(one, 10 * n + k) for k, one in enumerate(alike)]
        order = list(range(len(seen)))
        random.shuffle(order)
        straight, ended = one.update(seen, n * FRAME_NS)
        mixed, also_ended = other.update([seen[k] for k in order], n * FRAME_NS)
        for place, k in enumerate(order):  # new ids are given in the order of the list: the same up to names
            a, b = straight[k], mixed[place]
            assert (a is None) == (b is None)
            assert a is None or b is None or names.setdefault(a.id, b.id) == b.id
        assert {names[t.id] for t in ended} == {t.id for t in also_ended}


@settings(max_examples=50, deadline=None)
@given(st.lists(lists, max_size=12), st.lists(lists, max_size=8))
def test_a_tracker_goes_on_from_its_state_as_itself(before: list[list[Patch]], after: list[list[Patch]]) -> None:
    tracker, other = Tracker(), Tracker()
    for n, seen in enumerate(before, 1):
        tracker.update(seen, n * FRAME_NS)
    other.load(persistence.arrays(msgpack.unpackb(msgpack.packb(persistence.plain(tracker.state())))))
    for n, seen in enumerate(after, len(before) + 1):
        assert tracker.update(seen, n * FRAME_NS) == other.update(seen, n * FRAME_NS)
    assert tracker.state() == other.state()


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
def stage(bundle: Bundle) -> Publishing:
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
def test_nothing_that_comes_in_makes_nan_come_out(stage: Publishing, frames: list[dict[str, Any]]) -> None:
    stage.reset()
    stage.new_session()
    for scan, fields in enumerate(frames, 1):
        frame = ImageFrame(skin="palm", scan=scan, stamps={"sample": scan * FRAME_NS}, **fields)
        for out in stage.process(frame, ALL):
            back = unpack(pack(out))
            assert "non_finite" not in back.reasons or "non_finite" in out.reasons
            assert back.valid <= frame.valid
            if isinstance(out, ContactFrame):
                assert _finite(dataclasses.asdict(out)["contacts"])


@settings(max_examples=20, deadline=None)
@given(before=st.lists(scenes, max_size=5), after=st.lists(st.one_of(scenes, st.none()), max_size=5))
def test_the_stage_goes_on_from_its_state_as_itself(
    stage: Publishing, bundle: Bundle, before: list[list[Shape]], after: list[list[Shape] | None]
) -> None:
    stage.reset()
    stage.new_session()
    other = Publishing("palm", stage.config, bundle)
    image = NOTHING
    for scan, scene in enumerate(before, 1):
        image = drop_image(scene, N).astype(np.float32)
        stage.process(_frame(image, scan), ALL)
    other.load(persistence.arrays(msgpack.unpackb(msgpack.packb(persistence.plain(stage.state())))))
    for scan, following in enumerate(after, len(before) + 1):
        image = image if following is None else drop_image(following, N).astype(np.float32)
        frame = _frame(image, scan, held=following is None)
        for one, two in zip(stage.process(frame, ALL), other.process(frame, ALL), strict=True):
            assert dataclasses.asdict(one) == dataclasses.asdict(two)


def _frame(image: NDArray[np.float32], scan: int, held: bool = False) -> ImageFrame:
    return ImageFrame(
        skin="palm",
        scan=scan,
        valid=True,
        stamps={"sample": scan * FRAME_NS},
        touched=bool(image.size),
        held=held,
        image=image,
        metres_per_pixel=M,
        origin=[-0.05, -0.05],
    )


def _finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_finite, value.values()))
    if isinstance(value, list):
        return all(map(_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
