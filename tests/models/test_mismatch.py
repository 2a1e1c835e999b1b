"""Mismatched sheets: what NAMED says is what the sheet is. Orders of scans in parts."""

import numpy as np
import pytest

from models import geometry, rolling
from models.bundle import Bundle
from models.mismatch import Mismatch, MismatchedSheet, mounted, named, soft_drop
from models.shapes import Shape, drop_image

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
