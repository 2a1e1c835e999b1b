"""What a scan's setting leaves of noise and disturbances, against sums done by hand and signals sampled here; and
`skin limits --scan`.
"""

import json

import numpy as np
import pytest

from models import limits
from models.scan_limits import WANDER_V, EarlyTouch, errors
from models.scan_orders import Neighbours, by_change, by_switching
from models.scan_response import noise, offset_left, sine_left, transient, transient_left, weights
from models.scan_table import SETTINGS
from protocol.scan_setting import COHERENT, PAPER, SAMPLES_HZ, ScanSetting, ScanSettingError

NO_WINDOW = ScanSetting(50_000, 64, window="none")
FIT = ScanSetting(50_000, 16, 4, "fit")


@pytest.fixture(scope="module")
def touch():
    return EarlyTouch("square16")


def value(setting, volts):
    """What a setting measures of a signal of time since the settling's end."""
    return np.sum(weights(setting) * volts(np.arange(len(weights(setting))) / SAMPLES_HZ))


def test_the_papers_setting_takes_the_papers_time():
    assert PAPER.pair_s == pytest.approx(363e-6, abs=0.5e-6)
    assert 1 / PAPER.scan_s(120) == pytest.approx(22.9, abs=0.05)
    assert [1e3 * s.scan_s(120) for s in (NO_WINDOW, ScanSetting(50_000, 32, window="none"))] == pytest.approx(
        [24.4, 14.8], abs=0.05
    )


def test_a_filter_takes_its_filling():
    """(N + 2) outputs of four samples and one sample, of 20 clocks each, and 25 clocks: 73 samples."""
    assert ScanSetting(50_000, 16, 4).dft_s == pytest.approx((73 * 20 + 25) / 16e6)
    assert len(weights(ScanSetting(50_000, 16, 4))) <= 73


def test_white_noise_grows_by_half_in_variance_with_a_hanning_window():
    assert (noise(COHERENT) / noise(ScanSetting(50_000, window="none"))) ** 2 == pytest.approx(1.5)
    assert noise(NO_WINDOW) == pytest.approx(np.sqrt(2 / 1.5))
    assert noise(ScanSetting(50_000, 32, window="none")) == pytest.approx(np.sqrt(4 / 1.5))


@pytest.mark.parametrize("setting", [COHERENT, NO_WINDOW, FIT, ScanSetting(40_000, 16, 5)], ids=str)
def test_white_noise_is_what_drawn_noise_leaves(setting):
    rng = np.random.default_rng(3)
    drawn = rng.standard_normal((4000, len(weights(setting)))) @ weights(setting)
    paper = rng.standard_normal((4000, len(weights(PAPER)))) @ weights(PAPER)
    assert drawn.std() / paper.std() == pytest.approx(noise(setting), rel=0.05)


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_a_sine_is_measured_as_its_phasor(setting):
    """At every phase alike where cycles are whole; the paper's 6.4 cycles are off by the window's leakage."""
    turn = 2 * np.pi * setting.frequency_hz
    sizes = [abs(value(setting, lambda t, p=phase: 0.3 * np.cos(turn * t + p))) for phase in np.arange(0, 6, 0.5)]
    assert sizes == pytest.approx([0.3] * len(sizes), rel=1e-9 if setting.coherent else 2e-4)
    assert setting.coherent == (setting != PAPER)


def test_a_steady_offset_is_nothing_to_whole_cycles():
    assert offset_left(COHERENT) < 1e-12 and offset_left(NO_WINDOW) < 1e-12 and offset_left(FIT) < 1e-12
    assert 1e-3 < offset_left(PAPER) < 5e-3


def test_an_exponential_is_left_as_its_sum_says():
    """A geometric series, of a DFT without a window."""
    tau, q = 3e-4, np.exp(-1 / SAMPLES_HZ / 3e-4 - 2j * np.pi / 16)
    series = np.exp(-20e-6 / tau) * (1 - q**64) / (1 - q) * 2 / 64
    assert transient(NO_WINDOW, tau) == pytest.approx(series)
    assert abs(transient(NO_WINDOW, tau)) <= transient_left(NO_WINDOW)


def test_without_a_window_settling_is_rejected_less():
    """By 9 to 30 dB, as was known before."""
    less = 20 * np.log10(transient_left(NO_WINDOW) / transient_left(PAPER))
    assert 9 < less < 30
    assert transient_left(FIT) < transient_left(PAPER) / 2
    assert transient_left(ScanSetting(50_000, 64, window="none", settle_s=4e-4)) < transient_left(NO_WINDOW) / 5


def test_a_fit_takes_its_own_exponential_for_what_it_is():
    raw = abs(value(FIT, lambda t: 1 - 0.4 * np.exp(-t / 2e-4)))
    assert raw < 1e-3 < abs(value(NO_WINDOW, lambda t: 1 - 0.4 * np.exp(-t / 2e-4)))


def test_mains_are_left_as_a_slow_sine():
    """Within a DFT 50 Hz are a ramp: without a window it leaves 50 Hz over the frequency, twice at the worst phase."""
    assert sine_left(NO_WINDOW, 50.0) == pytest.approx(2 * 50 / 50_000, rel=0.02)
    assert sine_left(COHERENT, 50.0) < sine_left(PAPER, 50.0) / 30
    assert sine_left(NO_WINDOW, 50_000) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"points": 100}, "100 DFT points: a power of two from 4 to 16384"),
        ({"sinc3": 3}, "sinc3 of 3 samples: expected 1, 2, 4, 5"),
        ({"window": "kaiser"}, "window 'kaiser': expected one of none, hanning, fit"),
        ({"frequency_hz": 100_000}, "100000 Hz: 1000 to 80000"),
        ({"frequency_hz": 60_000, "sinc3": 5}, "60000 Hz: 1000 to 53333"),
        ({"frequency_hz": 5_000}, "0.8 cycles in 128 points at 5000 Hz: at least 2"),
        ({"window": "fit"}, "a fit with sinc3 of 1: at least 4"),
        ({"window": "fit", "sinc3": 4, "points": 4}, "4 points of a fit: a power of two from 8 to 128"),
        ({"settle_s": 1.0}, "settling for 1.0 s: 0 to 0.01"),
    ],
)
def test_a_setting_that_no_board_can_do_is_refused(given, says):
    with pytest.raises(ScanSettingError) as refused:
        ScanSetting(**{"frequency_hz": 50_000} | given)
    assert says in str(refused.value)


def test_floors_fall_with_time_and_rise_with_wander(touch):
    still = errors(COHERENT, 80.0, 0.25, wander_v=0.0)
    moved = errors(COHERENT, 80.0, 0.25, wander_v=0.1)
    floors = [touch.floor(COHERENT, still, after_s) for after_s in (0.005, 0.025, 0.1, 0.4)]
    assert all(a.place_m > b.place_m and a.force > b.force for a, b in zip(floors, floors[1:], strict=False))
    assert floors[2].place_m / floors[3].place_m == pytest.approx(2, rel=0.1)  # four times as many values
    lasting = [touch.floor(COHERENT, moved, after_s).place_m for after_s in (0.1, 0.4)]
    assert 1 < lasting[0] / lasting[1] < 1.3  # which no mean takes away
    assert lasting[1] > 1.5 * floors[3].place_m


def test_floor_of_one_scan_is_that_of_its_information(touch):
    """By the sums of models/fisher.py, without a prior on place to speak of."""
    of = errors(COHERENT, 80.0, 0.0, wander_v=0.0)
    ideal = []
    for slope in touch.slopes:
        covariance = np.linalg.inv(slope.T @ slope / of.white**2 + np.diag([3, 3, 4, 1]))
        ideal.append(covariance[0, 0] + covariance[1, 1])
    found = touch.floor(COHERENT, of, 120.25 * COHERENT.pair_s + 1e-9).place_m / touch.unit_m
    assert found == pytest.approx(np.sqrt(np.mean(ideal)), rel=0.02)


def test_what_settles(touch):
    change = Neighbours.of(touch.z0, touch.pattern, touch.order).change
    assert errors(PAPER, 80.0, change).settles and errors(COHERENT, 80.0, change).settles
    assert not errors(NO_WINDOW, 80.0, change).settles
    at_the_edge = errors(NO_WINDOW, 80.0, change, wander_v=errors(NO_WINDOW, 80.0, change).bears_v)
    assert at_the_edge.lasting == pytest.approx(at_the_edge.white)
    assert errors(NO_WINDOW, 80.0, change).bears_v < WANDER_V


def test_orders_keep_each_parts_measurements(touch):
    shipped = Neighbours.of(touch.z0, touch.pattern, touch.order)
    for made in (
        by_change(touch.z0, touch.order, touch.parts),
        by_switching(touch.pattern, touch.order, touch.parts),
    ):
        for a, b in zip(np.split(made, touch.parts), np.split(touch.order, touch.parts), strict=True):
            assert sorted(a) == sorted(b)
    calm = Neighbours.of(touch.z0, touch.pattern, by_change(touch.z0, touch.order, touch.parts))
    quiet = Neighbours.of(touch.z0, touch.pattern, by_switching(touch.pattern, touch.order, touch.parts))
    assert calm.change < shipped.change / 3 and quiet.switched < shipped.switched


def test_command_line(capsys):
    assert limits.main(["--scan", "--snr", "80", "--grid", "4"]) == 0
    text = capsys.readouterr().out
    assert "10 parts of 12, 132 bytes: 4.36 ms, 1.43 ms, 33 %" in text
    best = text[text.index("Lowest floors") :].splitlines()
    assert f"by the chip's own DFT      {COHERENT}" in best[1] and str(PAPER) in best[2] and "fit" in best[3]
    assert limits.main(["--scan", "--snr", "80", "--grid", "4", "--json", "--interference"]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {row["setting"]: row for row in report["rows"]}
    assert report["case"] == {"skin": "square16", "snr_db": 80.0, "wander_mv": 1.0, "interference": True}
    assert rows[str(PAPER)]["pair_us"] == pytest.approx(363, abs=0.5) and rows[str(PAPER)]["noise"] == 1.0
    assert rows[str(COHERENT)]["place_mm_after_25_ms"] < 0.5 * rows[str(PAPER)]["place_mm_after_25_ms"]
    assert rows[str(PAPER)]["noise_with_all"] == pytest.approx(np.sqrt(1 + 8), rel=0.03)  # twice the noise, two times
    assert rows[str(NO_WINDOW)]["settles"] is False and rows[str(FIT)]["settles"] is True


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--scan", "--rank"], "found --scan and --rank"),
        (["--scan", "--floor-ohm", "1e-3"], "found --scan and --floor-ohm"),
        (["--scan", "--forces"], "found --forces and --scan"),
        (["--interference"], "found --interference without --scan"),
        (["--wander-mv", "2"], "found --wander-mv without --scan"),
    ],
)
def test_options_that_the_table_would_not_heed_are_refused(capsys, given, says):
    with pytest.raises(SystemExit) as ended:
        limits.main(given)
    assert ended.value.code == 2 and says in capsys.readouterr().err
    assert limits.main(["--scan", "--snr", "inf"]) == 2
