"""Shapes against another solver's rasters and closed forms; scenes against their prior."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import geometry
from models.scenes import TARGETS, TRAINING, Prior, random_scene, random_shape
from models.shapes import (
    KINDS,
    Shape,
    drop_image,
    from_rows,
    gap,
    to_rows,
)
from tests import needs


@pytest.fixture(scope="module")
def reference():
    return dict(np.load(needs.reference("eidors_reference.npz")))


def test_rasters_match_the_reference(reference):
    for name, rows, truth in zip(reference["scene"], reference["shapes"], reference["drop"], strict=True):
        shapes = from_rows(rows)
        centres = -1 + 2 * (np.arange(96) + 0.5) / 96
        points = np.stack(np.meshgrid(centres, centres), axis=-1)
        sampled = sum((s.drop * s.profile(points) for s in shapes), np.zeros((96, 96)))
        np.testing.assert_allclose(sampled, truth, atol=1e-6, err_msg=str(name))
        fine = drop_image(shapes, 96)
        assert (np.abs(fine - truth) > 0.55 * max(truth.max(), 1e-9)).sum() <= 3, name  # only split edge pixels differ
        assert fine.sum() * (2 / 96) ** 2 == pytest.approx(sum(s.integral for s in shapes), rel=2e-3, abs=1e-12)


def test_outlines_match_the_reference(reference):
    seen = 0
    for rows, outlines in zip(reference["shapes"], reference["outlines"], strict=True):
        for shape, outline in zip(from_rows(rows), outlines, strict=False):
            if shape.corners is not None:
                np.testing.assert_allclose(shape.corners, outline[: len(shape.corners)], atol=1e-12)
                seen += 1
    assert seen >= 10


def test_closed_forms():
    assert Shape("triangle", 0, 0, 0.4, 0.1).area == pytest.approx(3 * np.sqrt(3) / 4 * 0.16)
    assert Shape("square", 0, 0, 0.4, 0.1, 0.3).area == pytest.approx(2 * 0.16)
    assert Shape("rectangle", 0, 0, 0.5, 0.1, 0.3, 4 / 3).area == pytest.approx(0.8 * 0.6)
    side = 0.4 * np.sqrt(2)
    bent = Shape("L", 0, 0, 0.4, 0.1)
    assert bent.area == pytest.approx(side**2 * (1 - 0.6**2))
    # two bars of the L: side x arm, and arm x (side - arm)
    arm = 0.4 * side
    bars = [(side * arm, arm / 2 - side / 2), (arm * (side - arm), arm + (side - arm) / 2 - side / 2)]
    expected = sum(a * y for a, y in bars) / sum(a for a, _ in bars)
    assert bent.centroid[1] == pytest.approx(expected)
    assert bent.centroid[0] == pytest.approx(expected)
    assert Shape("hertz", 0, 0, 0.3, 0.5).integral == pytest.approx(0.5 * 2 / 3 * np.pi * 0.09)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(KINDS), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.15, 0.4), st.floats(0, 6.3))
def test_pixels_hold_area_integral_and_centroid(kind, x, y, radius, rotation):
    shape = Shape(kind, x, y, radius, 0.3, rotation, 1.8 if kind == "rectangle" else 1.0)
    n = 48
    image = shape.fraction(n)
    pixel = (2 / n) ** 2
    assert image.sum() * pixel * 0.3 == pytest.approx(shape.integral, rel=2e-3 if kind == "hertz" else 1e-6)
    assert shape.fraction(n, covered=True).sum() * pixel == pytest.approx(shape.area, rel=1e-6)
    centres = -1 + 2 * (np.arange(n) + 0.5) / n
    assert (image.sum(0) @ centres) / image.sum() == pytest.approx(shape.centroid[0], abs=4e-3)
    assert (image.sum(1) @ centres) / image.sum() == pytest.approx(shape.centroid[1], abs=4e-3)


def test_rows_round_trip_and_errors():
    shapes = [Shape("L", 0.1, 0.2, 0.3, 0.4, 0.5), Shape("rectangle", -0.5, -0.5, 0.2, 0.1, 1.0, 2.0)]
    assert from_rows(to_rows(shapes)) == shapes
    with pytest.raises(ValueError, match="blob"):
        Shape("blob", 0, 0, 0.1, 0.1)
    with pytest.raises(ValueError, match="kind 9"):
        Shape.from_row([9, 0, 0, 0.1, 0.1, 0, 1])


def test_gap():
    a, b = Shape("square", -0.5, 0, 0.2 * np.sqrt(2), 0.1), Shape("square", 0.1, 0, 0.2 * np.sqrt(2), 0.1)
    assert gap(a, b) == pytest.approx(0.2)  # sides of 0.4 at a distance of 0.6
    assert gap(Shape("circle", -0.5, 0, 0.2, 0.1), Shape("hertz", 0.1, 0, 0.3, 0.1)) == pytest.approx(0.1)
    assert gap(Shape("circle", 0, 0, 0.4, 0.1), Shape("triangle", 0, 0, 0.1, 0.1)) == 0


def test_scenes_obey_their_prior():
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng, TARGETS) for _ in range(150)]
    for scene in scenes:
        for k, shape in enumerate(scene):
            assert np.abs(shape.outline()).max() <= 1 + 1e-9
            assert 0.15 <= shape.radius <= 0.45 and 0.1 <= shape.drop <= 0.5
            assert all(gap(shape, other) >= TARGETS.gap for other in scene[:k])
    counts = np.bincount([len(s) for s in scenes], minlength=4)[1:] / len(scenes)
    np.testing.assert_allclose(counts, TARGETS.touches, atol=0.12)
    assert {s.kind for scene in scenes for s in scene} == set(KINDS)
    again = np.random.default_rng(3)
    assert random_scene(again, TARGETS) == scenes[0]


def test_a_contact_too_large_for_the_skin_is_refused():
    with pytest.raises(ValueError, match="fits on this skin"):
        random_shape(np.random.default_rng(0), Prior(radius=(1.6, 1.7), tail=0.0, kinds=("circle",)))


def test_contacts_fit_on_a_strip_and_are_as_ever_on_a_wide_skin():
    """A strip of 100 x 14 mm leaves room for circles of 0.14 model units; the usual ones begin at 0.12."""
    strip = geometry.from_dict(
        {
            "name": "strip",
            "unit": "mm",
            "outline": [[0, 0], [100, 0], [100, 14], [0, 14]],
            "contact_impedance": 0.01,
            "electrodes": {"width": 5, "count": 12, "first": 10},
        }
    )
    prior = TRAINING.on(strip)
    rng = np.random.default_rng(0)
    for _ in range(40):
        scene = random_scene(rng, prior, strip.inside)
        assert scene and all(strip.inside(shape.outline(32)).all() for shape in scene)
    assert prior.radius[0] < prior.radius[1] <= 0.14
    assert TRAINING.on(geometry.load("square16")) == TRAINING == TRAINING.on(geometry.load("disc16"))
