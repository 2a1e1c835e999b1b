"""Every fault of the table: what the host gets to see."""

import json
from pathlib import Path

import numpy as np
import pytest

from firmware_stub import faults, scene
from firmware_stub.analog import PGA, clip
from firmware_stub.faults import FAULTS
from models.patterns import pattern
from protocol import link
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA

PAIRS = pattern("pairs").astype("u1")
SECONDS = 0.5


@pytest.fixture
def running(host):
    """A board that scans, and its healthy |Z|."""
    board = host(snr_db=90.0)
    board.start()
    return board, board.z(0.3).mean(0)


def during(board, name, **args):
    """Frames measured while a fault is in force: from the first whole scan on."""
    begin = board.now
    board.rig.fault(name, args, begin, SECONDS)
    device_us = board.rig.board.device_us(begin)
    return [f for f in board.frames(SECONDS) if f.device_us >= device_us]


def involved(*electrodes):
    return np.isin(PAIRS, electrodes).any(1)


def test_the_table_covers_the_design_and_every_fault_is_tried_here(request):
    text = request.path.read_text()
    assert [name for name in FAULTS if f'"{name}"' not in text] == []


def test_after_a_fault_all_is_well_again(running):
    board, healthy = running
    for name, row in FAULTS.items():
        if not row.sticky and name not in ("unplug", "power_cycle"):
            board.rig.fault(name, {}, board.now, 0.1)
    board.wait(0.2)
    frames = board.frames(0.3)
    assert len(frames) > 4
    assert np.abs(np.abs(frames[-1].z) / healthy - 1).max() < 5e-4
    assert not frames[-1].status.any()


@pytest.mark.parametrize("chip_id", [0x0000, 0xFFFF, 0xA0A0])
def test_wrong_chip_id(running, chip_id):
    board, _ = running
    assert during(board, "wrong_chip_id", id=chip_id)[1:] == []
    assert any(isinstance(m, link.Event) and m.code == link.EventCode.CHIP_ID for m in board.messages)
    assert board.ask(link.Hello()).chip_id == chip_id
    assert board.ask(link.Start(1)).reason == link.NakReason.CHIP_ID
    assert board.ask(link.SelfTest()).value & link.SelfTestFault.CHIP_ID
    board.wait(10.0)  # time does not heal it
    assert board.ask(link.Start(1)).reason == link.NakReason.CHIP_ID
    board.rig.fault("power_cycle", {}, board.now)
    board.wait(0.1)
    board.start()
    assert len(board.frames(0.3)) > 3


def test_brown_out_lasts_until_configured_again(running):
    board, healthy = running
    frame = during(board, "brown_out")[-1]
    assert (frame.status & STATUS_OPEN).all()
    assert np.median(np.abs(np.abs(frame.z) / healthy - 1)) > 0.5
    assert any(isinstance(m, link.Event) and m.code == link.EventCode.BROWN_OUT for m in board.messages)
    board.wait(10.0)
    assert board.frames(0.2)[-1].status.any()
    board.start()
    board.wait(0.1)
    assert not board.frames(0.2)[-1].status.any()


@pytest.mark.parametrize("silent", [False, True])
def test_a_clipped_converter_gives_a_plausible_low_impedance(running, silent):
    board, healthy = running
    frame = during(board, "clipped", silent=silent)[-1]
    ratio = np.abs(frame.z) / healthy
    clipped = healthy > np.quantile(healthy, 0.8)
    assert (ratio[clipped] < 0.95).all() and ratio.min() > 0.2
    assert ratio.max() < 1.001
    assert (frame.status[clipped] & STATUS_CLIPPED != 0).all() == (not silent)


def test_rtia_overrange(running):
    board, healthy = running
    frame = during(board, "rtia_overrange")[-1]
    assert (np.abs(frame.z) / healthy > 1.05).all()
    assert (frame.status & STATUS_RTIA).all()


def test_stale_rtia_until_the_self_test_calibrates(running):
    board, healthy = running
    board.rig.fault("stale_rtia", {"gain": 1.05, "phase": 0.02}, board.now, 60.0)
    board.wait(0.1)
    frame = board.frames(0.2)[-1]
    assert np.abs(np.abs(frame.z) / healthy / 1.05 - 1).max() < 5e-4
    assert np.angle(frame.z).mean() == pytest.approx(-0.03 + 0.02, abs=1e-3)
    board.ask(link.Stop())
    assert board.ask(link.SelfTest()).value == 0
    board.ask(link.Start(1))
    assert np.abs(board.z(0.2)[-1] / healthy - 1).max() < 5e-4


@pytest.mark.parametrize("factor", [0.95, 1.001, 1.05])
def test_a_gain_multiplies_every_impedance_from_one_scan_to_the_next(running, factor):
    board, healthy = running
    begin = board.now
    board.rig.fault("gain", {"factor": factor}, begin, SECONDS)
    frames = board.frames(SECONDS + 0.2)
    ratios = np.abs([f.z for f in frames]) / healthy
    first, last = (board.rig.board.device_us(t) for t in (begin, begin + SECONDS))
    there = np.array([first <= f.device_us + f.duration_us and f.device_us < last for f in frames])
    assert 8 <= there.sum() < len(frames)
    assert np.abs(ratios[there] / factor - 1).max() < 5e-4  # whole scans: none is half of each
    assert np.abs(ratios[~there] - 1).max() < 5e-4
    assert not any(f.status.any() for f in frames)
    assert np.angle(frames[1].z).mean() == pytest.approx(-0.03, abs=1e-3)


def test_missed_interrupt_repeats_the_result_before(running):
    board, healthy = running
    frame = during(board, "missed_interrupt", fraction=0.3)[-1]
    late = np.flatnonzero(frame.status & STATUS_FIFO)
    assert 10 < len(late) < 70
    late = late[(late > 0) & (frame.status[late - 1] == 0)]
    gains = PGA[:, None] / PGA  # the firmware divides by the gain it had set for the result it missed
    ratio = np.abs(frame.z[late]) / healthy[late - 1]
    assert np.abs(ratio[:, None, None] / gains - 1).min((1, 2)).max() < 5e-4
    kept = frame.status == 0
    assert np.abs(np.abs(frame.z[kept]) / healthy[kept] - 1).max() < 5e-4


def test_fifo_faults(running):
    board, healthy = running
    under = during(board, "fifo_underflow", words=8)[-1]
    assert (under.status & STATUS_FIFO != 0).nonzero()[0].tolist() == [118, 119]
    assert np.abs(np.abs(under.z[:-2]) / healthy[:-2] - 1).max() < 5e-4
    over = during(board, "fifo_overflow", words=3)[-1]
    bad = np.flatnonzero(over.status & STATUS_FIFO)
    assert bad[-1] == len(over.z) - 1 and (np.diff(bad) == 1).all()
    good = over.status & STATUS_FIFO == 0
    assert np.abs(np.abs(over.z[good]) / healthy[good] - 1).max(initial=0.0) < 5e-4
    shifted = during(board, "fifo_misaligned", silent=True)[-1]
    assert np.isfinite(shifted.z).all() and not (shifted.status & STATUS_FIFO).any()
    assert np.median(np.abs(np.abs(shifted.z) / healthy - 1)) > 0.2
    events = {m.code for m in board.messages if isinstance(m, link.Event)}
    assert {link.EventCode.FIFO_OVERFLOW, link.EventCode.FIFO_UNDERFLOW} <= events


def test_an_open_electrode_takes_its_pairs_only(running):
    board, healthy = running
    frame = during(board, "electrode_open", electrode=5)[-1]
    assert ((frame.status & STATUS_OPEN != 0) == involved(5)).all()
    rest = ~involved(5)
    assert np.abs(np.abs(frame.z[rest]) / healthy[rest] - 1).max() < 5e-4


def test_shorted_electrodes_read_nothing_between_them_and_alike_to_all_others(running):
    board, healthy = running
    z = np.abs(during(board, "electrodes_shorted", electrodes=[3, 4])[-1].z)
    row = {tuple(pair): k for k, pair in enumerate(PAIRS[:, :2].tolist())}
    assert z[row[3, 4]] < 0.01 * healthy[row[3, 4]]
    for other in (0, 9, 15):
        a, b = (row[tuple(sorted((e, other)))] for e in (3, 4))
        assert z[a] == pytest.approx(z[b], rel=2e-3)
        assert z[a] < min(healthy[a], healthy[b])


def test_swapped_electrodes_exchange_their_rows(running):
    board, healthy = running
    z = np.abs(during(board, "electrodes_swapped", electrodes=[2, 9])[-1].z)
    row = {tuple(pair): k for k, pair in enumerate(PAIRS[:, :2].tolist())}
    for other in (0, 5, 12):
        a, b = (row[tuple(sorted((e, other)))] for e in (2, 9))
        assert (z[a], z[b]) == pytest.approx((healthy[b], healthy[a]), rel=5e-4)
    assert z[row[2, 9]] == pytest.approx(healthy[row[2, 9]], rel=5e-4)


def test_a_stuck_address_bit_repeats_rows(running):
    board, healthy = running
    z = np.abs(during(board, "mux_stuck", mux="drive-", bit=0, value=0)[-1].z)
    # (0, 1) drives 0 -> 0 and senses 0, 1: nothing; adjacent patterns would repeat; (1, 2) is as it was
    row = {tuple(pair): k for k, pair in enumerate(PAIRS[:, :2].tolist())}
    assert z[row[0, 1]] < 0.01 * healthy[row[0, 1]]
    assert z[row[1, 2]] == pytest.approx(healthy[row[1, 2]], rel=5e-4)
    assert z[row[1, 3]] != pytest.approx(healthy[row[1, 3]], rel=0.05)
    board.ask(link.Stop())
    board.rig.fault("mux_stuck", {}, board.now)
    assert board.ask(link.SelfTest()).value == link.SelfTestFault.MULTIPLEXER


def test_a_disabled_multiplexer_opens_all(running):
    board, _ = running
    assert (during(board, "mux_disabled", mux="drive+")[-1].status & STATUS_OPEN).all()


def test_sequence_gaps_show_in_the_numbers_alone(running):
    board, _ = running
    board.rig.fault("sequence_gaps", {"fraction": 0.5}, board.now, 3.0)
    numbers = [f.seq for f in board.frames(3.0)]
    assert 0.3 < len(numbers) / (numbers[-1] - numbers[0]) < 0.7
    assert board.decoder.bad == 0


def test_late_frames_come_whole_and_after_others(running):
    board, _ = running
    board.rig.fault("late_frames", {"fraction": 0.3, "by": 0.1}, board.now, 3.0)
    numbers = np.array([f.seq for f in board.frames(3.2)])
    assert (np.diff(numbers) < 0).sum() > 5
    assert len(set(numbers.tolist())) == len(numbers) and board.decoder.bad == 0


def test_repeated_frames_come_twice(running):
    board, _ = running
    board.rig.fault("repeated_frames", {"fraction": 0.5}, board.now, 3.0)
    numbers = [f.seq for f in board.frames(3.0)]
    assert 1.3 < len(numbers) / len(set(numbers)) < 1.7 and board.decoder.bad == 0


def test_partial_frames_are_told_from_whole_ones(running):
    board, healthy = running
    board.rig.fault("partial_frames", {"fraction": 0.5}, board.now, 3.0)
    frames = board.frames(3.0)
    assert 20 < len(frames) < 50
    assert board.decoder.bad > 15
    assert np.abs(np.abs([f.z for f in frames]) / healthy - 1).max() < 5e-4


def test_line_noise_loses_frames_but_never_changes_one(running):
    board, healthy = running
    board.rig.fault("line_noise", {"garbage": 0.001, "flips": 5e-5}, board.now, 3.0)
    frames = board.frames(3.0)
    assert 3 < len(frames) < 60
    assert board.decoder.bad > 5
    assert np.abs(np.abs([f.z for f in frames]) / healthy - 1).max() < 5e-4


def test_wrong_schema_is_told_by_name_and_never_misread(running):
    board, _ = running
    board.rig.fault("wrong_schema", {}, board.now, 10.0)
    board.wait(0.1)
    assert board.frames(0.5) == []
    assert board.ask(link.Hello()).schema_hash == 0xBAD0F00D
    assert board.ask(link.Start(1)).reason == link.NakReason.SCHEMA
    board.wait(0.2)
    assert board.decoder.counts["other_schema"] > 0


def test_a_hanging_board_is_silent(running):
    board, _ = running
    assert during(board, "hang")[1:] == []


def test_the_clock_jumps_once_and_the_scans_go_on(running):
    board, _ = running
    board.wait(7.0)
    (before, *_) = board.frames(0.1)
    board.rig.fault("clock_jump", {"by": -5.0}, board.now)
    after = board.frames(0.5)[-1]
    true_us = (after.seq - before.seq) * before.duration_us
    assert (after.device_us - before.device_us - true_us) * 1e-6 == pytest.approx(-5.0, abs=0.001)


def test_a_frozen_scan_has_new_numbers_and_times(running):
    board, _ = running
    board.wait(0.2)
    board.rig.fault("frozen", {}, board.now, 1.0)
    frames = board.frames(0.6)[1:]
    assert len(frames) > 8 and len({bytes(f.z) for f in frames}) == 1
    assert len({f.seq for f in frames}) == len({f.device_us for f in frames}) == len(frames)


def test_unplug_forgets_the_configuration_and_starts_the_clock_anew(running):
    board, _ = running
    board.wait(2.0)
    board.rig.fault("unplug", {}, board.now, 0.5)
    assert [m for m in board.wait(0.45) if isinstance(m, link.ScanFrame)] == []
    assert board.rig.unplugged is not None
    board.wait(0.2)
    assert board.rig.unplugged is None
    assert board.ask(link.Start(1)).reason == link.NakReason.NOT_CONFIGURED
    board.start()
    assert board.frames(0.2)[0].device_us < 1e6


@pytest.mark.parametrize(
    ("name", "args", "says"),
    [
        ("gremlins", {}, "expected one of wrong_chip_id"),
        ("electrode_open", {"electrode": 16}, "expected 0 to 15"),
        ("electrode_open", {"electrode": "five"}, "expected 0 to 15"),
        ("electrodes_swapped", {"electrodes": [1]}, "a list like"),
        ("mux_stuck", {"mux": "front"}, "one of drive"),
        ("electrode_open", {"electrode": 0, "second": 16}, "expected -1 to 15"),
        ("electrodes_swapped", {"electrodes": [2, 2]}, "expected different ones"),
        ("mux_stuck", {"bit": 4}, "bit = 4: expected 0 to 3"),
        ("missed_interrupt", {"fraction": 2}, "fraction = 2: expected 0 to 1"),
        ("fifo_overflow", {"words": -1}, "words = -1: expected 1 to 65535"),
        ("late_frames", {"by": -5}, "by = -5: expected 0 to 60"),
        ("clock_jump", {"by": 1e30}, r"expected -1000000 to 1000000"),  # ended the stub's process
        ("line_noise", {"garbage": 1e9}, "expected 0 to 1"),  # did so too
        ("line_noise", {"garbage": float("inf")}, "something like"),
        ("unplug", {"name": "../board"}, "a short name"),
        ("hang", {"hard": True}, "unknown argument hard"),
    ],
)
def test_a_fault_that_makes_no_sense_is_refused(host, name, args, says):
    with pytest.raises(ValueError, match=says):
        host().rig.fault(name, args, 0.0)


def test_only_a_fault_of_the_table_can_be_cleared(host):
    with pytest.raises(ValueError, match="no fault 'gremlins': expected one of wrong_chip_id"):
        host().rig.faults.clear("gremlins")


def test_clipping_is_the_describing_function_of_a_saturation():
    phase = np.linspace(0, 2 * np.pi, 20000, endpoint=False)
    for amplitude in (0.5, 1.0, 1.7, 4.0):
        wave = np.clip(amplitude * np.sin(phase), -1, 1)
        fundamental = 2 * np.mean(wave * np.sin(phase))
        assert clip(np.array([amplitude]), 1.0)[0] == pytest.approx(fundamental, rel=1e-6)


def test_the_readme_lists_every_fault_as_it_is_and_every_scene():
    readme = (Path(faults.__file__).parent / "README.md").read_text()
    for name, row in FAULTS.items():
        (line,) = (line for line in readme.splitlines() if line.startswith(f"| `{name}`"))
        assert row.what in line and all(f"`{key}={json.dumps(value)}`" in line for key, value in row.args.items())
        assert ("(sticky)" in line) == row.sticky
    assert [name for name in scene.names() if f"| `{name}` |" not in readme] == []
