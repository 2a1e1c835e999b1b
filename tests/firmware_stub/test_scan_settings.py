"""The board measures as its CONFIG says: time, noise, what is left of offsets and mains; and refuses what it cannot."""

import numpy as np
import pytest

from models.scan_response import noise, sine_left
from protocol import link
from protocol.scan_setting import COHERENT, NAMED, PAPER, ScanSetting
from tests.firmware_stub.conftest import PAIRS

NO_WINDOW = ScanSetting(50_000, 64, window="none")


def start(board, setting, scan=PAIRS):
    return board.started(link.Config.of(setting, config=1, rtia_ohm=80e3, scan=scan))


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
        (got,) = link.Decoder().feed(link.encode(link.Config.of(setting, config=3, rtia_ohm=80e3, scan=PAIRS[:4])))
        assert isinstance(got, link.Config) and got.setting == setting


def test_a_bad_setting_is_refused_with_its_reason_and_the_board_goes_on(host):
    board = host().start()
    for given, says in (
        ({"dft_points": 100}, "100 DFT points: a power of two from 4 to 16384"),
        ({"window": 7}, "window 'of number 7': expected one of none, hanning, fit"),
        ({"dft_points": 16}, "1 cycles in 16 points at 50000 Hz: at least 2"),
    ):
        answer = board.ask(link.Config(**{"config": 2, "dft_points": 128, "rtia_ohm": 80e3, "scan": PAIRS} | given))
        assert isinstance(answer, link.Nak) and answer.reason == link.NakReason.BAD_CONFIG and says in answer.text
    assert {frame.config for frame in board.frames(0.3)} == {1}


def test_offsets_and_mains_are_left_as_the_setting_leaves_them(host):
    """Steady ones move values and never change them: their transient is the same in every scan, which a tare takes."""

    def spread(setting, **volts):
        z = start(host(snr_db=120.0, **volts), setting).z(2.0)
        return float((z.std(0) / z.mean(0)).mean())

    plain = start(host(snr_db=120.0), NO_WINDOW).z(1.0).mean(0)
    moved = start(host(snr_db=120.0, offset_v=0.01), NO_WINDOW).z(1.1)[3:]
    assert np.abs(moved.mean(0) / plain - 1).max() > 1e-3 and (moved.std(0) / plain).max() < 1e-5
    left = {s: spread(s, wander_v=0.3) for s in (PAPER, COHERENT, NO_WINDOW, NAMED["fit"])}
    assert left[NO_WINDOW] > 4 * left[PAPER] > 12 * left[COHERENT]
    assert left[PAPER] > 3 * left[NAMED["fit"]]
    left = {s: spread(s, mains_v=0.2) for s in (PAPER, COHERENT, NO_WINDOW)}
    assert left[PAPER] / left[NO_WINDOW] == pytest.approx(sine_left(PAPER, 50.0) / sine_left(NO_WINDOW, 50.0), rel=0.5)
    assert left[COHERENT] < left[PAPER] / 30
