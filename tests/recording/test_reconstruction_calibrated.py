"""`skin reconstruct` finds from the untouched rows how the skin is mounted."""

from __future__ import annotations

import numpy as np
import pytest

from models.bundle import Bundle
from models.mismatch import MismatchedSheet, named
from models.pressure import FOAM, disc
from models.shapes import Shape
from services.recordings.npz_file import Input
from services.recordings.reconstruction import mounted_bundle, reconstruct
from services.runtime.config import Skin

TOUCH = [Shape("circle", 0.3, -0.3, 0.25, 0.3)]
SKIN = Skin(port="stub", bundle="square16", frame_id="palm")


def rows(name: str) -> Input:
    sheet = MismatchedSheet("square16", named(name), "stub")
    rng = np.random.default_rng(2)
    z0, z = (np.abs(sheet.solve(shapes).impedances()) for shapes in ((), TOUCH))
    untouched = z0 * (1 + 1e-4 * rng.standard_normal((64, len(z0))))
    return Input(measurements=z[None], untouched=untouched, reference=None)


@pytest.mark.release
def test_rows_of_an_anisotropic_skin_become_valid_and_right() -> None:
    data, bundle, said = rows("anisotropy15"), Bundle.load("square16"), list[str]()
    plain = reconstruct(data, SKIN, bundle, age_s=1.0)
    assert not plain["valid"].any()
    out = reconstruct(data, SKIN, bundle, warn=said.append, age_s=1.0, calibrate=True)
    assert out["valid"].all() and out["count"][0] == 1
    assert np.hypot(*(out["position"][0, 0] - [0.015, -0.015])) < 1e-3
    newtons = FOAM.force("circle", TOUCH[0].drop, disc(0.05 * TOUCH[0].radius))
    assert out["force"][0, 0] == pytest.approx(newtons, rel=0.15)
    assert any("15 % better along" in text for text in said)


def test_rows_that_the_bundle_predicts_are_reconstructed_with_it_as_it_is() -> None:
    data, bundle = rows("none"), Bundle.load("square16")
    assert data.untouched is not None
    assert mounted_bundle(data.untouched, bundle, pytest.fail) is bundle
    measured = Bundle.load("disc16")
    counts = np.abs(measured.z0) * np.ones((8, 1)) * 1e5 * np.linspace(0.5, 1.5, len(measured.z0))
    assert mounted_bundle(counts, measured, pytest.fail) is measured  # it predicts nothing to calibrate against
