"""Segmentation: what is one touch, two, none; a held touch: the mean of its image."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from models.shapes import KINDS, Shape, drop_image
from services.contacts.images.segmentation import FLOOR, KERNEL, RELATIVE_FLOOR, segment
from services.runtime.config import Skin, TouchConfig
from tests.services.stub_skin import StubSkin

N = 96
NOTHING = np.zeros((0, 0), np.float32)


def image(*shapes):
    """Drop image of shapes (model units), as soft as a reconstruction."""
    return ndimage.gaussian_filter(drop_image(shapes, N), 1.5).astype(np.float32)


def disc(x, y=0.0, radius=0.2, drop=0.3):
    return Shape("circle", x, y, radius, drop)


def found(picture, *known, y=0.0):
    """The touches in it, where touches at these x are known already."""
    return segment(picture, NOTHING, [((x + 1) / 2 * N - 0.5, (y + 1) / 2 * N - 0.5) for x in known])


def test_touches_side_by_side_are_two_and_overlapping_ones_are_one_unless_two_are_known():
    assert len(found(image(disc(-0.25), disc(0.25)))) == 2 and len(found(image(disc(-0.08), disc(0.08)))) == 1
    touching = image(disc(-0.18), disc(0.18))
    assert len(found(touching)) == len(found(touching, -0.18)) == 1
    places = sorted((s.x + 0.5) * 2 / N - 1 for s in found(touching, -0.18, 0.18))
    assert places == pytest.approx([-0.18, 0.18], abs=0.03)
    assert len(found(image(disc(0)), -0.1, 0.1)) == 1  # no waist, no two
    weak = image(disc(-0.2, drop=0.4), disc(0.16, radius=0.12, drop=0.25))  # at the side of a strong one
    assert len(found(weak, -0.2, 0.16)) == 2


@pytest.mark.parametrize("kind", ["circle", "triangle", "rectangle", "L", "hertz"])
def test_one_touch_of_any_shape_is_one_with_the_orientation_that_it_has(kind):
    for rotation, radius in ((0.0, 0.12), (0.4, 0.25), (1.1, 0.45), (-1.5, 0.35), (1.5, 0.35)):
        one = image(Shape(kind, 0.1, -0.2, radius, 0.3, rotation, 3.0 if kind == "rectangle" else 1.0))
        (s,) = found(one)
        assert len(found(one, 0.1, y=-0.2)) == 1 and -math.pi / 2 <= s.orientation <= math.pi / 2
        # a rectangle's long side is along its rotation
        assert kind != "rectangle" or abs(math.remainder(s.orientation - rotation, math.pi)) < 0.03


def test_what_is_below_the_floor_or_no_image_is_no_touch():
    assert found(image(disc(0, drop=0.8 * FLOOR))) == [] and len(found(image(disc(0, drop=1.5 * FLOOR)))) == 1
    assert len(found(image(disc(-0.5, drop=0.6), disc(0.5, drop=0.05)))) == 1  # a side lobe of the strong one
    peaks = [s.peak for s in found(image(disc(-0.22), disc(0.22), disc(0, 0.6, 0.3, 0.1)))]
    assert len(peaks) == 3 and peaks == sorted(peaks, reverse=True)
    for bad in (np.nan, np.inf, -np.inf, 1e30):
        broken = image(disc(0))
        broken[3, 5] = bad
        assert found(broken) == []


places, radii, drops = st.floats(-0.8, 0.8), st.floats(0.08, 0.4), st.floats(0.03, 0.9)
shapes = st.builds(Shape, st.sampled_from(KINDS), places, places, radii, drops, st.floats(0, 6), st.floats(1, 2.5))
scenes = st.lists(shapes, min_size=1, max_size=3)


@settings(max_examples=50)
@given(scenes, scenes, st.booleans())
def test_every_pixel_above_the_floor_is_one_touchs(scene, others, known):
    """However a patch is split, nothing of the drop is lost or counted twice; single pixels are no touch."""
    picture, n = drop_image([*scene, *others], 48).astype(np.float32), 48
    centres = [((s.x + 1) / 2 * n - 0.5, (s.y + 1) / 2 * n - 0.5) for s in scene]
    touches, alone = segment(picture, NOTHING, centres if known else []), segment(picture, NOTHING)
    smooth = ndimage.correlate1d(ndimage.correlate1d(picture.astype(float), KERNEL, 0), KERNEL, 1)
    above = float(picture[smooth > max(FLOOR, RELATIVE_FLOOR * float(picture.max()))].sum())
    total = sum(s.volume for s in touches)
    if touches:
        assert above * 0.999 <= total <= float(picture.sum()) * 1.001
        assert total == pytest.approx(sum(s.volume for s in alone), rel=1e-6)
    assert np.sum([s.mask for s in touches], axis=0).max(initial=0) <= 1
    for s in touches:
        assert s.mask.any() and s.area > 0 and s.peak > 0 and 0 <= s.x <= n - 1 and 0 <= s.y <= n - 1


def test_a_held_touch_gets_the_mean_without_any_frame_that_waits():
    """A round touch, which one touch's model explains scan after scan, so that it is held."""
    stub = StubSkin(85.0, skin=Skin(port="stub", bundle="square16", touch=TouchConfig(symmetry=True)))
    inference, seen = stub.pipeline.inference, []
    for _ in range(20):
        seen.append(stub.feel((Shape("circle", 0.3, -0.2, 0.25, 0.3),)))
        assert seen[-1].contact.valid and len({c.id for found in seen for c in found.contact.contacts}) == 1
        stub.pipeline.prepare()
    surer = [n for n, found in enumerate(seen) if found.delta.held and not found.image.held]
    assert surer and inference.health().counters["symmetric"] == len(surer)
    mean = seen[surer[-1]].image
    single = next(found for found in seen[surer[-1] :: -1] if not found.delta.held)
    assert mean.image.size and mean.reconstructed == single.delta.scan and (mean.image != single.image.image).any()
