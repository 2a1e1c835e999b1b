"""The board measures as its CONFIG says: time, noise, what is left of offsets and mains; and refuses what it cannot."""

import numpy as np
import pytest

from models.patterns import pattern
from models.scan_response import noise, sine_left
from protocol import link
from protocol.scan_setting import COHERENT, NAMED, PAPER, ScanSetting

PAIRS = pattern("pairs").astype("u1")
NO_WINDOW = ScanSetting(50_000, 64, window="none")


def start(board, setting, scan=PAIRS):
    config = link.Config.of(setting, config=1, rtia_ohm=80e3, scan=scan)
    assert isinstance(board.ask(config), link.Ack) and isinstance(board.ask(link.Start(1)), link.Ack)
    return board


@pytest.mark.parametrize("name", NAMED)
def test_a_scan_takes_the_settings_time_and_has_its_noise(host, name):
    setting = NAMED[name]
    board = start(host(snr_db=70.0), setting, PAIRS[:20])
    frames = board.frames(4.0)
    assert frames[0].duration_us == pytest.approx(20 * 1e6 * setting.pair_s, abs=1)
    assert len(frames) * 20 * setting.pair_s == pytest.approx(4.0, rel=0.05)
    z = np.abs([frame.z for frame in frames])
    assert (z.std(0) / z.mean(0)).mean() == pytest.approx(10 ** (-70 / 20) * noise(setting), rel=0.06)


def test_a_config_carries_its_setting():
    for setting in (*NAMED.values(), NO_WINDOW, ScanSetting(50_000, 32, 2, "none", 60e-6)):
        sent = link.Config.of(setting, config=3, rtia_ohm=80e3, scan=PAIRS[:4])
        (got,) = link.Decoder().feed(link.encode(sent))
        assert isinstance(got, link.Config) and got.setting == setting
    assert link.Config(1, 128, 80e3, PAIRS).setting == COHERENT


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"dft_points": 100}, "100 DFT points: a power of two from 4 to 16384"),
        ({"frequency_hz": 90_000}, "90000 Hz: 1000 to 80000 with this filter"),
        ({"sinc3": 0}, "sinc3 of 0 samples: expected 1, 2, 4, 5"),
        ({"window": 7}, "window 'of number 7': expected one of none, hanning, fit"),
        ({"window": 2}, "a fit with sinc3 of 1: at least 4"),
        ({"settle_us": 20_000}, "settling for 0.02 s: 0 to 0.01"),
        ({"dft_points": 16}, "1 cycles in 16 points at 50000 Hz: at least 2"),
    ],
)
def test_a_bad_setting_is_refused_with_its_reason_and_the_board_goes_on(host, given, says):
    board = host()
    board.start()
    answer = board.ask(link.Config(**{"config": 2, "dft_points": 128, "rtia_ohm": 80e3, "scan": PAIRS} | given))
    assert isinstance(answer, link.Nak) and answer.reason == link.NakReason.BAD_CONFIG and says in answer.text
    assert {frame.config for frame in board.frames(0.3)} == {1}


def spread(host, setting, **volts):
    """How far untouched values are from each other, relative: what `volts` leave, far above the 18 bits' rounding."""
    board = start(host(snr_db=120.0, **volts), setting)
    z = board.z(3.0)
    return float((z.std(0) / z.mean(0)).mean())


def test_steady_offsets_move_values_and_never_change_them(host):
    """Their transient is the same in every scan, which a tare takes; but from one setting to another it is not."""
    plain = start(host(snr_db=120.0), NO_WINDOW).z(1.0).mean(0)
    board = start(host(snr_db=120.0, offset_v=0.01), NO_WINDOW)
    board.z(0.1)
    moved = board.z(1.0)
    assert np.abs(moved.mean(0) / plain - 1).max() > 1e-3
    assert (moved.std(0) / plain).max() < 1e-5


def test_offsets_that_wander_are_left_as_the_setting_leaves_them(host):
    """By time constants of 0.5 to 1.3 ms, those of |Z| of 9 to 23 kohm."""
    left = {s: spread(host, s, wander_v=0.3) for s in (PAPER, COHERENT, NO_WINDOW, NAMED["fit"])}
    assert left[NO_WINDOW] > 4 * left[PAPER] > 12 * left[COHERENT]
    assert left[PAPER] > 3 * left[NAMED["fit"]]


def test_mains_are_left_as_the_setting_leaves_them(host):
    left = {s: spread(host, s, mains_v=0.2) for s in (PAPER, COHERENT, NO_WINDOW)}
    assert left[PAPER] / left[NO_WINDOW] == pytest.approx(sine_left(PAPER, 50.0) / sine_left(NO_WINDOW, 50.0), rel=0.5)
    assert left[COHERENT] < left[PAPER] / 30
