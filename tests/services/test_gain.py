"""Steps of the board's gain: named, told from touches, and taken over by the baseline."""

import pytest

from models.shapes import Shape
from services.pipeline import Result
from tests.services.stub_skin import StubSkin, lasting, present, states, transfer

PRESS = (Shape("circle", 0.3, -0.2, 0.2, 0.3),)


@pytest.fixture
def skin() -> StubSkin:
    return StubSkin()


def sliding(step: int) -> tuple[Shape, ...]:
    """About 0.3 mm from frame to frame."""
    return (Shape("circle", 0.1 + 0.0055 * step, -0.26, 0.28, 0.45),)


def free(results: list[Result]) -> bool:
    return all(r.contact.valid and not r.contact.contacts and not r.delta.touched for r in results)


def named(results: list[Result]) -> list[int]:
    return [k for k, r in enumerate(results) if "gain" in r.contact.reasons]


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("gain", [-0.1, -0.001, 0.006])
def test_a_step_is_named_at_once_and_moves_no_touch(skin: StubSkin, gain: float, held: bool) -> None:
    touch, twin = PRESS if held else (), StubSkin()  # the twin's gain stays
    before, same = skin.felt(8, touch), twin.felt(28, touch)[-1]
    assert not named(before)
    with skin.fault("gain", factor=1 + gain):
        felt = skin.felt(20, touch)
    back = skin.felt(20, touch)
    for results in (felt, back):
        assert len(named(results)) <= 2 and (0 in named(results) or abs(gain) < 2e-3)
        assert all(r.contact.valid and len(present(r)) == held and not states(r) for r in results)
        if held:
            (contact,), (of_twin,) = present(results[-1]), present(same)
            assert contact.position[:2] == pytest.approx(of_twin.position[:2], abs=3e-4)
            assert contact.force_n == pytest.approx(of_twin.force_n, rel=0.05)


@pytest.mark.parametrize("gain", [-0.04, 0.002])
def test_a_step_under_a_touch_that_moves_is_taken_over_and_said(skin: StubSkin, gain: float) -> None:
    felt = [skin.feel(sliding(k)) for k in range(20)]
    with skin.fault("gain", factor=1 + gain):
        felt += [skin.feel(sliding(k)) for k in range(20, 45)]
    felt += [skin.feel(sliding(k)) for k in range(45, 65)]
    assert named(felt) == [20, 45]
    assert all(r.contact.valid and len(r.contact.contacts) == 1 for r in felt[5:])


@pytest.mark.parametrize("situation", ["untouched", "held", "sliding"])
@pytest.mark.parametrize("gain", [-0.04, 0.003])
def test_a_step_in_the_midst_of_a_scan_is_taken_over_by_the_next(skin: StubSkin, gain: float, situation: str) -> None:
    def touching(step: int) -> tuple[Shape, ...]:
        return () if situation == "untouched" else sliding(step if situation == "sliding" else 0)

    for step in range(20):
        skin.feel(touching(step))
    z, status = skin.measured(transfer(touching(20)))
    z[50:] *= 1 + gain
    between = skin.run(z, status).contact
    assert not (between.valid and situation == "untouched" and between.contacts)
    with skin.fault("gain", factor=1 + gain):
        after, *later = [skin.feel(touching(step)) for step in range(21, 30)]
    said = {*between.reasons, *after.contact.reasons}
    assert "gain" in said and not {"electrode_swapped", "degraded"} & said
    assert not named(later) and all(r.contact.valid and len(present(r)) == (situation != "untouched") for r in later)


@pytest.mark.parametrize(("factor", "before", "rest"), [(0.9983, 1, 8), (1.002, 4, 8)])
def test_a_small_step_is_no_drift_that_goes_on(skin: StubSkin, factor: float, before: int, rest: int) -> None:
    """Scans of before it was told explain it as a fast drift: learnt from, that would go on under a touch."""
    skin.rest(before)
    deep = (Shape("circle", -0.4, 0.27, 0.19, 0.53),)
    with skin.fault("gain", factor=factor):
        untouched, held, released = skin.felt(rest), skin.felt(60, deep), skin.felt(20)
    felt = [*untouched, *held, *released]
    assert len(named(felt)) <= 1 and all(r.contact.valid for r in felt)
    assert all(len(present(r)) == 1 for r in held) and not any(present(r) for r in released[2:])


def test_touches_that_come_and_move_are_no_steps(skin: StubSkin) -> None:
    """Broad and light, as even as touches get."""
    for touch in (Shape("circle", 0, 0, 0.6, 0.05), Shape("circle", 0, 0, 0.3, 0.02), Shape("hertz", 0, 0, 0.5, 0.1)):
        assert skin.felt(3, (touch,))[-1].delta.touched
        skin.rest(20)
    for speed in (0.002, 0.01, 0.04):
        for step in range(30):
            skin.feel((Shape("circle", -0.5 + speed * step, 0.3, 0.2, 0.3),))
        skin.rest(20)
    assert skin.pipeline.pre.health().counters["gain_steps"] == 0


# gross ones


@pytest.mark.parametrize("factor", [0.0, 2.4])
def test_a_gross_gain_makes_no_touch_is_valid_again_within_two_seconds_and_ends(skin: StubSkin, factor: float) -> None:
    """All measurements times zero are no gain: a baseline that took it over was zero, and stayed so until a tare."""
    with skin.fault("gain", factor=factor):
        seen = skin.felt(50)
    after = skin.felt(100)
    assert not any(r.contact.valid and r.contact.contacts for r in [*seen, *after])
    if factor:
        assert named(seen)[0] == 0 and not seen[0].contact.valid and free([*seen[44:], *after])
    else:
        assert not any(r.contact.valid for r in seen) and free(after[80:])


@pytest.mark.parametrize("moves", [False, True])
def test_a_gross_gain_under_a_touch_is_named_and_wrong_nowhere(skin: StubSkin, moves: bool) -> None:
    steps = [sliding(step if moves else 0) for step in range(85)]
    before = [skin.feel(touch) for touch in steps[:20]][-1].contact.contacts[0]
    with skin.fault("gain", factor=0.82):
        during = [skin.feel(touch).contact for touch in steps[20:60]]
    after = [skin.feel(touch).contact for touch in steps[60:]]
    assert "gain" in during[0].reasons and all(c.valid for c in after[5:])
    for contact in (*during, *after):
        assert not contact.valid or len(lasting(contact)) == 1
        assert all(c.force_n == pytest.approx(before.force_n, rel=0.25) for c in lasting(contact))


@pytest.mark.parametrize("gain", [0.9, 1.2])
def test_a_gain_resistor_that_is_not_what_was_calibrated_is_no_touch_and_a_tare_takes_it(skin, gain) -> None:
    for _ in range(3):  # it comes and goes
        with skin.fault("stale_rtia", gain=gain):
            faulty = skin.felt(4)
        assert {"gain", "out_of_distribution"} & set(faulty[0].contact.reasons)
        assert not any(present(r) for r in (*faulty, *skin.felt(5)[1:]) if r.contact.valid)
    with skin.fault("stale_rtia", gain=gain):
        assert not any(r.contact.valid and r.contact.contacts for r in skin.felt(80))
        skin.pipeline.pre.command("tare", {"force": True})
        assert free(skin.felt(20))


def test_the_end_of_marked_frames_is_no_step(skin: StubSkin) -> None:
    """An overrange scales the measurements that it marks; the baseline never followed, so it must not follow back."""
    with skin.fault("rtia_overrange", gain=2.5):
        assert not any(r.contact.valid for r in skin.felt(6))
    after = skin.felt(60)  # longer than a gross step takes to be believed
    assert free(after[5:]) and skin.pipeline.pre.health().counters.get("gain_steps", 0) == 0
