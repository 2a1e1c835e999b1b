"""Electrode faults of the stub's board are named, left out and forgotten again; touches are never one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models.shapes import Shape
from protocol.errors import EitskinError
from protocol.frames import ELECTRODE_STATES, DeltaFrame, RawFrame
from protocol.scan_setting import COHERENT
from services.pipeline import Result
from tests.services.stub_skin import StubSkin, sheet, transfer

PRESS = (Shape("circle", 0.3, -0.2, 0.25, 0.3),)
NAMED_WITHIN = 3  # frames
BACK_WITHIN = 4


@pytest.fixture(scope="module")
def skin() -> StubSkin:
    return StubSkin(80.0)


def states(result: Result) -> dict[str, list[int]]:
    """The electrodes in each state but ok."""
    return states_of(result.delta)


def states_of(delta: DeltaFrame) -> dict[str, list[int]]:
    found = delta.electrodes
    return {name: np.flatnonzero(found == k).tolist() for k, name in enumerate(ELECTRODE_STATES) if k and k in found}


def position_error_m(result: Result) -> float:
    """Of the one contact that PRESS makes."""
    (contact,) = [c for c in result.contact.contacts if c.state != "end"]
    return float(np.hypot(contact.position[0] - 0.05 * PRESS[0].x, contact.position[1] - 0.05 * PRESS[0].y))


FAULTS: list[tuple[str, dict[str, Any], dict[str, list[int]], str, str]] = [
    ("electrode_open", {"electrode": 6}, {"open": [6]}, "electrode_open", "electrode 6"),
    ("electrodes_shorted", {"electrodes": [3, 11]}, {"short": [3, 11]}, "electrode_short", "electrodes 3 and 11"),
    ("electrodes_shorted", {"electrodes": [15, 0]}, {"short": [0, 15]}, "electrode_short", "electrodes 0 and 15"),
    ("electrodes_swapped", {"electrodes": [1, 2]}, {"swapped": [1, 2]}, "electrode_swapped", "electrodes 1 and 2"),
    ("electrodes_swapped", {"electrodes": [13, 4]}, {"swapped": [4, 13]}, "electrode_swapped", "electrodes 4 and 13"),
    ("mux_stuck", {"mux": "drive+", "bit": 3, "value": 0}, {"stuck": [*range(8, 16)]}, "multiplexer", "drive+"),
    ("mux_stuck", {"mux": "sense-", "bit": 0, "value": 1}, {"stuck": [*range(0, 16, 2)]}, "multiplexer", "stays 1"),
    ("mux_disabled", {"mux": "drive-"}, {"stuck": [*range(16)]}, "multiplexer", "not enabled"),
    ("mux_disabled", {"mux": "sense+"}, {"stuck": [*range(16)]}, "multiplexer", "not enabled"),
    ("brown_out", {"silent": True}, {"stuck": [*range(16)]}, "multiplexer", "power-cycle"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "args", "expected", "reason", "text"), FAULTS)
def test_a_fault_is_named_and_makes_no_contact(
    skin: StubSkin, name: str, args: dict[str, Any], expected: dict[str, list[int]], reason: str, text: str
) -> None:
    skin.faults.inject(name, args, 0.0, 1.0)
    try:
        free = [skin.feel() for _ in range(8)]
        told = skin.pipeline.pre.health()
    finally:
        skin.faults.clear()
    assert all(states(r) == expected and reason in r.contact.reasons for r in free[NAMED_WITHIN - 1 :])
    assert not any(r.contact.valid and r.contact.contacts for r in free)
    assert told.level == "WARN" and any(text in line for line in told.messages)
    back = [skin.feel() for _ in range(BACK_WITHIN + 3)]
    assert all(r.contact.valid and not r.delta.touched and not states(r) for r in back[BACK_WITHIN:])
    assert skin.pipeline.pre.health().level == "OK"


@pytest.mark.parametrize("factor", [0.4, 4.0, 20.0])
def test_a_contact_that_changes_is_named_left_out_and_not_tracked(skin: StubSkin, factor: float) -> None:
    changed = ((9, factor),)
    found = [skin.feel(contacts=changed) for _ in range(100)]
    assert all(states(r) == {"drifting": [9]} for r in found[NAMED_WITHIN - 1 :])
    assert not any(r.contact.valid and r.contact.contacts for r in found)
    assert found[-1].contact.reasons == ["electrode_drift"] and found[-1].contact.valid
    assert "skin tare" in skin.pipeline.pre.health().messages[0]
    pressed = skin.see(transfer(PRESS, changed))
    assert pressed.contact.valid and position_error_m(pressed) < 0.003
    assert states(skin.rest(BACK_WITHIN + 1)) == {}  # as before: the baseline has not followed the fault
    assert position_error_m(skin.feel(PRESS)) < 0.003
    skin.rest(3)


@pytest.mark.parametrize("electrode", [0, 5, 9])
def test_a_contact_that_rises_under_a_touch_is_named_and_makes_no_second_one(skin: StubSkin, electrode: int) -> None:
    pressed = [skin.feel(PRESS) for _ in range(10)]
    assert states(pressed[-1]) == {} and pressed[-1].contact.valid
    lifted = [skin.feel(PRESS, contacts=((electrode, 6.0),)) for _ in range(20)]
    assert all(states(r) == {"drifting": [electrode]} for r in lifted[NAMED_WITHIN - 1 :])
    assert all(position_error_m(r) < 0.003 for r in lifted[NAMED_WITHIN - 1 :])  # of one contact: no phantom
    assert states(skin.rest(BACK_WITHIN + 3)) == {}


@pytest.mark.parametrize("times", [1.15, 1.75])
@pytest.mark.parametrize("held", [False, True])
def test_a_contact_that_rises_a_little_is_named_and_makes_no_contact(skin: StubSkin, times: float, held: bool) -> None:
    """It may be a finger right on the electrode as well, so nothing is valid until the evidence says which."""
    touch = PRESS if held else ()
    before = [skin.feel(touch) for _ in range(30)]
    assert before[-1].contact.valid and states(before[-1]) == {}
    lifted = [skin.feel(touch, ((12, times),)) for _ in range(30)]
    assert all(states(r) == {"drifting": [12]} for r in lifted[NAMED_WITHIN:])
    assert not lifted[1].contact.valid and "electrode_drift" in lifted[1].contact.reasons
    assert all(not r.contact.valid or present(r) == len(touch) for r in lifted)
    assert all(r.contact.valid for r in lifted[-15:])  # a touch there is told from it, so it is not refused for good
    pressed = [skin.feel(PRESS, ((12, times),)) for _ in range(4)]
    assert all(r.contact.valid and position_error_m(r) < 0.003 for r in pressed[1:])
    back = [skin.feel(touch) for _ in range(BACK_WITHIN + 3)]
    assert states(back[-1]) == {}
    assert states(skin.rest(BACK_WITHIN + 6)) == {}


@pytest.mark.parametrize("electrode", [0, 6, 9])
def test_a_contact_that_rose_and_stays_is_not_doubted_again(skin: StubSkin, electrode: int) -> None:
    """Electrode 0 shows its contact impedance least: what its noise makes of a change of 30 % is 1 %."""
    skin.rest(BACK_WITHIN + 6)
    risen = [skin.feel((), ((electrode, 1.3),)) for _ in range(80)]
    assert all(r.contact.valid and states(r) == {"drifting": [electrode]} and not present(r) for r in risen[8:])
    back = [skin.feel() for _ in range(30)]
    assert all(r.contact.valid and not present(r) and states(r) == {} for r in back[BACK_WITHIN + 2 :])


@pytest.mark.parametrize("electrode", [0, 9])
def test_a_contact_that_stays_as_it_rose_becomes_the_skins_own(electrode: int) -> None:
    """After ten seconds, in which everybody could read its name; what noise makes of its size is no touch then."""
    own, risen = StubSkin(80.0), ((electrode, 1.3),)
    for _ in range(250):
        own.feel((), risen)
    settled = [own.feel((), risen) for _ in range(30)]
    assert all(r.contact.valid and not present(r) and states(r) == {} for r in settled)
    assert position_error_m(own.feel(PRESS, risen)) < 0.003


def present(result: Result) -> int:
    """How many touches are said to press."""
    return sum(c.state != "end" for c in result.contact.contacts)


def moving(step: int) -> tuple[Shape, ...]:
    """0.5 mm from frame to frame, away from the electrodes."""
    return (Shape("circle", -0.4 + 0.01 * step, 0.2, 0.2, 0.4),)


@pytest.mark.parametrize(("electrode", "times"), [(12, 1.75), (6, 8.0), (3, 1.5)])
def test_a_contact_that_rises_and_falls_under_a_touch_that_moves(skin: StubSkin, electrode: int, times: float) -> None:
    """Named, left out, the touch reported all the while, and the electrode well again before the touch ends."""
    for step in range(30):
        skin.feel(moving(step))
    risen = [skin.feel(moving(30 + step), ((electrode, times),)) for step in range(25)]
    assert all(states(r) == {"drifting": [electrode]} for r in risen[NAMED_WITHIN + 3 :])
    assert all(r.contact.valid and present(r) == 1 for r in risen[8:])
    assert all(not r.contact.valid or present(r) == 1 for r in risen)
    well = [skin.feel(moving(55 + step)) for step in range(25)]
    # Until it is known to be well, what it did to the others is taken off their pairs, and too much is unexplained.
    assert all(not r.contact.valid or present(r) == 1 for r in well)
    assert all(r.contact.valid for r in well[3 * BACK_WITHIN :])
    assert states(well[-1]) == {}
    skin.rest(BACK_WITHIN + 3)


def test_a_contact_that_jumps_a_little_under_a_fast_slide_makes_no_second_one() -> None:
    skin = StubSkin(80.0)

    def sliding(step: int) -> tuple[Shape, ...]:
        """1.6 mm from frame to frame."""
        return (Shape("circle", -0.36 + 0.005 * step, -0.6 + 0.032 * step, 0.2, 0.16),)

    before = [skin.feel(sliding(step)) for step in range(15)]
    assert before[-1].contact.valid and present(before[-1]) == 1
    risen = [skin.feel(sliding(15 + step), ((3, 1.44),)) for step in range(20)]
    assert all(not r.contact.valid or present(r) == 1 for r in risen)
    assert all(r.contact.valid and states(r) == {"drifting": [3]} for r in risen[6:])


@pytest.mark.parametrize("speed", [0.003, 0.0055, 0.011])
def test_a_touch_that_slides_onto_an_electrode_is_no_contact_that_rises(speed: float) -> None:
    skin = StubSkin(80.0)
    for step in range(int(0.62 / speed)):
        contact = skin.feel((Shape("circle", 0.1 + speed * step, -0.26, 0.28, 0.45),)).contact
        assert contact.valid and not {"electrode_drift", "gain"} & set(contact.reasons)


def test_a_contact_that_jumps_as_two_touches_come_makes_no_third_one() -> None:
    skin = StubSkin(80.0)

    def two(drop: float) -> tuple[Shape, ...]:
        return Shape("circle", -0.52, 0.4, 0.2, 0.475 * drop), Shape("circle", -0.2, -0.7, 0.2, 0.353 * drop)

    rising = [skin.feel(two(drop), ((2, 5.95),)) for drop in (0.02, 0.5, 0.9)]
    held = [skin.feel(two(1.0), ((2, 5.95),)) for _ in range(16)]
    assert all(not r.contact.valid or present(r) <= 2 for r in (*rising, *held))
    assert all(r.contact.valid and present(r) == 2 and states(r) == {"drifting": [2]} for r in held[6:])


def test_a_touch_that_came_while_a_contact_was_up_does_not_hide_that_it_is_well_again(skin: StubSkin) -> None:
    changed = ((12, 1.75),)
    skin.rest(3)
    for _ in range(12):
        skin.see(transfer((), changed))
    pressed = [skin.feel(PRESS, changed) for _ in range(12)]
    assert states(pressed[-1]) == {"drifting": [12]} and pressed[-1].contact.valid
    well = [skin.feel(PRESS) for _ in range(25)]
    assert states(well[-1]) == {} and all(r.contact.valid for r in well[1:])
    skin.rest(BACK_WITHIN + 3)


@pytest.mark.parametrize("held", [False, True])
def test_an_electrode_off_the_skin_is_named_though_its_pairs_clip(skin: StubSkin, held: bool) -> None:
    touch = PRESS if held else ()
    for _ in range(10):
        skin.feel(touch)
    off = [skin.feel(touch, ((9, 1000.0),)) for _ in range(10)]
    assert all(states(r) == {"open": [9]} for r in off)
    assert off[-1].contact.valid and len(off[-1].contact.contacts) == len(touch)
    assert states(skin.rest(BACK_WITHIN + 6)) == {}


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_channel_that_comes_back_under_a_lifted_contact_blinds_nobody(broken: float) -> None:
    own, lifted = StubSkin(80.0), ((9, 6.0),)

    def felt(contacts: tuple[tuple[int, float], ...], gone: bool) -> Result:
        z, status = own.analog.measure((transfer(PRESS, contacts),) * 2, own.pattern, COHERENT, 40_000.0, 0.0)
        z[50] = broken if gone else z[50]
        return own.run(z, status)

    for contacts, gone in (((), True), (lifted, True), (lifted, False)):
        results = [felt(contacts, gone) for _ in range(12)]
    assert states(results[-1]) == {"drifting": [9]} and np.isfinite(results[-1].delta.difference).all()
    assert position_error_m(results[-1]) < 0.003
    assert states(own.rest(BACK_WITHIN + 3)) == {}
    own.rest(80)
    assert position_error_m(own.feel(PRESS)) < 0.003  # the baseline is what it was


def test_exchanged_wires_and_a_lifted_contact_are_three_faults(skin: StubSkin) -> None:
    """No contact is valid: more electrodes are at fault than contacts can be given with."""
    skin.faults.inject("electrodes_swapped", {"electrodes": [11, 14]}, 0.0, 1e9)
    try:
        felt = [skin.feel((), ((10, 12.0),)) for _ in range(12)]
        assert states(felt[-1]) == {"swapped": [11, 14], "drifting": [10]} and not felt[-1].contact.valid
        assert not any(r.contact.valid and r.contact.contacts for r in felt[NAMED_WITHIN:])
    finally:
        skin.faults.clear()
    assert states(skin.rest(BACK_WITHIN + 3)) == {}


def test_a_contact_that_rises_within_scans_is_named_before_it_is_up(skin: StubSkin) -> None:
    """Each measurement of a scan finds it higher than the last."""
    rising = [transfer((), ((9, factor),)) for factor in (1.0, 3.5, 6.0)]
    named = []
    for before, after in zip(rising, [*rising[1:], rising[-1]], strict=True):
        z, status = skin.analog.measure((before, after), skin.pattern, COHERENT, 40_000.0, 0.0)
        named.append(states(skin.run(z, status)))
    assert {"drifting": [9]} in named[:2] and named[-1] == {"drifting": [9]}
    assert states(skin.rest(BACK_WITHIN + 3)) == {}


def test_a_contact_that_drifts_slowly_stays_named() -> None:
    """By 10 % a second. It was named in every other frame: what it measured three frames ago counted as well."""
    own = StubSkin(80.0)
    frames = [own.feel(contacts=((8, 1 + 0.0044 * n),)) for n in range(60)]
    named = [int(frame.delta.electrodes[8]) == ELECTRODE_STATES.index("drifting") for frame in frames]
    assert all(named[25:])
    lasting = [[c for c in frame.contact.contacts if c.state != "end"] for frame in frames]
    assert not any(frame.contact.valid and there for frame, there in zip(frames, lasting, strict=True))


@pytest.mark.parametrize("pair", [(10, 11), (2, 13)])
def test_exchanged_wires_are_read_as_each_others(skin: StubSkin, pair: tuple[int, int]) -> None:
    """A touch between them is where it is, and the frame says that it is degraded."""
    place = sheet().skin.point(sheet().skin.electrodes)[list(pair)].mean(axis=0) * 0.7
    touch = (Shape("circle", float(place[0]), float(place[1]), 0.2, 0.3),)
    skin.faults.inject("electrodes_swapped", {"electrodes": list(pair)}, 0.0, 1e9)
    try:
        skin.rest(5)
        felt = [skin.feel(touch) for _ in range(6)]
    finally:
        skin.faults.clear()
    for result in felt[1:]:
        (contact,) = [c for c in result.contact.contacts if c.state != "end"]
        assert np.hypot(*(np.array(contact.position[:2]) - 0.05 * place)) < 0.002
        assert states(result) == {"swapped": sorted(pair)} and "degraded" in result.contact.reasons
    assert states(skin.rest(BACK_WITHIN + 3)) == {}


def test_a_tare_takes_a_changed_contact_as_it_is() -> None:
    own, changed = StubSkin(80.0), ((9, 4.0),)
    for _ in range(80):
        result = own.feel(contacts=changed)
    assert states(result) == {"drifting": [9]}
    own.pipeline.pre.command("tare", {})
    result = own.feel(contacts=changed)
    assert result.contact.valid and not states(result) and np.isfinite(result.delta.sigma).all()


def test_one_electrode_dead_two_degraded_three_invalid(skin: StubSkin) -> None:
    dead = np.zeros(len(skin.pattern), np.uint8)
    z, _ = skin.analog.measure((transfer(PRESS),) * 2, skin.pattern, COHERENT, 40_000.0, 0.0)
    for count, electrodes in enumerate(((), (5,), (5, 12), (5, 12, 2))):
        dead[:] = np.where(np.isin(skin.pattern, electrodes).any(axis=1), 2, 0)
        skin.rest(4)
        result = skin.run(z, dead)
        assert states(result) == ({"open": sorted(electrodes)} if electrodes else {})
        assert result.contact.valid == (count <= 2) and ("degraded" in result.contact.reasons) == (count == 2)
        if count <= 2:
            assert position_error_m(result) < 0.004
    skin.rest(4)


@pytest.mark.parametrize(
    ("electrodes", "touch"),
    [((13,), Shape("circle", -0.703, -0.554, 0.288, 0.393)), ((8, 11), Shape("circle", -0.009, -0.674, 0.156, 0.309))],
)
def test_electrodes_that_go_dead_as_a_strong_touch_comes_are_no_multiplexer(
    electrodes: tuple[int, ...], touch: Shape
) -> None:
    """Beside the dead ones, where little is seen of it: named as what they are with the first scan."""
    own = StubSkin(80.0)
    dead = np.where(np.isin(own.pattern, electrodes).any(axis=1), 2, 0).astype(np.uint8)
    for _ in range(4):
        z, _ = own.analog.measure((transfer((touch,)),) * 2, own.pattern, COHERENT, 40_000.0, 0.0)
        result = own.run(z, dead)
        assert states(result) == {"open": list(electrodes)}
        (contact,) = [c for c in result.contact.contacts if c.state != "end"]
        assert result.contact.valid
        assert np.hypot(contact.position[0] - 0.05 * touch.x, contact.position[1] - 0.05 * touch.y) < 3e-3
    assert states(own.rest(6)) == {} and own.feel().contact.valid


def test_exchanged_wires_are_named_before_there_is_a_baseline() -> None:
    own = StubSkin(80.0, tare=False)
    own.faults.inject("electrodes_swapped", {"electrodes": [4, 12]}, 0.0, 1.0)
    first = [own.feel() for _ in range(3)]
    assert states(first[-1]) == {"swapped": [4, 12]} and not first[-1].contact.valid
    with pytest.raises(EitskinError, match="wires"):
        own.pipeline.pre.command("tare", {})  # contacts would be elsewhere, in valid frames
    result = own.rest(77)
    assert result.contact.valid and "degraded" in result.contact.reasons and states(result) == {"swapped": [4, 12]}
    assert position_error_m(own.feel(PRESS)) < 0.002  # each measurement is there, in another's place
    own.faults.clear()
    own.rest(6)
    back = [own.feel() for _ in range(20)]
    assert all(r.contact.valid and states(r) == {} and not present(r) for r in back)
    assert position_error_m(own.feel(PRESS)) < 0.002
    assert own.pipeline.pre.health().level == "OK"


@pytest.mark.parametrize(
    ("name", "args", "reason"), [FAULTS[1][:2] + ("electrode_short",), FAULTS[5][:2] + ("multiplexer",)]
)
def test_wires_that_leave_too_little_are_named_at_the_start_and_make_no_baseline(
    name: str, args: dict[str, Any], reason: str
) -> None:
    own = StubSkin(80.0, tare=False)
    own.faults.inject(name, args, 0.0, 1.0)
    first = [own.feel() for _ in range(80)]
    assert not any(r.contact.valid for r in first) and all(reason in r.contact.reasons for r in first[2:])
    own.faults.clear()
    back = own.rest(80)
    assert back.contact.valid and states(back) == {} and own.pipeline.pre.health().level == "OK"


def test_a_state_taken_over_knows_the_faults(skin: StubSkin) -> None:
    skin.feel(contacts=((9, 0.4),))
    twin = StubSkin(80.0, tare=False)
    twin.pipeline.pre.load(skin.pipeline.pre.state())
    assert states(twin.feel()) == {"drifting": [9]} == states(skin.feel())
    skin.rest(5)


@pytest.mark.parametrize("snr_db", [70.0, 110.0])
def test_no_touch_is_named_a_fault(snr_db: float) -> None:
    """On, beside and across electrodes, and anywhere; one to three at a time, on a skin that was free."""
    own, rng = StubSkin(snr_db), np.random.default_rng(4)
    centres = sheet().skin.point(sheet().skin.electrodes)
    pre = own.pipeline.pre
    for n in range(30):
        shapes = []
        for _ in range(rng.integers(1, 4)):
            near = centres[rng.integers(16)] + rng.normal(0, 0.06, 2) * (rng.random() < 0.7)
            x, y = np.clip(near if n % 3 else rng.uniform(-0.9, 0.9, 2), -1, 1)
            kind = str(rng.choice(["circle", "hertz", "square"]))
            shapes.append(
                Shape(kind, float(x), float(y), float(rng.uniform(0.05, 0.5)), float(rng.uniform(0.05, 0.85)))
            )
        own.rest(BACK_WITHIN + 3)
        t = sheet().model.solve(sheet().model.touched(shapes)).transfer
        z, status = own.analog.measure((t, t), own.pattern, COHERENT, 40_000.0, 0.0)
        status[:] = 0  # a drop of 0.85 S/m on an electrode may clip the current: that is another matter
        result = _named(own, z, status)
        assert result == {}, shapes
    assert pre.health().level == "OK"


def _named(skin: StubSkin, z: Any, status: Any) -> dict[str, list[int]]:
    """States by preprocessing alone: no network is needed to see them."""
    skin.scan += 1
    stamps = {"sample": skin.scan * 45_000_000}
    raw = RawFrame(skin="palm", scan=skin.scan, stamps=stamps, source="board", valid=True, z=z, status=status)
    (out,) = skin.pipeline.pre.process(raw, frozenset({"delta"}))
    assert isinstance(out, DeltaFrame)
    return states_of(out)


def test_wires_put_right_under_a_touch_are_no_longer_named(skin: StubSkin) -> None:
    order = np.arange(16)
    order[[3, 9]] = 9, 3
    for _ in range(12):
        swapped = skin.see(transfer(PRESS)[np.ix_(order, order)])
    assert states(swapped) == {"swapped": [3, 9]} and swapped.contact.valid
    right = [skin.feel(PRESS) for _ in range(25)]
    assert states(right[-1]) == {} and all(r.contact.valid for r in right[1:])
    skin.rest(BACK_WITHIN + 3)
