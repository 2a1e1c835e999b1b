"""What a scan's setting leaves of disturbances, against sums done by hand and signals sampled here."""

import numpy as np
import pytest

from models.scan_response import offset_left, sine_left, weights
from models.scan_table import SETTINGS
from protocol.scan_setting import COHERENT, PAPER, SAMPLES_HZ, ScanSetting, ScanSettingError

NO_WINDOW = ScanSetting(50_000, 64, window="none")
FIT = ScanSetting(50_000, 16, 4, "fit")


def value(setting, volts):
    """What a setting measures of a signal of time since the settling's end."""
    return np.sum(weights(setting) * volts(np.arange(len(weights(setting))) / SAMPLES_HZ))


def test_settings_take_the_time_of_their_samples():
    assert PAPER.pair_s == pytest.approx(363e-6, abs=0.5e-6) and 1 / PAPER.scan_s(120) == pytest.approx(22.9, abs=0.05)
    assert 1e3 * NO_WINDOW.scan_s(120) == pytest.approx(24.4, abs=0.05)
    # (N + 2) outputs of four samples and one sample, of 20 clocks each, and 25 clocks: 73 samples
    assert ScanSetting(50_000, 16, 4).dft_s == pytest.approx((73 * 20 + 25) / 16e6)


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_a_sine_is_measured_as_its_phasor(setting):
    """At every phase alike where cycles are whole; the paper's 6.4 cycles are off by the window's leakage."""
    turn = 2 * np.pi * setting.frequency_hz
    sizes = [abs(value(setting, lambda t, p=phase: 0.3 * np.cos(turn * t + p))) for phase in np.arange(0, 6, 0.5)]
    assert sizes == pytest.approx([0.3] * len(sizes), rel=1e-9 if setting.coherent else 2e-4)
    assert setting.coherent == (setting != PAPER)


def test_what_offsets_transients_and_mains_leave():
    """Within a DFT 50 Hz are a ramp: without a window it leaves 50 Hz over the frequency, twice at the worst phase."""
    assert all(offset_left(setting) < 1e-12 for setting in (COHERENT, NO_WINDOW, FIT))
    assert 1e-3 < offset_left(PAPER) < 5e-3
    decays = [abs(value(setting, lambda t: 1 - 0.4 * np.exp(-t / 2e-4))) for setting in (FIT, NO_WINDOW)]
    assert decays[0] < 1e-3 < decays[1]  # a fit takes its own exponential for what it is
    assert sine_left(NO_WINDOW, 50.0) == pytest.approx(2 * 50 / 50_000, rel=0.02)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"points": 100}, "100 DFT points: a power of two from 4 to 16384"),
        ({"sinc3": 3}, "sinc3 of 3 samples: expected 1, 2, 4, 5"),
        ({"frequency_hz": 60_000, "sinc3": 5}, "60000 Hz: 1000 to 53333"),
        ({"frequency_hz": 5_000}, "0.8 cycles in 128 points at 5000 Hz: at least 2"),
        ({"window": "fit"}, "a fit with sinc3 of 1: at least 4"),
        ({"settle_s": 1.0}, "settling for 1.0 s: 0 to 0.01"),
    ],
)
def test_a_setting_that_no_board_can_do_is_refused(given, says):
    with pytest.raises(ScanSettingError, match=says):
        ScanSetting(**{"frequency_hz": 50_000} | given)
