"""Every fault of the table: what the host gets to see, and what is said of it."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_stub.analog import PGA, clip
from firmware_stub.faults import FAULTS
from firmware_stub.status import EVERY_S, Status
from protocol import link
from protocol.frames import STATUS_CLIPPED, STATUS_FIFO, STATUS_OPEN, STATUS_RTIA
from tests.firmware_stub.conftest import PAIRS

SECONDS, SAME = 0.5, 5e-4
ROW = {tuple(pair): k for k, pair in enumerate(PAIRS[:, :2].tolist())}


@pytest.fixture
def running(host):
    board = host(snr_db=90.0).start()
    return board, board.z(0.3).mean(0)


def during(board, name, **args):
    begin = board.now
    board.rig.fault(name, args, begin, SECONDS)
    device_us = board.rig.board.device_us(begin)
    return [f for f in board.frames(SECONDS) if f.device_us >= device_us]


def off(frame, healthy, where=slice(None)):
    return np.abs(np.abs(frame.z[where]) / healthy[where] - 1).max(initial=0.0)


def told(board, *events):
    assert {*events} <= {m.code for m in board.messages if isinstance(m, link.Event)}


def test_after_a_fault_all_is_well_again(running):
    board, healthy = running
    for name, row in FAULTS.items():
        if not row.sticky and name not in ("unplug", "power_cycle"):
            board.rig.fault(name, {}, board.now, 0.1)
    board.wait(0.2)
    frames = board.frames(0.3)
    assert len(frames) > 4 and off(frames[-1], healthy) < SAME and not frames[-1].status.any()


def test_a_wrong_chip_id_and_a_brown_out_are_not_healed_by_time(running):
    board, healthy = running
    frame = during(board, "brown_out")[-1]
    assert (frame.status & STATUS_OPEN).all() and np.median(np.abs(np.abs(frame.z) / healthy - 1)) > 0.5
    board.wait(10.0, step=0.1)
    assert board.frames(0.2)[-1].status.any()
    board.start()  # configured again
    board.wait(0.1)
    assert not board.frames(0.2)[-1].status.any()
    assert during(board, "wrong_chip_id", id=0xA0A0)[1:] == []
    assert board.ask(link.Hello()).chip_id == 0xA0A0
    assert board.ask(link.SelfTest()).value & link.SelfTestFault.CHIP_ID
    board.wait(10.0, step=0.1)
    assert board.ask(link.Start(1)).reason == link.NakReason.CHIP_ID
    board.rig.fault("power_cycle", {}, board.now)
    board.wait(0.1)
    board.start()
    assert len(board.frames(0.3)) > 3
    told(board, link.EventCode.BROWN_OUT, link.EventCode.CHIP_ID)


def test_a_clipped_converter_and_rtia_that_is_overrange_or_stale_until_the_self_test_calibrates(running):
    board, healthy = running
    for silent in (False, True):  # a plausible low impedance
        frame = during(board, "clipped", silent=silent)[-1]
        ratio, clipped = np.abs(frame.z) / healthy, healthy > np.quantile(healthy, 0.8)
        assert (ratio[clipped] < 0.95).all() and ratio.min() > 0.2 and ratio.max() < 1.001
        assert (frame.status[clipped] & STATUS_CLIPPED != 0).all() == (not silent)
    phase = np.linspace(0, 2 * np.pi, 20000, endpoint=False)
    for amplitude in (0.5, 1.0, 1.7, 4.0):  # the describing function of a saturation
        fundamental = 2 * np.mean(np.clip(amplitude * np.sin(phase), -1, 1) * np.sin(phase))
        assert clip(np.array([amplitude]), 1.0)[0] == pytest.approx(fundamental, rel=1e-6)
    frame = during(board, "rtia_overrange")[-1]
    assert (np.abs(frame.z) / healthy > 1.05).all() and (frame.status & STATUS_RTIA).all()
    board.rig.fault("stale_rtia", {"gain": 1.05, "phase": 0.02}, board.now, 60.0)
    board.wait(0.1)
    frame = board.frames(0.2)[-1]
    assert off(frame, 1.05 * healthy) < SAME
    assert np.angle(frame.z).mean() == pytest.approx(-0.03 + 0.02, abs=1e-3)
    board.ask(link.Stop())
    assert board.ask(link.SelfTest()).value == 0
    board.ask(link.Start(1))
    assert off(board.frames(0.2)[-1], healthy) < SAME


def test_a_gain_multiplies_every_impedance_from_one_scan_to_the_next(running):
    (board, healthy), factor = running, 0.95
    begin = board.now
    board.rig.fault("gain", {"factor": factor}, begin, SECONDS)
    frames = board.frames(SECONDS + 0.2)
    ratios = np.abs([f.z for f in frames]) / healthy
    first, last = (board.rig.board.device_us(t) for t in (begin, begin + SECONDS))
    there = np.array([first <= f.device_us + f.duration_us and f.device_us < last for f in frames])
    assert 8 <= there.sum() < len(frames) and not any(f.status.any() for f in frames)
    assert np.abs(ratios[there] / factor - 1).max() < SAME  # whole scans: none is half of each
    assert np.abs(ratios[~there] - 1).max() < SAME


def test_results_that_were_missed_or_that_the_fifo_lost(running):
    board, healthy = running
    frame = during(board, "missed_interrupt", fraction=0.3)[-1]
    late = np.flatnonzero(frame.status & STATUS_FIFO)
    assert 10 < len(late) < 70 and off(frame, healthy, frame.status == 0) < SAME
    late = late[(late > 0) & (frame.status[late - 1] == 0)]  # repeats the result before
    gains = PGA[:, None] / PGA  # the firmware divides by the gain it had set for the result it missed
    ratio = np.abs(frame.z[late]) / healthy[late - 1]
    assert np.abs(ratio[:, None, None] / gains - 1).min((1, 2)).max() < SAME
    under = during(board, "fifo_underflow", words=8)[-1]
    assert (under.status & STATUS_FIFO != 0).nonzero()[0].tolist() == [118, 119]
    assert off(under, healthy, slice(-2)) < SAME
    over = during(board, "fifo_overflow", words=3)[-1]
    bad = np.flatnonzero(over.status & STATUS_FIFO)
    assert bad[-1] == len(over.z) - 1 and (np.diff(bad) == 1).all()
    assert off(over, healthy, over.status & STATUS_FIFO == 0) < SAME
    shifted = during(board, "fifo_misaligned", silent=True)[-1]
    assert np.isfinite(shifted.z).all() and not (shifted.status & STATUS_FIFO).any()
    assert np.median(np.abs(np.abs(shifted.z) / healthy - 1)) > 0.2
    told(board, link.EventCode.FIFO_OVERFLOW, link.EventCode.FIFO_UNDERFLOW)


def test_electrodes_that_are_open_shorted_or_swapped_and_multiplexers_that_are_stuck(running):
    board, healthy = running
    frame = during(board, "electrode_open", electrode=5)[-1]
    involved = np.isin(PAIRS, [5]).any(1)
    assert ((frame.status & STATUS_OPEN != 0) == involved).all() and off(frame, healthy, ~involved) < SAME
    z = np.abs(during(board, "electrodes_shorted", electrodes=[3, 4])[-1].z)
    assert z[ROW[3, 4]] < 0.01 * healthy[ROW[3, 4]]
    a, b = ROW[3, 9], ROW[4, 9]
    assert z[a] == pytest.approx(z[b], rel=2e-3) and z[a] < min(healthy[a], healthy[b])
    z = np.abs(during(board, "electrodes_swapped", electrodes=[2, 9])[-1].z)
    a, b = ROW[2, 5], ROW[5, 9]
    assert [z[a], z[b], z[ROW[2, 9]]] == pytest.approx([healthy[b], healthy[a], healthy[ROW[2, 9]]], rel=SAME)
    z = np.abs(during(board, "mux_stuck", mux="drive-", bit=0, value=0)[-1].z)
    # (0, 1) drives 0 -> 0 and senses 0, 1: nothing; adjacent patterns would repeat; (1, 2) is as it was
    assert z[ROW[0, 1]] < 0.01 * healthy[ROW[0, 1]]
    assert z[ROW[1, 2]] == pytest.approx(healthy[ROW[1, 2]], rel=SAME)
    assert z[ROW[1, 3]] != pytest.approx(healthy[ROW[1, 3]], rel=0.05)
    assert (during(board, "mux_disabled", mux="drive+")[-1].status & STATUS_OPEN).all()
    board.ask(link.Stop())
    board.rig.fault("mux_stuck", {}, board.now)
    assert board.ask(link.SelfTest()).value == link.SelfTestFault.MULTIPLEXER


LINE = [
    ("sequence_gaps", {"fraction": 0.5}, lambda n, bad: 0.3 < len(n) / (n[-1] - n[0]) < 0.7 and bad == 0),
    ("late_frames", {"fraction": 0.3, "by": 0.1}, lambda n, bad: sum(np.diff(n) < 0) > 5 and bad == len(n) - len({*n})),
    ("repeated_frames", {"fraction": 0.5}, lambda n, bad: 1.3 < len(n) / len({*n}) < 1.7 and bad == 0),
    ("partial_frames", {"fraction": 0.5}, lambda n, bad: 20 < len(n) < 50 and bad > 15),
    ("line_noise", {"garbage": 0.001, "flips": 5e-5}, lambda n, bad: 3 < len(n) < 60 and bad > 5),
]


@pytest.mark.parametrize(("name", "args", "holds"), LINE)
def test_the_line_loses_repeats_and_delays_frames_but_never_changes_one(running, name, args, holds):
    board, healthy = running
    board.rig.fault(name, args, board.now, 3.0)
    frames = board.frames(3.2)
    assert holds([f.seq for f in frames], board.decoder.bad)
    assert max(off(frame, healthy) for frame in frames) < SAME


def test_boards_that_hang_freeze_speak_another_language_jump_in_time_or_are_unplugged(running):
    board, _ = running
    assert during(board, "hang")[1:] == []
    board.wait(0.2)
    frames = during(board, "frozen")[1:]  # with new numbers and times
    assert len(frames) > 7 and len({bytes(f.z) for f in frames}) == 1
    assert len({f.seq for f in frames}) == len({f.device_us for f in frames}) == len(frames)
    board.wait(6.0, step=0.1)
    (before, *_) = board.frames(0.1)
    board.rig.fault("clock_jump", {"by": -5.0}, board.now)
    after = board.frames(0.5)[-1]
    true_us = (after.seq - before.seq) * before.duration_us
    assert (after.device_us - before.device_us - true_us) * 1e-6 == pytest.approx(-5.0, abs=0.001)
    assert during(board, "wrong_schema")[1:] == [], "never misread"
    board.rig.fault("wrong_schema", {}, board.now, 1.0)
    assert board.ask(link.Hello()).schema_hash == 0xBAD0F00D
    assert board.ask(link.Start(1)).reason == link.NakReason.SCHEMA and board.decoder.counts["other_schema"] > 0
    board.wait(1.0)
    board.rig.fault("unplug", {}, board.now, 0.5)
    assert [m for m in board.wait(0.45) if isinstance(m, link.ScanFrame)] == [] and board.rig.unplugged is not None
    board.wait(0.2)
    assert board.rig.unplugged is None and board.ask(link.Start(1)).reason == link.NakReason.NOT_CONFIGURED
    board.start()
    assert board.frames(0.2)[0].device_us < 1e6


def test_a_fault_that_makes_no_sense_is_refused(host):
    for name, args, says in (
        ("gremlins", {}, "no fault 'gremlins': expected one of wrong_chip_id"),
        *(("electrode_open", {"electrode": e}, f"electrode {e!r}, expected 0 to 15") for e in ("left", 16, -1, 3.5)),
        ("electrodes_swapped", {"electrodes": [2, 2]}, "expected different ones"),
        ("missed_interrupt", {"fraction": 2}, "fraction = 2: expected 0 to 1"),
        ("clock_jump", {"by": 1e30}, r"expected -1000000 to 1000000"),  # ended the stub's process
        ("hang", {"hard": True}, "unknown argument hard"),
    ):
        with pytest.raises(ValueError, match=says):
            host().rig.fault(name, args, 0.0)


def test_a_status_frame_says_faults_in_words_and_how_long_it_holds(host):
    for name, args, words in (
        ("electrode_open", {"electrode": 5, "second": 0}, "the wire of electrode 5 is broken, and that of electrode 0"),
        *((name, {}, "") for name in FAULTS),
    ):
        rig, before = host().rig, time.monotonic_ns()
        rig.fault(name, args, 0.0)
        frame = Status("palm").due(rig, SimpleNamespace(overrun=0), 0.0)
        assert frame is not None and frame.level == "WARN" and len(frame.messages[0]) > 20
        assert frame.messages[0].startswith(f"on request, {words}") and not set('{}[]`_"') & set(frame.messages[0])
        assert frame.valid_for_s == 3 * EVERY_S and before <= frame.stamps["publish"]
