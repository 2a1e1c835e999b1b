"""Segmentation: what is one touch, what are two, what is none; nothing is lost or counted twice."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from models.shapes import Shape, drop_image
from services.contacts.images.segmentation import FLOOR, segment

N = 96
NOTHING = np.zeros((0, 0), np.float32)


def image(*shapes: Shape, blur: float = 1.5) -> NDArray[np.float32]:
    """Drop image of shapes (model units), as soft as a reconstruction."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(drop_image(shapes, N), blur).astype(np.float32)


def disc(x: float, y: float = 0.0, radius: float = 0.2, drop: float = 0.3) -> Shape:
    return Shape("circle", x, y, radius, drop)


def pixel(v: float) -> float:
    return (v + 1) / 2 * N - 0.5


def places(*xs: float) -> list[tuple[float, float]]:
    return [(pixel(x), pixel(0.0)) for x in xs]


def test_touches_side_by_side_are_two_and_overlapping_ones_are_one() -> None:
    assert len(segment(image(disc(-0.25), disc(0.25)), NOTHING)) == 2
    assert len(segment(image(disc(-0.08), disc(0.08)), NOTHING)) == 1


def test_two_that_are_known_are_kept_apart_where_two_new_ones_are_one() -> None:
    touching = image(disc(-0.18), disc(0.18))
    assert len(segment(touching, NOTHING)) == 1
    known = segment(touching, NOTHING, places(-0.18, 0.18))
    assert sorted(s.x for s in known) == pytest.approx([pixel(-0.18), pixel(0.18)], abs=1.5)
    assert len(segment(touching, NOTHING, places(-0.18))) == 1
    assert len(segment(image(disc(0)), NOTHING, places(-0.1, 0.1))) == 1  # no waist, no two


@pytest.mark.parametrize("kind", ["circle", "triangle", "rectangle", "square", "L", "hertz"])
@pytest.mark.parametrize("rotation", [0.0, 0.4, 1.1])
@pytest.mark.parametrize("radius", [0.12, 0.25, 0.45])
def test_one_touch_of_any_shape_is_one(kind: str, rotation: float, radius: float) -> None:
    one = image(Shape(kind, 0.1, -0.2, radius, 0.3, rotation, 2.0 if kind == "rectangle" else 1.0))
    assert len(segment(one, NOTHING)) == 1
    assert len(segment(one, NOTHING, [(pixel(0.1), pixel(-0.2))])) == 1


@pytest.mark.parametrize("gap", [0.5, 0.4, 0.36, 0.3, 0.2, 0.0])
@pytest.mark.parametrize("known", [False, True])
def test_the_integrated_drop_is_the_same_however_touches_merge(gap: float, known: bool) -> None:
    """Sum over the touches of a merged image = sum over the touches of its parts."""
    left, right = image(disc(-gap / 2)), image(disc(gap / 2, drop=0.2))
    both = left + right
    parts = sum(s.volume for part in (left, right) for s in segment(part, NOTHING))
    found = segment(both, NOTHING, places(-gap / 2, gap / 2) if known else [])
    assert sum(s.volume for s in found) == pytest.approx(parts, rel=0.005)


def test_a_weak_touch_that_is_known_is_not_lost_at_the_side_of_a_strong_one() -> None:
    both = image(disc(-0.2, drop=0.4), disc(0.16, radius=0.12, drop=0.25))
    assert len(segment(both, NOTHING, places(-0.2, 0.16))) == 2


def test_masks_do_not_overlap_and_lie_in_the_image() -> None:
    found = segment(image(disc(-0.22), disc(0.22), disc(0, 0.6, 0.3, 0.1)), NOTHING)
    assert len(found) == 3
    assert np.sum([s.mask for s in found], axis=0).max() == 1
    assert all(s.mask.shape == (N, N) for s in found)
    assert [s.peak for s in found] == sorted((s.peak for s in found), reverse=True)


def test_orientation_is_within_a_quarter_turn_to_either_side() -> None:
    for angle in np.linspace(-1.5, 1.5, 13):
        bar = image(Shape("rectangle", 0, 0, 0.35, 0.3, float(angle), 3.0))
        (s,) = segment(bar, NOTHING)
        # models.shapes: a rectangle's long side is along its rotation
        assert abs(math.remainder(s.orientation - angle, math.pi)) < 0.03
        assert -math.pi / 2 <= s.orientation <= math.pi / 2


def test_what_is_below_the_floor_is_no_touch() -> None:
    assert segment(image(disc(0, drop=0.8 * FLOOR)), NOTHING) == []
    assert len(segment(image(disc(0, drop=1.5 * FLOOR)), NOTHING)) == 1
    weak = image(disc(-0.5, drop=0.6), disc(0.5, drop=0.05))
    assert len(segment(weak, NOTHING)) == 1  # a side lobe of the strong one


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_an_image_that_is_none_has_no_touches(bad: float) -> None:
    broken = image(disc(0))
    broken[3, 5] = bad
    assert segment(broken, NOTHING) == []


@pytest.mark.parametrize("value", [0.0, -1.0, 0.3, 1e-30])
def test_a_constant_image_is_at_most_one_touch(value: float) -> None:
    found = segment(np.full((N, N), value, np.float32), NOTHING)
    assert len(found) == (value > FLOOR)
    assert all(s.mask.any() for s in found)
