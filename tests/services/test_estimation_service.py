"""The stages on a skin that drifted unseen: contacts where it is touched, none where it is not, at once."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from models.pressure import FOAM, disc
from models.shapes import Shape
from services.recordings.npz_file import Input
from services.recordings.reconstruction import reconstruct
from services.runtime.config import Skin
from tests.services.stub_skin import StubSkin, sheet

Array = NDArray[np.float64]
TOUCHES = (
    Shape("circle", 0.3, -0.2, 0.2, 0.1),
    Shape("circle", -0.5, 0.4, 0.3, 0.5),
    Shape("circle", 0.1, 0.5, 0.1, 0.3),
)


def impedances(shapes: tuple[Shape, ...], background: float, factor: Array) -> Array:
    model = sheet().model
    solution = model.solve(model.touched(list(shapes), background), sheet().skin.contact_impedance * factor)
    return np.abs(solution.impedances())


@pytest.mark.parametrize(("background", "changed"), [(0.97, 0), (0.99, 0), (1.01, 0), (1.03, 0), (1.0, 16), (1.0, 3)])
def test_rows_of_a_skin_that_drifted_since_its_untouched_ones(background: float, changed: int) -> None:
    rng = np.random.default_rng(1)
    factor = np.ones(16)
    factor[rng.permutation(16)[:changed]] = 1.1
    bundle = StubSkin(80.0, tare=False).pipeline.pre.bundle
    z0 = impedances((), 1.0, np.ones(16))
    rows = np.array([impedances((), background, factor), *(impedances((t,), background, factor) for t in TOUCHES)])
    untouched = z0 * (1 + 1e-4 * rng.standard_normal((64, len(z0))))
    rows = rows * (1 + 1e-4 * rng.standard_normal(rows.shape))
    out = reconstruct(Input(rows, untouched, None), Skin(port="stub", bundle="square16", frame_id="palm"), bundle)
    assert out["valid"].all() and out["count"].tolist() == [0, 1, 1, 1]
    for k, touch in enumerate(TOUCHES):
        assert out["position"][k + 1, 0] == pytest.approx([0.05 * touch.x, 0.05 * touch.y], abs=0.003)
    newtons = FOAM.force("circle", TOUCHES[1].drop, disc(0.05 * TOUCHES[1].radius))
    assert out["force"][2, 0] == pytest.approx(newtons, rel=0.15)


def test_a_service_that_comes_back_after_fifty_minutes_under_a_touch() -> None:
    skin = StubSkin(80.0)
    stage, touch = skin.pipeline.pre, TOUCHES[0]
    saved = stage.saved()
    assert saved is not None
    skin.pipeline.reset()
    stage.restore(saved, 3000.0)
    pressed, free = (np.asarray(impedances(t, 1.005, np.full(16, 0.98))) for t in ((touch,), ()))
    rng = np.random.default_rng(2)

    def feel(z: Array) -> list[list[float]]:
        result = skin.run((z * (1 + 1e-4 * rng.standard_normal(len(z)))).astype(np.complex64))
        assert result.contact.valid
        return [c.position[:2] for c in result.contact.contacts if c.state != "end"]

    first = skin.run(pressed.astype(np.complex64)).contact  # it may have begun during this scan
    there = [c.position[:2] for c in first.contacts if c.state != "end"]
    where = pytest.approx([0.05 * touch.x, 0.05 * touch.y], abs=0.003)
    assert not first.valid or "changing" in first.reasons or there == [where], "nothing is hidden in a valid frame"
    assert all(place == where for place in there)
    for seen in [feel(pressed) for _ in range(20)]:
        assert len(seen) == 1 and seen[0] == where
    assert not any([feel(free) for _ in range(30)][3:])
