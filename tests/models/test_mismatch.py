"""Mismatched sheets: what NAMED says is what the sheet is."""

from __future__ import annotations

import numpy as np
import pytest

from models import geometry
from models.forward import ForwardModel
from models.mismatch import NAMED, Mismatch, MismatchedSheet, MismatchError, mounted, named, smooth_field, soft_drop
from models.shapes import Shape, drop_image

MESH = "inverse"


def test_a_sheet_without_mismatch_is_the_sheet_of_its_file() -> None:
    touch = [Shape("triangle", 0.2, 0.1, 0.3, 0.15)]
    plain = ForwardModel("disc16", mesh=MESH)
    sheet = MismatchedSheet("disc16", named("none"), mesh=MESH)
    for found, expected in (
        (sheet.solve(), plain.solve(1.0)),
        (sheet.solve(touch, background=1.2), plain.solve(plain.touched(touch, 1.2))),
    ):
        np.testing.assert_allclose(found.impedances(), expected.impedances(), rtol=1e-9)


def test_an_anisotropic_sheet_is_a_stretched_isotropic_one() -> None:
    """A sheet that conducts a times better along x is, by a change of coordinates, an isotropic one: its resistance
    between opposite sides of the square shows a directly.
    """
    skin = geometry.load("square16")
    along = MismatchedSheet(skin, Mismatch(anisotropy=0.15), mesh=MESH)
    across = MismatchedSheet(skin, Mismatch(anisotropy=0.15, angle=np.pi / 2), mesh=MESH)
    tensor = along.conductivity()
    np.testing.assert_allclose(tensor, np.tile([1.15, 0.0, 1 / 1.15], (len(tensor), 1)), atol=1e-12)
    # Turned by a right angle, the square has its electrodes where others were: (x, y) -> (-y, x) moves them by four.
    turned = (skin.pattern + 4) % 16
    np.testing.assert_allclose(across.solve().impedances(turned), along.solve().impedances(), rtol=1e-3)
    assert np.abs(along.solve().impedances() / across.solve().impedances() - 1).max() > 0.02


def test_a_field_has_the_size_it_says_and_is_the_same_on_every_mesh() -> None:
    skin = geometry.load("disc16")
    axis = np.linspace(-1, 1, 97)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    points = points[skin.inside(points)]
    field = smooth_field(skin, 0.1, seed=4)(points)
    assert abs(field.mean()) < 0.005 and field.std() == pytest.approx(0.1, rel=0.05)
    assert not np.allclose(field, smooth_field(skin, 0.1, seed=5)(points))
    coarse, fine = (MismatchedSheet(skin, named("field10"), mesh=m).solve().impedances() for m in (MESH, "stub"))
    np.testing.assert_allclose(coarse, fine, rtol=2e-3)


def test_electrodes_move_along_the_outline_and_never_overlap() -> None:
    skin = geometry.load("square16")
    for seed in range(20):
        moved = mounted(skin, named("shift3").seeded(seed))
        off = moved.electrodes - skin.electrodes
        assert 0.02 < off.std() < 0.12 and np.abs(off).max() <= 0.12 + 1e-9
    contacts = mounted(skin, named("contacts")).contact_impedance / skin.contact_impedance
    assert np.isclose(contacts, 5).sum() == 4 and np.isclose(contacts, 1).sum() == 12


def test_a_blurred_touch_keeps_its_integral_and_loses_its_peak() -> None:
    touch = [Shape("circle", 0.1, 0.0, 0.15, 0.4)]
    sharp, soft = drop_image(touch, 80), soft_drop(touch, 0.06, 80)
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    assert 0.3 < soft.max() / sharp.max() < 0.99
    sheet = MismatchedSheet("square16", named("blur"), mesh=MESH)
    left = sheet.conductivity(touch)
    np.testing.assert_allclose((1 - left[:, 0]) @ sheet.model.areas, touch[0].integral, rtol=2e-3)


def test_an_unknown_mismatch_names_those_there_are() -> None:
    with pytest.raises(MismatchError, match="anisotropy5.*mild"):
        named("severe")
    assert set(NAMED) >= {"anisotropy5", "field5", "field10", "shift1", "contacts", "mild", "blur"}
