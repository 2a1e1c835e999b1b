"""A held touch's image as the mean over the skin's symmetries."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from models.bundle import Bundle
from models.shapes import Shape
from models.symmetries import symmetries
from models.turns import TURNS, Turn
from services.describe import symmetry
from services.networks import Network, Stack
from services.runtime.config import Skin, TouchConfig
from tests.services.stub_skin import StubSkin

TOUCH = Shape("triangle", 0.3, -0.2, 0.35, 0.3, 0.4)


def test_the_square_has_all_and_one_electrode_elsewhere_leaves_its_own(bundle: Bundle) -> None:
    assert [each.turn for each in symmetries(bundle.skin, bundle.pattern)] == list(TURNS)
    other = copy.deepcopy(bundle.skin)
    other["electrodes"]["centre"][0][0] += 0.01
    assert len(symmetries(other, bundle.pattern)) == 1
    assert symmetries({}, bundle.pattern) == []
    on = Skin(port="stub", bundle="square16", touch=TouchConfig(symmetry=True))
    assert symmetry(on, bundle) == "on"
    assert "has no symmetry" in symmetry(on, replace(bundle, manifest={**bundle.manifest, "skin": other}))


def test_it_is_said_why_nothing_is_averaged(bundle: Bundle) -> None:
    on = Skin(port="stub", bundle="square16", touch=TouchConfig(symmetry=True))
    assert "does not say" in symmetry(Skin(port="stub", bundle="square16"), bundle)
    assert "there is no network" in symmetry(on, Bundle.load("disc16"))
    assert "there is no network" in symmetry(on.model_copy(update={"network": "none"}), bundle)
    assert "`hold = false`" in symmetry(on.model_copy(update={"touch": TouchConfig(symmetry=True, hold=False)}), bundle)
    registered = replace(bundle, locator=object())  # type: ignore[arg-type]
    assert "registered to one very skin" in symmetry(on, registered)
    info = StubSkin(95.0, skin=on).pipeline.pre.info()
    assert info is not None and info["symmetry"] == "on"


def turned(stack: Stack | None, turn: Turn) -> Stack:
    assert stack is not None
    return stack._replace(images=np.ascontiguousarray(turn.image(stack.images)))


@pytest.mark.parametrize("turn", TURNS)
def test_a_turned_touch_makes_the_turned_input(bundle: Bundle, turn: Turn) -> None:
    """The images that the network reads are turned as places are: of the bundle's own numerics."""
    operator = bundle.prereconstructor().condition(np.full(120, 1e-4))
    drop = TOUCH.drop * TOUCH.fraction(24)
    d, d_turned = (bundle.matrices.jacobian @ image.ravel() for image in (drop, turn.image(drop)))
    stack, stack_turned = (operator.stack(each)[0] for each in (d, d_turned))
    assert np.abs(stack_turned - turn.image(stack)).max() < 0.02 * np.abs(stack).max()


@pytest.mark.xfail(strict=False, reason="at 95 dB no single touch explains some scans of a triangle: it begins again")
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
    assert single.delta.scan == seen[n].image.reconstructed
    assert isinstance(inference._network, Network)
    stack = inference.stack(single.delta)
    made = [[turn.back.image(picture) for picture in inference._network.run(turned(stack, turn))] for turn in TURNS]
    mean = [np.mean(pictures, axis=0) for pictures in zip(*made, strict=True)]
    for found, expected in zip((seen[n].image.image, seen[n].image.sigma, seen[n].image.classes), mean, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)

    def off(image: np.ndarray) -> float:
        return float(np.abs(image - truth).sum())

    assert off(seen[n].image.image) < 0.85 * off(single.image.image)  # 0.69 to 0.80 with four noises


def test_nothing_is_averaged_where_an_electrode_is_missing(bundle: Bundle) -> None:
    stub = StubSkin(95.0, skin=Skin(port="stub", bundle="square16", frame_id="palm", touch=TouchConfig(symmetry=True)))
    inference, found = stub.pipeline.inference, stub.feel((TOUCH,))
    mean = inference._symmetry
    assert mean is not None and found.delta.averaged and mean.busy
    found.delta.sigma[0] = np.inf
    mean.forget()
    inference.process(found.delta, frozenset({"image"}))
    assert not mean.busy and mean.step() is None
