"""Steps of the board's gain: told from touches, and taken over by the baseline."""

from __future__ import annotations

import pytest

from models.shapes import Shape
from protocol.scan_setting import COHERENT
from tests.services.stub_skin import StubSkin, transfer


def test_a_touch_that_comes_is_no_gain() -> None:
    """Broad and light, as even as touches get."""
    skin = StubSkin(80.0)
    for touch in (Shape("circle", 0, 0, 0.6, 0.05), Shape("circle", 0, 0, 0.3, 0.02), Shape("hertz", 0, 0, 0.5, 0.1)):
        for _ in range(3):
            result = skin.feel((touch,))
        assert result.delta.touched
        skin.rest(60)
    assert skin.pipeline.pre.health().counters["gain_steps"] == 0


@pytest.mark.parametrize("gain", [-0.05, -0.006, -0.001, 0.001, 0.006, 0.05])
def test_a_gain_step_makes_no_contact_and_keeps_the_one_that_is_held(gain: float) -> None:
    skin, touch = StubSkin(80.0), (Shape("circle", 0.3, -0.2, 0.2, 0.3),)
    skin.faults.inject("gain", {"factor": 1 + gain}, 0.0, 1e9)
    for _ in range(5):
        result = skin.rest(1)
        assert result.contact.valid and not result.contact.contacts and not result.delta.touched
    held = [skin.feel(touch) for _ in range(12)][-1].contact
    skin.faults.clear("gain")
    for _ in range(12):
        after = skin.feel(touch).contact
        assert after.valid and len(after.contacts) == 1
        assert after.contacts[0].position[:2] == pytest.approx(held.contacts[0].position[:2], abs=5e-4)
        assert after.contacts[0].force_n == pytest.approx(held.contacts[0].force_n, rel=0.1)


def test_a_gross_gain_that_lasts_is_valid_again_within_two_seconds() -> None:
    skin = StubSkin(80.0)
    skin.faults.inject("gain", {"factor": 1.4}, 0.0, 1e9)
    seen = [skin.rest(1).contact for _ in range(50)]
    assert not seen[0].valid
    assert not any(c.valid and c.contacts for c in seen)
    assert all(c.valid and not c.contacts for c in seen[44:])


def sliding(skin: StubSkin, step: int) -> tuple[Shape, ...]:
    """About 0.3 mm from frame to frame."""
    return (Shape("circle", 0.1 + 0.0055 * step, -0.26, 0.28, 0.45),)


@pytest.mark.parametrize(
    "gain", [-0.04, 0.002, *(pytest.param(gain, marks=pytest.mark.release) for gain in (-0.002, 0.014, 0.05))]
)
def test_a_gain_step_under_a_touch_that_moves_is_taken_over_and_said(gain: float) -> None:
    skin = StubSkin(80.0)
    for step in range(80):
        if step == 20:
            skin.faults.inject("gain", {"factor": 1 + gain}, 0.0, 1e9)
        if step == 55:
            skin.faults.clear("gain")
        contact = skin.feel(sliding(skin, step)).contact
        assert ("gain" in contact.reasons) == (step in (20, 55)), (step, contact.reasons)
        if step > 4:
            assert contact.valid and len(contact.contacts) == 1, (step, contact.reasons)


def test_a_touch_that_moves_changes_no_gain() -> None:
    skin = StubSkin(80.0)
    for speed in (0.002, 0.01, 0.04):
        for step in range(30):
            skin.feel((Shape("circle", -0.5 + speed * step, 0.3, 0.2, 0.3),))
        skin.rest(20)
    assert skin.pipeline.pre.health().counters["gain_steps"] == 0


def test_a_gross_gain_that_was_taken_over_ends_at_once_and_names_no_electrode() -> None:
    skin = StubSkin(80.0)
    skin.faults.inject("gain", {"factor": 2.4}, 0.0, 1e9)
    seen = [skin.rest(1) for _ in range(40)]
    assert "gain" in seen[0].contact.reasons and not seen[0].contact.valid and seen[-1].contact.valid
    skin.faults.clear("gain")
    seen += [skin.rest(1) for _ in range(40)]
    assert all(r.contact.valid and not r.contact.contacts for r in seen[40:])
    assert not any(r.delta.electrodes.any() for r in seen)


def test_a_board_that_reads_zero_for_a_while_is_valid_again_afterwards() -> None:
    """All measurements times zero are no gain: the baseline that took it over was zero, and stayed so until a tare."""
    skin = StubSkin(80.0)
    skin.faults.inject("gain", {"factor": 0.0}, 0.0, 1e9)
    assert not any(skin.rest(1).contact.valid for _ in range(60))
    skin.faults.clear("gain")
    after = [skin.rest(1).contact for _ in range(100)]
    assert not any(c.valid and c.contacts for c in after)
    assert all(c.valid for c in after[80:]), after[-1].reasons


@pytest.mark.parametrize("situation", ["untouched", "held", "sliding"])
@pytest.mark.parametrize("gain", [-0.04, -0.003, 0.003, 0.04])
def test_a_gain_step_in_the_midst_of_a_scan_is_taken_over_by_the_next(gain: float, situation: str) -> None:
    skin = StubSkin(80.0)

    def touching(step: int) -> tuple[Shape, ...]:
        return () if situation == "untouched" else sliding(skin, step if situation == "sliding" else 0)

    for step in range(20):
        skin.feel(touching(step))
    z, status = skin.analog.measure((transfer(touching(20)),) * 2, skin.pattern, COHERENT, 40_000.0, 0.0)
    z[50:] *= 1 + gain
    between = skin.run(z, status).contact
    assert not (between.valid and situation == "untouched" and between.contacts)
    skin.faults.inject("gain", {"factor": 1 + gain}, 0.0, 1e9)
    after = skin.feel(touching(21)).contact
    assert "gain" in {*between.reasons, *after.reasons}
    assert not {"electrode_swapped", "degraded"} & {*between.reasons, *after.reasons}
    for step in range(22, 30):
        contact = skin.feel(touching(step)).contact
        assert contact.valid and "gain" not in contact.reasons and len(contact.contacts) == (situation != "untouched")


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("gain", [-0.18, pytest.param(0.19, marks=pytest.mark.release)])
def test_a_gross_gain_under_a_touch_is_named_and_wrong_nowhere(gain: float, moves: bool) -> None:
    skin = StubSkin(80.0)
    steps = [sliding(skin, step if moves else 0) for step in range(120)]
    before = [skin.feel(touch) for touch in steps[:20]][-1].contact
    skin.faults.inject("gain", {"factor": 1 + gain}, 0.0, 1e9)
    during = [skin.feel(touch).contact for touch in steps[20:70]]
    assert "gain" in during[0].reasons
    skin.faults.clear("gain")
    after = [skin.feel(touch).contact for touch in steps[70:]]
    for contact in (*during, *after):
        present = [c for c in contact.contacts if c.state != "end"]
        assert not contact.valid or len(present) == 1
        assert all(c.force_n == pytest.approx(before.contacts[0].force_n, rel=0.25) for c in present)
    assert all(c.valid for c in after[5:])
