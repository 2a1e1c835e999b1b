"""Shapes against another solver's rasters and closed forms; scenes; the law of the foam; what mismatched sheets are."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import geometry, rolling
from models.bundle import Bundle
from models.mismatch import Mismatch, MismatchedSheet, mounted, named, soft_drop
from models.pressure import FOAM, MOST_DROP, Foam, disc
from models.scenes import TARGETS, random_scene
from models.shapes import KINDS, Shape, drop_image, from_rows, gap, to_rows
from models.turns import TURNS, Turn

DROPS = np.array([0.0, 0.01, 0.2, 0.499, 0.5, 0.501, 0.7, 0.9, 0.98])


def test_rasters_and_outlines_match_the_reference(reference):
    data, centres = reference("eidors_reference"), -1 + 2 * (np.arange(96) + 0.5) / 96
    points = np.stack(np.meshgrid(centres, centres), axis=-1)
    for name, rows, truth, outlines in zip(*(data[k] for k in ("scene", "shapes", "drop", "outlines")), strict=True):
        shapes = from_rows(rows)
        sampled = sum((s.drop * s.profile(points) for s in shapes), np.zeros((96, 96)))
        np.testing.assert_allclose(sampled, truth, atol=1e-6, err_msg=str(name))
        fine = drop_image(shapes, 96)
        assert (np.abs(fine - truth) > 0.55 * max(truth.max(), 1e-9)).sum() <= 3, name  # only split edge pixels differ
        for shape, outline in zip(shapes, outlines, strict=False):
            if shape.corners is not None:
                np.testing.assert_allclose(shape.corners, outline[: len(shape.corners)], atol=1e-12)


def test_closed_forms_and_rows():
    shapes = [Shape("L", 0.1, 0.2, 0.3, 0.4, 0.5), Shape("rectangle", -0.5, -0.5, 0.2, 0.1, 1.0, 2.0)]
    assert from_rows(to_rows(shapes)) == shapes
    assert Shape("triangle", 0, 0, 0.4, 0.1).area == pytest.approx(3 * np.sqrt(3) / 4 * 0.16)
    assert Shape("square", 0, 0, 0.4, 0.1, 0.3).area == pytest.approx(2 * 0.16)
    assert Shape("rectangle", 0, 0, 0.5, 0.1, 0.3, 4 / 3).area == pytest.approx(0.8 * 0.6)
    side, bent = 0.4 * np.sqrt(2), Shape("L", 0, 0, 0.4, 0.1)
    assert bent.area == pytest.approx(side**2 * (1 - 0.6**2))
    assert Shape("hertz", 0, 0, 0.3, 0.5).integral == pytest.approx(0.5 * 2 / 3 * np.pi * 0.09)
    a, b = (Shape("square", x, 0, 0.2 * np.sqrt(2), 0.1) for x in (-0.5, 0.1))
    assert gap(a, b) == pytest.approx(0.2)  # sides of 0.4 at a distance of 0.6
    assert gap(Shape("circle", -0.5, 0, 0.2, 0.1), Shape("hertz", 0.1, 0, 0.3, 0.1)) == pytest.approx(0.1)
    assert gap(Shape("circle", 0, 0, 0.4, 0.1), Shape("triangle", 0, 0, 0.1, 0.1)) == 0


@settings(max_examples=40)
@given(st.sampled_from(KINDS), st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.15, 0.4), st.floats(0, 6.3))
def test_pixels_hold_area_integral_and_centroid(kind, x, y, radius, rotation):
    n, shape = 48, Shape(kind, x, y, radius, 0.3, rotation, 1.8 if kind == "rectangle" else 1.0)
    image, pixel = shape.fraction(n), (2 / n) ** 2
    assert image.sum() * pixel * 0.3 == pytest.approx(shape.integral, rel=2e-3 if kind == "hertz" else 1e-6)
    assert shape.fraction(n, covered=True).sum() * pixel == pytest.approx(shape.area, rel=1e-6)
    centres = -1 + 2 * (np.arange(n) + 0.5) / n
    found = (image.sum(0) @ centres) / image.sum(), (image.sum(1) @ centres) / image.sum()
    assert found == pytest.approx(tuple(shape.centroid), abs=4e-3)


@pytest.mark.parametrize("turn", TURNS)
def test_what_is_turned_comes_back_and_a_place_is_turned_as_its_pixel_is(turn: Turn) -> None:
    image = np.random.default_rng(0).normal(size=(3, 5, 5))
    assert (turn.back.image(turn.image(image)) == image).all()
    assert (turn.image(image) == image).all() == (turn == TURNS[0])
    one = np.zeros((5, 5))
    one[1, 4] = 1.0
    (iy, ix), place = np.argwhere(turn.image(one))[0], np.array([[4 - 2.0, 1 - 2.0]])
    assert turn.points(place)[0].tolist() == [ix - 2, iy - 2]


def test_scenes_obey_their_prior():
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng, TARGETS) for _ in range(150)]
    for scene in scenes:
        for k, shape in enumerate(scene):
            assert np.abs(shape.outline()).max() <= 1 + 1e-9 and 0.15 <= shape.radius <= 0.45
            assert 0.1 <= shape.drop <= 0.5
            assert all(gap(shape, other) >= TARGETS.gap for other in scene[:k])
    counts = np.bincount([len(s) for s in scenes], minlength=4)[1:] / len(scenes)
    np.testing.assert_allclose(counts, TARGETS.touches, atol=0.2)
    assert {s.kind for scene in scenes for s in scene} == set(KINDS)


def test_the_law_of_the_foam_is_a_tenth_a_newton_and_saturates_smoothly():
    for newton in (0.1, 1.0, 5.0):
        assert FOAM.flat_drop(newton, disc(0.01)) == pytest.approx(0.1 * newton)
    assert FOAM.flat_drop(1.0, disc(0.005)) == pytest.approx(0.4)
    for foam in (FOAM, Foam(1e-5, 0.3)):
        assert foam.drop(foam.pressure(DROPS)) == pytest.approx(DROPS, abs=1e-12)
    p = np.linspace(0, 6 / FOAM.slope, 60001)
    slope = np.diff(FOAM.drop(p)) / np.diff(p) / FOAM.slope
    assert (slope > 0).all() and slope.max() == pytest.approx(1.0) and np.abs(np.diff(slope)).max() < 1e-3  # no corner
    assert FOAM.drop(-1.0) == 0 and FOAM.pressure(1.0) == FOAM.pressure(MOST_DROP)
    assert float(FOAM.drop((0.5 + 0.5 * np.log(2)) / FOAM.slope)) == pytest.approx(0.75)
    drops, h = DROPS[(DROPS > 0) & (DROPS != 0.5)], 1e-5
    found = np.log(FOAM.pressure(drops * (1 + h)) / FOAM.pressure(drops * (1 - h))) / (2 * h)
    assert FOAM.gain(drops) == pytest.approx(found, rel=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_the_force_of_any_touch_is_pressure_summed_over_its_map(kind: str) -> None:
    unit, n, shape = 0.05, 800, Shape(kind, 0.1, -0.05, 0.25, 0.1, 0.4, 1.6 if kind == "rectangle" else 1.0)
    axis, area = (np.arange(n) + 0.5) * 2 / n - 1, shape.area * unit**2
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    for newton in (0.5, 2.0, 9.0):
        drop = FOAM.peak_drop(kind, newton, area)
        pressed = Shape(kind, 0.1, -0.05, 0.25, drop, 0.4, shape.aspect)
        image = drop * pressed.profile(points)
        assert float(FOAM.pressure(image).sum()) * (2 * unit / n) ** 2 == pytest.approx(newton, rel=6e-3)
        assert image.sum() * (2 / n) ** 2 == pytest.approx(pressed.integral, rel=6e-3)
        assert FOAM.force(kind, drop, area) == pytest.approx(newton)


MESH = "inverse"


def test_an_anisotropic_sheet_is_a_stretched_isotropic_one() -> None:
    """Turned by a right angle, the square has its electrodes where others were, four further: (x, y) -> (-y, x)."""
    skin = geometry.load("square16")
    along = MismatchedSheet(skin, Mismatch(anisotropy=0.15), mesh=MESH)
    across = MismatchedSheet(skin, Mismatch(anisotropy=0.15, angle=np.pi / 2), mesh=MESH)
    tensor = along.conductivity()
    np.testing.assert_allclose(tensor, np.tile([1.15, 0.0, 1 / 1.15], (len(tensor), 1)), atol=1e-12)
    turned = across.solve().impedances((skin.pattern + 4) % 16)
    np.testing.assert_allclose(turned, along.solve().impedances(), rtol=1e-3)
    assert np.abs(along.solve().impedances() / across.solve().impedances() - 1).max() > 0.02


def test_electrodes_move_contacts_differ_and_edges_blur_as_named() -> None:
    skin, touch = geometry.load("square16"), [Shape("circle", 0.1, 0.0, 0.15, 0.4)]
    off = np.stack([mounted(skin, named("shift3").seeded(seed)).electrodes - skin.electrodes for seed in range(20)])
    assert (0.02 < off.std(axis=1)).all() and (off.std(axis=1) < 0.12).all() and np.abs(off).max() <= 0.12 + 1e-9
    contacts = mounted(skin, named("contacts")).contact_impedance / skin.contact_impedance
    assert np.isclose(contacts, 5).sum() == 4 and np.isclose(contacts, 1).sum() == 12
    sharp, soft = drop_image(touch, 80), soft_drop(touch, 0.06, 80)
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-3) and 0.3 < soft.max() / sharp.max() < 0.99
    sheet = MismatchedSheet("square16", named("blur"), mesh=MESH)
    drop = 1 - sheet.conductivity(touch)[:, 0]
    assert drop @ sheet.model.areas == pytest.approx(touch[0].integral, rel=2e-3)


@pytest.mark.parametrize("parts", [10, 5, 4, 2, 1])
def test_every_measurement_is_in_one_part_and_every_electrode_in_each(bundle: Bundle, parts: int) -> None:
    order = rolling.order(bundle.matrices, bundle.pattern, parts)
    assert sorted(order.tolist()) == list(range(120))
    assert all(len(np.unique(bundle.pattern[part])) == 16 for part in order.reshape(parts, -1))
    assert rolling.most_parts(120, 16) == 10 and rolling.most_parts(192, 16) == 4
    assert rolling.most_parts(120, 16, at_most=5) == 5 and rolling.most_parts(7, 4) == 1
