"""Faults of the stub's board, bytes in: each is named, makes no contact, hides none; and in closed form."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import FAULTS, MUXES, Faults
from models.measurement.tables import SkinTables, tables_of
from models.measurement.whitening import Whitening
from models.patterns import adjacent, pairs
from models.shapes import Shape
from protocol.scan_setting import COHERENT
from services.estimation.faults.impedance import Change, ContactColumns, Unexplained, gain_change
from services.estimation.faults.wires import BoardScan, WireFault, WireKind, WireMaps, any_touches
from services.runtime.config import ScanMode
from simulation.faults import CONTACT_RISES, ROWS, FaultRow
from simulation.host import LATE_S, SimulatedHost, tared
from simulation.scenes import DiscPress, path_of, script, spread, step
from simulation.truth import lasting
from tests.services.stub_skin import bundle_of_square16, transfer

FAULT_S, BEGINS_S, FAILS_S = 0.3, 6.2, 5.5
WELL = 5  # frames in a row
IN_PARTS = "clipped", "fifo_overflow", "electrode_open", CONTACT_RISES, "mux_stuck", "sequence_gaps", "frozen"
SMALL_RISE = {"electrode": 12, "times": 1.75}  # a large one is a touch on its electrode in the parts before it is named
CASES = [pytest.param(row, "full", id=f"{row.title}-full") for row in ROWS] + [
    pytest.param(row, "rolling", id=f"{row.title}-rolling", marks=() if row.title in IN_PARTS else pytest.mark.release)
    for row in ROWS
]


@pytest.mark.many
@pytest.mark.parametrize(("row", "scan"), CASES)
def test_a_fault_is_named_and_wrong_nowhere_and_soon_over(row: FaultRow, scan: ScanMode) -> None:
    """Where nothing touches, and then under a touch that is held."""
    args, at = row.draw(np.random.default_rng([5, *row.title.encode()])), BEGINS_S
    if row.title == CONTACT_RISES and scan == "rolling":
        args = SMALL_RISE
    host = tared(scan)
    lasts_s = 1.5 if row.board else FAULT_S  # a board is asked how it is now and then
    for press in (None, DiscPress(0.012, -0.02, 0.0, 60.0, ramp=0.05)):
        if press is not None:
            press, at = replace(press, start=host.now + 0.05), host.now + 0.5
        played = script(*[press] * (press is not None), cues=row.cues(args, at, lasts_s))
        played = replace(played, contact=row.contact(args, at, lasts_s))
        host.rig.field.play(host.rig.timeline(played, 0.0), host.now)
        over = at + lasts_s
        host.until(over)
        while not well(host, over, int(press is not None)):
            assert host.now < over + row.recovery_s + 0.3
            host.until(host.now + 0.05)
        assert not (row.names or row.board) or named(host, row, at, over)
        wrong = [each for each in host.wrong(at) if "changing" not in each.frame.reasons]
        assert not wrong, "\n".join(map(str, wrong[:5]))
    host.close()


def well(host: SimulatedHost, since: float, touches: int) -> bool:
    last = [frame for at, frame in host.contacts[-WELL:] if at > since]
    return len(last) == WELL and all(frame.valid and len(lasting(frame)) == touches for frame in last)


def named(host: SimulatedHost, row: FaultRow, at: float, over: float) -> bool:
    said = row.board and any(text for when, text in host.problems if at <= when <= over + 0.2)
    return said or any(set(row.names) & set(f.reasons) for t, f in host.contacts if at <= t <= over + 0.1)


def test_a_short_that_begins_with_a_touch_is_no_other_fault_that_explains_the_newest_value() -> None:
    host, at = tared("rolling"), BEGINS_S + 0.0385
    (cues,) = (row.cues({"electrodes": [5, 11]}, at, 1.5) for row in ROWS if row.title == "electrodes_shorted")
    press = DiscPress(0.015, 0.0, at + 0.003, 60.0, 5.0, ramp=0.01)
    host.rig.field.play(host.rig.timeline(script(press, cues=cues), 0.0), host.now)
    host.until(at + 1.4)
    host.close()
    assert sum(not frame.valid for when, frame in host.contacts if when > at) < 10


def test_every_fault_of_the_stub_has_a_row_with_arguments_that_it_takes() -> None:
    assert {row.fault for row in ROWS} == set(FAULTS) | {CONTACT_RISES}
    known = Faults()
    for row, seed in ((row, seed) for row in ROWS for seed in range(20) if row.fault != CONTACT_RISES):
        known.inject(row.fault, row.draw(np.random.default_rng(seed)), 0.0, 1.0)


def test_presses_are_shown_beside_an_electrode_that_is_off_the_skin() -> None:
    """A press every three seconds. It changes the rest of the skin as a touch would: one stood for eleven seconds."""
    begins = np.arange(FAILS_S + 1.5, 15.0 - 2.5, 3.0).tolist()
    tracks = [path_of(touch, t, t + 1.5) for touch, t in zip(spread(len(begins), 2), begins, strict=True)]
    host = SimulatedHost("full", 80.0, 2, script=script(*tracks, contact=(step(9, 1000.0, FAILS_S),)), late_s=LATE_S)
    for second in np.arange(1.0, 15.5):
        host.until(float(second))
        assert second < FAILS_S + 2 or host.pipeline.delta.electrodes[9]  # type: ignore[union-attr]
    host.close()
    frames = [(at, frame) for at, frame in host.contacts if at > FAILS_S + 1.0]
    assert not host.wrong(FAILS_S + 1.0) and len(host.valid(FAILS_S + 1.0)) > 0.99 * len(frames)


Array = NDArray[np.float64]
Status = NDArray[np.uint8]
Arguments = dict[str, dict[str, Any]]

PATTERN = np.asarray(bundle_of_square16().pattern)
CLOSE = 2e-3  # the registers' rounding, where a fault leaves a twentieth of an impedance
QUIET, NOISE, SPAN_S = 1e-7, 1e-4, 0.0436
TIMES_S = ((np.arange(len(PATTERN)) + 0.5) / len(PATTERN) - 0.5) * SPAN_S
MEASURED_S = np.random.default_rng(7).permutation(TIMES_S)  # a board's own order, not the pattern's
MAPS = WireMaps(PATTERN)
TOUCHES: list[tuple[Shape, ...]] = [
    (),
    (Shape("circle", 0.3, -0.2, 0.25, 0.5),),
    (Shape("circle", -0.6, 0.6, 0.3, 0.7), Shape("circle", 0.5, 0.0, 0.15, 0.3)),
]


def measured(faults: Arguments, touch: tuple[Shape, ...] = (), pattern: Array = PATTERN) -> tuple[Array, Status]:
    """|Z| (K,) and status of the stub's board with these faults."""
    board = Faults()
    for name, args in faults.items():
        board.inject(name, args, 0.0, 1.0)
    analog = Analog(BoardNoise(QUIET), board, np.random.default_rng(3))
    z, status = analog.measure((transfer(touch),) * 2, pattern, COHERENT, 40_000.0, 0.0)
    return np.abs(z).astype(float), status


def exchanged(couple: tuple[int, int]) -> tuple[Arguments, WireFault]:
    return {"electrodes_swapped": {"electrodes": list(couple)}}, WireFault(WireKind.EXCHANGED, couple)


def short(couple: tuple[int, int]) -> tuple[Arguments, WireFault]:
    return {"electrodes_shorted": {"electrodes": list(couple)}}, WireFault(WireKind.SHORT, couple)


def stuck(mux: str, bit: int, value: int, maps: WireMaps = MAPS) -> tuple[Arguments, WireFault]:
    (fault,) = [f for f in maps.faults if (f.side, f.bit, f.value) == (mux[-1], bit, value)]
    return {"mux_stuck": {"mux": mux, "bit": bit, "value": value}}, fault


COUPLES = [make(couple) for couple in ((1, 2), (4, 13), (0, 15)) for make in (exchanged, short)]
STUCK = [stuck(mux, bit, value) for mux in MUXES for bit in range(4) for value in (0, 1)]


def test_wires_do_what_their_map_says() -> None:
    for touch in TOUCHES[:2]:
        well, _ = measured({}, touch)
        for faults, fault in (*COUPLES, *STUCK):
            (seen, _), found = measured(faults, touch), MAPS.one(fault, well)
            assert np.allclose(found.values[~found.blind], seen[~found.blind], rtol=CLOSE, atol=0), faults
            blind = found.blind.sum()
            assert blind == {WireKind.EXCHANGED: 0, WireKind.SHORT: 1}.get(fault.kind, blind) and blind < 60


def test_the_order_and_the_direction_of_pairs_do_not_matter() -> None:
    rng = np.random.default_rng(5)
    pattern = PATTERN[rng.permutation(len(PATTERN))]
    turned = rng.random(len(pattern)) < 0.5
    pattern[turned] = pattern[turned][:, [1, 0, 3, 2]]
    maps, z0 = WireMaps(pattern), measured({}, pattern=pattern)[0]
    for faults, fault in (exchanged((4, 13)), short((4, 13)), stuck("drive-", 2, 1, maps)):
        found = maps.one(fault, z0)
        assert np.allclose(found.values[~found.blind], measured(faults, (), pattern)[0][~found.blind], rtol=CLOSE)


def test_every_fault_at_once_is_each_by_itself_and_slopes_are_those_of_the_values() -> None:
    z0, rng = measured({})[0], np.random.default_rng(1)
    every, step = MAPS.every(z0), 1e-5 * rng.normal(size=len(z0))
    assert len(every) == len(MAPS.faults) == 120 + 120 + 16
    for fault, values in zip(MAPS.faults, every, strict=True):
        np.testing.assert_allclose(MAPS.one(fault, z0).values, values)
    for fault in (WireFault(WireKind.EXCHANGED, (2, 9)), WireFault(WireKind.SHORT, (2, 9)), MAPS.faults[-3]):
        low, at, high = (MAPS.one(fault, z0 * np.exp(by)) for by in (-step, 0 * step, step))
        moved = np.log(high.values[~at.blind] / low.values[~at.blind]) / 2
        np.testing.assert_allclose((at.slopes @ step)[~at.blind], moved, atol=1e-9)
        assert not at.slopes[at.blind].any()


def test_patterns_that_do_not_drive_the_wires_tell_nothing_of_them() -> None:
    for silent in (adjacent(16), pairs(16)[:-1]):
        assert not WireMaps(silent).knows and not WireMaps(silent).faults


@pytest.mark.parametrize(("faults", "fault"), [exchanged((1, 2)), short((4, 13)), *STUCK[::5]])
def test_a_fault_is_told_by_one_scan_whatever_touches_and_also_where_it_begins_or_ends_within(faults, fault) -> None:
    late, every_touch = 0.05 * SPAN_S <= MEASURED_S, any_touches(tables().grid)
    for touch in TOUCHES:
        well, ill = measured({}, touch), measured(faults, touch)
        lower = 0.8 * well[0], well[1]
        for before, after, standing, expected in (
            (ill, ill, None, fault),
            (well, ill, None, fault),
            (ill, well, fault, None),
            (lower, lower, None, None),
        ):
            z, status = (np.where(late, after[k], before[k]) for k in (0, 1))
            failed = ~np.isfinite(z) | (z <= 0) | (status != 0)
            log_z, live = np.log(np.where(failed, 1.0, z)), np.ones(len(z), bool)
            scan = BoardScan(log_z, untouched(), failed, live, MEASURED_S)
            assert MAPS.suspicious(scan, standing)
            first, *others = MAPS.guesses(scan, standing, every_touch, 2 * NOISE**2 * np.eye(len(PATTERN)))
            assert first.fault == expected
            assert first.score > max(guess.score for guess in others if guess.fault != expected) + 50
            assert before is after or abs(first.since_s - 0.05 * SPAN_S) < 0.06 * SPAN_S


# contact impedances and gains


def scan(sheet: Array, seed: int = 3) -> Array:
    """log |Z| (K,)."""
    analog = Analog(BoardNoise(NOISE), Faults(), np.random.default_rng(seed))
    z, _ = analog.measure((sheet, sheet), PATTERN, COHERENT, 40_000.0, 0.0)
    return np.asarray(np.log(np.abs(z).astype(float)))


@cache
def untouched() -> Array:
    return np.asarray(np.mean([scan(transfer(), seed=seed) for seed in range(64)], axis=0))


@cache
def tables() -> SkinTables:
    return tables_of(bundle_of_square16()).relative_to(np.exp(untouched()))


def asked(log_z: Array) -> Unexplained:
    ones, covariance = np.ones(len(PATTERN)), NOISE**2 * (1.1 * np.eye(len(PATTERN)))
    return Unexplained(log_z - untouched(), ones, ones > 0, TIMES_S, SPAN_S, Whitening.of(covariance))


def likeliest(log_z: Array) -> tuple[Change, float]:
    """And by how much it is likelier than the next."""
    found = ContactColumns.of(tables()).changes(asked(log_z), np.arange(16), np.full(16, -np.inf))
    found.sort(key=lambda change: -change.score)
    return found[0], found[0].score - found[1].score


@pytest.mark.parametrize("electrode", [0, 9])
@pytest.mark.parametrize("times", [0.4, 0.97, 1.03, 1.5, 20.0])
def test_a_changed_contact_is_told_by_one_scan(electrode: int, times: float) -> None:
    change, margin = likeliest(scan(transfer((), ((electrode, times),))))
    assert change.electrode == electrode and margin > 30
    assert change.size == pytest.approx(times - 1, rel=0.05, abs=2e-3) and change.chi2 < 1.6


def test_nothing_is_no_change_and_neither_is_a_touch() -> None:
    log_z = scan(transfer())
    nothing = asked(log_z)
    well = nothing.white.log_likelihood(nothing.y)
    change, _ = likeliest(log_z)
    assert abs(change.size) < 4 * change.variance**0.5 and change.score < well
    assert gain_change(nothing, -np.inf).score < well
    for place in ((0.3, -0.2), (0.9, 0.1)):
        assert likeliest(scan(transfer((Shape("circle", *place, 0.15, 0.2),))))[0].chi2 > 10


@pytest.mark.many
@pytest.mark.parametrize("phase_s", [0.0, 0.0102, 0.0119])
def test_a_gain_that_steps_under_a_touch_in_parts_is_no_other_touch(phase_s):
    """The few values of the first part after it may be explained by any touch: of 96 N, 38 mm away. What was held so
    would be the foam's memory, and all later forces too small.
    """
    host = tared("rolling", snr_db=80.0, seed=3)
    host.press(x=-0.009, y=-0.016, force=1.7, radius=0.012, seconds=30.0)
    host.until(host.now + 1.0 + phase_s)
    began, seen = host.now, len(host.contacts)
    host.rig.fault("stale_rtia", {"gain": 1.2}, host.now, 1.0)
    host.until(began + 2.0)
    valid = [frame for _, frame in host.contacts[seen:] if frame.valid]
    contacts = [contact for frame in valid for contact in frame.contacts if contact.state != "end"]
    host.close()
    assert len(contacts) > 100
    assert all(np.hypot(c.position[0] + 0.009, c.position[1] + 0.016) < 0.005 for c in contacts)
    assert all(abs(c.force_n - 1.7) < 0.2 for c in contacts)
