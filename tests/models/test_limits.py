"""Limits: floors of a touch's errors against linear algebra; what a scan's setting leaves of disturbances, by hand."""

import numpy as np
import pytest

from models import limits
from models.fisher import MeasurementNoise, SizePrior, floors, information, sensitivity
from models.patterns import pattern
from models.prereconstruction import Drift
from models.scan_response import offset_left, sine_left, weights
from models.scan_table import SETTINGS
from models.shapes import Shape
from protocol.scan_setting import COHERENT, PAPER, SAMPLES_HZ, ScanSetting, ScanSettingError

TOUCH = Shape("circle", 0.31, 0.27, 0.2, 0.3)


def test_drift_is_marginalised_not_projected():
    """Against the whole information matrix of touch and drift, inverted."""
    seen, noise, rows = sensitivity("square16", TOUCH), MeasurementNoise(70.0), pattern("pairs")
    z0, slope, nuisance = seen.relative(rows)
    j = np.hstack([slope, nuisance]) / (noise.sigma(z0) / np.abs(z0))[:, None]
    prior = np.diag(np.r_[np.zeros(4), 1 / 0.01**2, np.full(16, 1 / 0.05**2)])
    found = np.linalg.inv(information(seen, rows, noise, Drift(0.01, 0.05)))
    np.testing.assert_allclose(found, np.linalg.inv(j.T @ j + prior)[:4, :4], rtol=1e-6)


def test_floors_are_those_that_others_found_and_the_best_pattern_depends_on_the_noise():
    for x in (0, 0.3):
        floor = floors("square16", Shape("circle", x, x, 0.2, 0.3), 70.0)["cramer_rao"]
        assert 0.25 < floor.position_percent < 0.6 and 0.25 < floor.drop < 0.6 and 0.02 < floor.integral < 0.10
    known = floors("square16", Shape("circle", 0.3, 0.3, 0.2, 0.3), 70.0, SizePrior(radius=(0.2, 0.2)))["cramer_rao"]
    assert 0.003 < known.drop < 0.015
    for noise, best in ((MeasurementNoise(np.inf, 1e-4), "pairs"), (MeasurementNoise(70.0), "adjacent")):
        assert limits.rank_patterns(limits.Case(noise=noise), per_side=2)[0][0] == best


def test_knowledge_lowers_floors_noise_raises_them_and_a_prior_bounds_them():
    free, loud = floors("square16", TOUCH, 80.0), floors("square16", TOUCH, 60.0)
    drifting = floors("square16", TOUCH, 80.0, drift=Drift(np.inf, np.inf))
    known = floors("square16", TOUCH, 80.0, SizePrior(radius=(0.2, 0.2)))["bayes"]
    for name in ("position", "radius", "drop", "integral"):
        bayes, rao = getattr(free["bayes"], name), getattr(free["cramer_rao"], name)
        assert getattr(known, name) <= bayes <= min(rao, getattr(drifting["bayes"], name))
        assert rao <= getattr(drifting["cramer_rao"], name)
    assert loud["cramer_rao"].position == pytest.approx(10 * free["cramer_rao"].position, rel=1e-9)
    deaf = floors("square16", TOUCH, -40.0)["bayes"]
    assert (deaf.radius, deaf.position) == pytest.approx((np.log(3) / np.sqrt(12), 2 * np.sqrt(2 / 12)), rel=0.01)
    hard = floors("square16", Shape("circle", 0.3, 0.2, 0.1, 0.9), 80.0)["bayes"]
    assert free["bayes"].force == pytest.approx(free["bayes"].integral) and hard.force > 1.5 * hard.integral


def test_the_command_takes_metres(capsys):
    said = [(limits.main(["--grid", "2", *more]), capsys.readouterr().out)[1] for more in ((), ("--radius", "0.01"))]
    assert said[0] == said[1] and "touch of radius 10 mm" in said[0]


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


@pytest.mark.parametrize(("given", "says"), [
    ({"points": 100}, "100 DFT points: a power of two from 4 to 16384"),
    ({"sinc3": 3}, "sinc3 of 3 samples: expected 1, 2, 4, 5"),
    ({"frequency_hz": 60_000, "sinc3": 5}, "60000 Hz: 1000 to 53333"),
    ({"frequency_hz": 5_000}, "0.8 cycles in 128 points at 5000 Hz: at least 2"),
    ({"window": "fit"}, "a fit with sinc3 of 1: at least 4"),
    ({"settle_s": 1.0}, "settling for 1.0 s: 0 to 0.01"),
])  # fmt: skip
def test_a_setting_that_no_board_can_do_is_refused(given, says):
    with pytest.raises(ScanSettingError, match=says):
        ScanSetting(**{"frequency_hz": 50_000} | given)
