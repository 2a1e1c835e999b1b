"""A held touch's image as the mean over the skin's symmetries."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from models.bundle import Bundle
from models.shapes import Shape
from models.turns import TURNS, Turn
from protocol.frames import DeltaFrame
from services.runtime.config import Skin, TouchConfig
from services.symmetry import symmetries
from tests.services.stub_skin import StubSkin

TOUCH = Shape("triangle", 0.3, -0.2, 0.35, 0.3, 0.4)


def test_the_square_has_all_and_one_electrode_elsewhere_leaves_its_own(bundle: Bundle) -> None:
    assert symmetries(bundle.skin) == TURNS[1:]
    other = copy.deepcopy(bundle.skin)
    other["electrodes"]["centre"][0][0] += 0.01
    assert len(symmetries(other)) <= 1
    assert symmetries({}) == ()


@pytest.mark.parametrize("turn", TURNS)
def test_a_turned_touch_makes_the_turned_input(bundle: Bundle, turn: Turn) -> None:
    """The images that the network reads are turned as places are: of the bundle's own numerics."""
    operator = bundle.prereconstructor().condition(np.full(120, 1e-4))
    drop = TOUCH.drop * TOUCH.fraction(24)
    d, d_turned = (bundle.matrices.jacobian @ image.ravel() for image in (drop, turn.image(drop)))
    stack, stack_turned = (operator.stack(each)[0] for each in (d, d_turned))
    assert np.abs(stack_turned - turn.image(stack)).max() < 0.02 * np.abs(stack).max()


def test_a_held_touch_gets_the_mean_without_any_frame_that_waits() -> None:
    stub = StubSkin(95.0, skin=Skin(port="stub", bundle="square16", frame_id="palm", touch=TouchConfig(symmetry=True)))
    inference, runs = stub.pipeline.inference, []
    seen = []
    for _ in range(16):
        before = inference.health().counters["networks_run"]
        found = stub.feel((TOUCH,))
        runs.append(inference.health().counters["networks_run"] - before)
        assert found.delta.held or runs[-1] == 1
        seen.append(found)
        stub.pipeline.prepare()
    surer = [n for n, found in enumerate(seen) if found.delta.held and not found.image.held]
    assert surer and inference.health().counters["symmetric"] == len(surer)
    n = surer[0]
    assert seen[n].image.held is False and seen[n].image.reconstructed == seen[n - 1].image.reconstructed
    assert seen[n].contact.valid and seen[n].contact.contacts[0].id == seen[0].contact.contacts[0].id
    assert seen[n + 1].image.held or seen[n + 1].image.image.size
    truth = TOUCH.drop * TOUCH.fraction(96)
    single = next(found for found in reversed(seen[:n]) if not found.delta.held)

    def off(image: np.ndarray) -> float:
        return float(np.abs(image - truth).sum())

    assert off(seen[n].image.image) < 1.02 * off(single.image.image)


def test_nothing_is_averaged_where_an_electrode_is_missing(bundle: Bundle) -> None:
    stub = StubSkin(95.0, skin=Skin(port="stub", bundle="square16", frame_id="palm", touch=TouchConfig(symmetry=True)))
    mean = stub.pipeline.inference._symmetry
    assert mean is not None
    frame = DeltaFrame(skin="palm", sigma=np.array([1e-4, np.inf], np.float32))
    mean.begin(frame, (np.zeros((1, 1), np.float32),) * 3)  # type: ignore[arg-type]
    assert not mean.busy and mean.step() is None
