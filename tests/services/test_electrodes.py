"""Wires, contacts and gains that are not as they were are named, left out, forgotten again; touches are never one."""

from typing import Any

import numpy as np
import pytest

from models.shapes import Shape
from protocol.errors import EitskinError
from services.pipeline import Result
from tests.services.stub_skin import SCAN_S, TARE_SCANS, StubSkin, lasting, off_m, present, sheet, states, transfer

PRESS = (Shape("circle", 0.3, -0.2, 0.25, 0.3),)
NAMED_WITHIN = 3  # frames
BACK_WITHIN = 4


@pytest.fixture
def skin() -> StubSkin:
    return StubSkin()


def quiet(results: list[Result]) -> bool:
    """Whether a valid frame shows no contact."""
    return not any(r.contact.valid and r.contact.contacts for r in results)


def well(results: list[Result], touches: int = 0) -> bool:
    return all(r.contact.valid and not states(r) and len(present(r)) == touches for r in results)


# wires

FAULTS: list[tuple[str, dict[str, Any], dict[str, list[int]], str, str]] = [
    ("electrode_open", {"electrode": 6}, {"open": [6]}, "electrode_open", "electrode 6"),
    ("electrodes_shorted", {"electrodes": [3, 11]}, {"short": [3, 11]}, "electrode_short", "electrodes 3 and 11"),
    ("electrodes_shorted", {"electrodes": [15, 0]}, {"short": [0, 15]}, "electrode_short", "electrodes 0 and 15"),
    ("electrodes_swapped", {"electrodes": [1, 2]}, {"swapped": [1, 2]}, "electrode_swapped", "electrodes 1 and 2"),
    ("electrodes_swapped", {"electrodes": [13, 4]}, {"swapped": [4, 13]}, "electrode_swapped", "electrodes 4 and 13"),
    ("electrodes_swapped", {"electrodes": [2, 13]}, {"swapped": [2, 13]}, "electrode_swapped", "electrodes 2 and 13"),
    ("mux_stuck", {"mux": "drive+", "bit": 3, "value": 0}, {"stuck": [*range(8, 16)]}, "multiplexer", "drive+"),
    ("mux_stuck", {"mux": "drive-", "bit": 0, "value": 1}, {"stuck": [*range(0, 16, 2)]}, "multiplexer", "stays 1"),
    ("mux_stuck", {"mux": "sense+", "bit": 1, "value": 1}, {}, "multiplexer", "stays 1"),
    ("mux_stuck", {"mux": "sense-", "bit": 0, "value": 1}, {"stuck": [*range(0, 16, 2)]}, "multiplexer", "stays 1"),
    ("mux_disabled", {"mux": "drive-"}, {"stuck": [*range(16)]}, "multiplexer", "not enabled"),
    ("brown_out", {"silent": True}, {"stuck": [*range(16)]}, "multiplexer", "power-cycle"),
]  # fmt: skip


@pytest.mark.many
@pytest.mark.parametrize(("snr_db", "free"), [(80.0, 8), (80.0, 0), (60.0, 0)], ids=["free", "pressed", "60 dB"])
@pytest.mark.parametrize(("name", "args", "expected", "reason", "text"), FAULTS)
def test_a_fault_of_the_wires_is_named_and_makes_no_wrong_contact(name, args, expected, reason, text, snr_db, free):
    """What presses is seen in spite of it where enough is left, and nothing else; when it is over, all is well."""
    skin = StubSkin(snr_db)
    with skin.fault(name, **args):
        untouched, told = skin.felt(free), skin.pipeline.pre.health()
        pressed = skin.felt(6, PRESS)
    assert all(reason in r.contact.reasons for r in [*untouched[NAMED_WITHIN - 1 :], *pressed])
    named = untouched[NAMED_WITHIN - 1 :] if "shorted" in name else [*untouched, *pressed][NAMED_WITHIN - 1 :]
    assert not expected or all(states(r) == expected for r in named)
    assert quiet(untouched)
    assert not free or (told.level == "WARN" and any(text in line for line in told.messages))
    assert all(len(present(r)) == 1 and off_m(r, PRESS[0]) < 0.003 for r in pressed if r.contact.valid)
    assert "swapped" not in name or all("degraded" in r.contact.reasons for r in pressed[1:])
    assert all(r.contact.valid for r in pressed[2:]) or name in ("electrodes_shorted", "mux_disabled", "brown_out")
    assert well(skin.felt(BACK_WITHIN + 21, PRESS)[BACK_WITHIN + 18 :], 1)
    assert well(skin.felt(BACK_WITHIN + 3)[BACK_WITHIN:]) and skin.pipeline.pre.health().level == "OK"


def test_exchanged_wires_are_named_before_there_is_a_baseline() -> None:
    skin = StubSkin(tare=False)
    with skin.fault("electrodes_swapped", electrodes=[4, 12]):
        first = skin.felt(3)
        assert states(first[-1]) == {"swapped": [4, 12]} and not first[-1].contact.valid
        with pytest.raises(EitskinError, match="wires"):
            skin.pipeline.pre.command("tare", {})  # contacts would be elsewhere, in valid frames
        result = skin.rest(77)
        assert result.contact.valid and "degraded" in result.contact.reasons and states(result) == {"swapped": [4, 12]}
        assert off_m(skin.feel(PRESS), PRESS[0]) < 0.002  # each measurement is there, in another's place
    skin.rest(6)
    assert well(skin.felt(20))
    assert off_m(skin.feel(PRESS), PRESS[0]) < 0.002 and skin.pipeline.pre.health().level == "OK"


@pytest.mark.parametrize("fault", [FAULTS[1], FAULTS[6]], ids=lambda fault: fault[0])
def test_wires_that_leave_too_little_are_named_at_the_start_and_make_no_baseline(fault: Any) -> None:
    skin = StubSkin(tare=False)
    with skin.fault(fault[0], **fault[1]):
        first = skin.felt(80)
    assert not any(r.contact.valid for r in first) and all(fault[3] in r.contact.reasons for r in first[2:])
    assert well([skin.rest(80)]) and skin.pipeline.pre.health().level == "OK"


def dead(skin: StubSkin, shapes: tuple[Shape, ...], *electrodes: int) -> Result:
    """A scan in which every measurement of these electrodes failed."""
    status = np.where(np.isin(skin.pattern, electrodes).any(axis=1), 2, 0).astype(np.uint8)
    return skin.run(skin.measured(transfer(shapes))[0], status)


def test_one_electrode_dead_two_degraded_three_invalid(skin: StubSkin) -> None:
    for count, electrodes in enumerate(((), (5,), (5, 12), (5, 12, 2))):
        skin.rest(4)
        result = dead(skin, PRESS, *electrodes)
        assert states(result) == ({"open": sorted(electrodes)} if electrodes else {})
        assert result.contact.valid == (count <= 2) and ("degraded" in result.contact.reasons) == (count == 2)
        assert count > 2 or off_m(result, PRESS[0]) < 0.004


# contact impedances


@pytest.mark.many
@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(("electrode", "times"), [(12, 1.15), (9, 0.4), (0, 6.0), (9, 20.0)])
def test_a_contact_that_changes_is_named_and_left_out_and_makes_no_touch(skin, electrode, times, held) -> None:
    """A small change may be a finger on the electrode: nothing is valid until the evidence says which."""
    touch, changed = PRESS if held else (), ((electrode, times),)
    assert well(skin.felt(10, touch)[3:], held)
    risen = skin.felt(60, touch, changed)
    named = ({"drifting": [electrode]}, {"open": [electrode]}) if times > 10 else ({"drifting": [electrode]},)
    assert all(states(r) in named for r in risen[NAMED_WITHIN:])
    assert all(r.contact.valid or "electrode_drift" in r.contact.reasons for r in risen)
    assert all(r.contact.valid for r in risen[15:]) and "skin tare" in skin.pipeline.pre.health().messages[0]
    assert all(not r.contact.valid or len(present(r)) == held for r in risen)
    pressed = skin.felt(4, PRESS, changed)
    assert all(r.contact.valid and off_m(r, PRESS[0]) < 0.003 for r in pressed[1:])
    back = skin.felt(BACK_WITHIN + 8, touch)
    assert states(back[-1]) == {} and all(len(present(r)) == held for r in back[1:] if r.contact.valid)
    assert well([skin.rest(BACK_WITHIN + 6)]) and off_m(skin.felt(2, PRESS)[-1], PRESS[0]) < 0.003


@pytest.mark.parametrize(("electrode", "times"), [(0, 1.3), (4, 6.0)])
def test_a_contact_that_stays_as_it_rose_becomes_the_skins_own(skin: StubSkin, electrode: int, times: float) -> None:
    """After ten seconds; what noise makes of its size is no touch then: electrode 0 shows its impedance least."""
    risen = ((electrode, times),)
    before = skin.felt(250, (), risen)[8:]
    assert all(r.contact.valid and not present(r) for r in before)
    assert all(states(r) == {"drifting": [electrode]} for r in before[:70])
    assert well(skin.felt(30, (), risen))
    assert all(off_m(r, PRESS[0]) < 0.003 for r in skin.felt(3, PRESS, risen))
    skin.felt(6, (), risen)
    back = skin.felt(24)
    assert all(r.contact.valid and not present(r) for r in back) and well(back[12:])


def test_a_contact_that_rises_within_scans_is_named_before_it_is_up(skin: StubSkin) -> None:
    """Each measurement of a scan finds it higher than the last."""
    rising = [transfer((), ((9, factor),)) for factor in (1.0, 3.5, 6.0, 6.0)]
    named = [states(skin.see(*rising[k : k + 2])) for k in range(3)]
    assert {"drifting": [9]} in named[:2] and named[-1] == {"drifting": [9]}
    assert states(skin.rest(BACK_WITHIN + 3)) == {}


def test_a_contact_that_drifts_is_named_all_the_while_and_not_long_after(skin: StubSkin) -> None:
    """It rises by 10 % a second, falls back, and rises again: never adopted on its way, however long that takes."""
    rise = np.arange(0, 0.6, 0.1 * SCAN_S)
    felt = [skin.feel((), ((9, 1 + float(risen)),)) for risen in (*rise, *rise[::-1], *rise)]
    assert quiet(felt) and sum(not r.contact.valid for r in felt) * SCAN_S < 1.5
    assert sum(r.contact.valid and bool(r.delta.electrodes[9]) for r in felt) > 0.8 * len(felt)
    assert all(states(r) == {"drifting": [9]} for r in felt[25 : len(rise)])
    after = skin.felt(int(4 / SCAN_S))
    assert after[int(1 / SCAN_S)].delta.electrodes[9] and well(after[-5:])


# touches


def test_a_contact_that_changes_in_the_scan_in_which_another_goes_back_leaves_neither_named(skin: StubSkin) -> None:
    (sound, status), (changed, _) = skin.measured(transfer()), skin.measured(transfer((), ((0, 0.7),)))
    skin.felt(3)
    skin.run(np.concatenate([sound[:60], changed[60:]]), status)
    skin.felt(1, (), ((9, 0.7),))
    assert well(skin.felt(20)[5:])


def test_after_lost_scans_a_frame_that_nothing_explains_names_the_gap(skin: StubSkin) -> None:
    skin.felt(8, PRESS)
    skin.scan += 20
    z, _ = skin.measured(transfer(PRESS))
    odd = skin.run(z * np.random.default_rng(1).uniform(0.9, 1.1, len(z))).contact
    assert not odd.valid and "gap" in odd.reasons
    assert well(skin.felt(4, PRESS)[2:], 1) and "gap" not in skin.feel(PRESS).contact.reasons


def test_a_touch_that_slides_onto_an_electrode_is_no_contact_that_rises(skin: StubSkin) -> None:
    for step in range(56):
        contact = skin.feel((Shape("circle", 0.1 + 0.011 * step, -0.26, 0.28, 0.45),)).contact
        assert contact.valid and not {"electrode_drift", "gain"} & set(contact.reasons)


# Electrode, how far inside its edge and along it, radius, drop: of 700 touches on and near electrodes, those that look
# most like a change of the contact.
ON_ELECTRODES = ((0, 0.00, 0.01, 0.079, 0.082), (14, 0.08, -0.01, 0.068, 0.080), (11, 0.01, -0.01, 0.058, 0.135))


def on_electrode(electrode: int, inside: float, along: float, radius: float, drop: float) -> Shape:
    place = np.asarray(sheet().skin.point(sheet().skin.electrodes)[electrode])
    out = np.where(np.abs(place) > 0.99, np.sign(place), 0.0)
    x, y = place - inside * out + along * out[::-1]
    return Shape("circle", float(x), float(y), radius, drop)


@pytest.mark.parametrize("steps", [1, 3])
def test_contacts_that_jump_while_the_first_scans_come_hold_no_baseline_up(steps: int) -> None:
    skin, rng = StubSkin(tare=False), np.random.default_rng(2)
    electrodes, up = np.array([3, 9, 14]), np.zeros(3, bool)
    for k in range(2 * TARE_SCANS):
        up[rng.integers(3)] ^= k % (20 // steps) == 0
        jumped = tuple((int(electrode), 1.02) for electrode in electrodes[up])
        result = skin.feel((), jumped)
        assert not present(result)
    assert result.contact.valid
    pressed = skin.felt(6, PRESS, jumped)
    assert pressed[-1].contact.valid and off_m(pressed[-1], PRESS[0]) < 1e-3


@pytest.mark.parametrize("times", [1.02, 1.05])
@pytest.mark.parametrize("electrode", [4, 9, 14])
def test_a_contact_that_jumps_a_little_and_back_is_the_contacts(skin: StubSkin, electrode: int, times: float) -> None:
    """A touch too light to be seen elsewhere may look so, but none comes from one scan to the next, nor each time."""
    skin.felt(3)
    jumped = skin.felt(30, (), ((electrode, times),))
    assert sum(not result.contact.valid for result in jumped) <= 4
    assert states(jumped[-1]) == {"drifting": [electrode]} and not any(present(result) for result in jumped)
    assert all(result.contact.valid and not result.contact.contacts for result in skin.felt(20)[1:])
    assert all(result.contact.valid and not present(result) for result in skin.felt(30, (), ((electrode, times),)))


@pytest.mark.many
@pytest.mark.parametrize("ramp", [1, 2, 4, 6, 9, 14])
@pytest.mark.parametrize("touch", ON_ELECTRODES)
def test_a_touch_right_on_an_electrode_is_no_drifting_contact(skin: StubSkin, touch: Any, ramp: int) -> None:
    """It is shown, or the frame says that it may be a contact and is not valid: never is it hidden in a valid one."""
    free, pressed, seen = transfer(), transfer((on_electrode(*touch),)), False
    forces = [*np.linspace(0, 1, ramp + 1)[1:], *[1.0] * 30, *np.linspace(1, 0, ramp + 1)[1:], *[0.0] * 6]
    for k, force in enumerate(forces):
        result = skin.see(free + force * (pressed - free))
        assert not (result.contact.valid and result.delta.electrodes.any()), force
        seen |= "electrode_drift" in result.contact.reasons or bool(present(result))
        if ramp <= k < ramp + 30:
            assert present(result) or not result.contact.valid or "changing" in result.contact.reasons, k
    assert seen, "the touch is not seen: it proves nothing"
    assert result.contact.valid and not result.contact.contacts


@pytest.mark.many
@pytest.mark.parametrize(("electrode", "radius", "drop"), [(9, 0.12, 0.2), (9, 0.2, 0.1), (2, 0.16, 0.12)])
def test_what_a_contact_that_drifted_under_a_light_touch_leaves_is_no_touch(skin, electrode, radius, drop) -> None:
    """It rises by 10 % a second while 1 N presses beside it, and on when that has gone."""
    touch = on_electrode(electrode, 0.12, 0.03, radius, drop)
    risen = [(electrode, 1 + 0.1 * SCAN_S * k) for k in range(130)]
    held = [skin.feel((touch,), (contact,)) for contact in risen[:90]]
    after = [skin.feel((), (contact,)) for contact in risen[90:]]
    assert all(len(present(r)) == 1 for r in held[-40:])
    assert not any(r.contact.valid and present(r) for r in after[3:])
    assert all(states(r) == {"drifting": [electrode]} for r in after[-20:])


@pytest.mark.many
@pytest.mark.parametrize("snr_db", [70.0, 110.0])
def test_no_touch_is_named_a_fault(snr_db: float) -> None:
    """On, beside and across electrodes, and anywhere; one to three at a time, on a skin that was free."""
    skin, rng = StubSkin(snr_db), np.random.default_rng(4)
    centres = sheet().skin.point(sheet().skin.electrodes)
    for n in range(20):
        shapes = []
        for _ in range(rng.integers(1, 4)):
            near = centres[rng.integers(16)] + rng.normal(0, 0.06, 2) * (rng.random() < 0.7)
            x, y = np.clip(near if n % 3 else rng.uniform(-0.9, 0.9, 2), -1, 1)
            kind, (radius, drop) = str(rng.choice(["circle", "hertz", "square"])), rng.uniform(0.05, (0.5, 0.85))
            shapes.append(Shape(kind, float(x), float(y), float(radius), float(drop)))
        skin.rest(BACK_WITHIN + 3)
        # a drop of 0.85 S/m on an electrode may clip the current: that is another matter
        assert states(skin.run(skin.measured(transfer(tuple(shapes)))[0])) == {}, shapes
    assert skin.pipeline.pre.health().level == "OK"


def test_a_second_disc_that_may_be_none_is_not_shown(skin: StubSkin) -> None:
    """A broad L is better explained by two discs, the second of which is as large as its own uncertainty."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.6, 0.6, 2)
    radius, drop = rng.uniform(0.2, 0.36), rng.uniform(0.2, 0.6)
    felt = skin.felt(20, (Shape("L", x, y, radius, drop, rotation=float(rng.uniform(0, 6.28))),))
    assert all(r.contact.valid and len(present(r)) == 1 for r in felt)


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
