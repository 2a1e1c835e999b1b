"""The drift of the untouched skin in time: stationary, and independent of how time is cut."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.estimation.drift import DriftFilter, DriftProcess
from services.estimation.tuning import TUNING, table

PROCESS = DriftProcess.of_skin(16)
SECONDS = st.floats(min_value=1e-3, max_value=3e3)


def test_at_most_thirty_numbers_each_with_unit_meaning_and_origin() -> None:
    rows = table()
    assert len(rows) <= 30
    assert all(meaning and origin for _, _, _, meaning, origin in rows)


@settings(max_examples=60, deadline=None)
@given(SECONDS, SECONDS)
def test_noise_does_not_depend_on_how_time_is_cut(first: float, second: float) -> None:
    phi, q = PROCESS.transition(second), PROCESS.noise(first)
    cut = phi @ q @ phi.transpose(0, 2, 1) + PROCESS.noise(second)
    whole = PROCESS.noise(first + second)
    assert np.allclose(phi @ PROCESS.transition(first), PROCESS.transition(first + second), rtol=1e-9, atol=1e-15)
    size = np.sqrt(whole[:, [0, 1], [0, 1]])
    assert (np.abs(cut - whole) <= 1e-9 * size[:, :, None] * size[:, None, :]).all()


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(min_value=0.01, max_value=20.0), min_size=1, max_size=12))
def test_a_filter_knows_the_same_after_one_gap_and_after_many(steps: list[float]) -> None:
    one, many = DriftFilter(PROCESS), DriftFilter(PROCESS)
    rng = np.random.default_rng(1)
    columns, d = rng.standard_normal((30, 18)), 0.01 * rng.standard_normal(30)
    for drift in (one, many):
        drift.predict(5.0)
        drift.update(columns, d, 1e-4 * np.eye(30))
    one.predict(sum(steps))
    for step in steps:
        many.predict(step)
    assert np.allclose(one.mean, many.mean, rtol=1e-9, atol=1e-14)
    assert np.allclose(one.covariance, many.covariance, rtol=1e-7, atol=1e-15)


def test_the_old_hole_256_seconds_at_once_or_in_half_seconds() -> None:
    """(rate * gap)^2 a step gave 5.1 % for the scale in one gap and 0.23 % in half-second steps."""
    one, many = DriftFilter(PROCESS), DriftFilter(PROCESS)
    one.predict(256.0)
    for _ in range(512):
        many.predict(0.5)
    sd = np.sqrt([f.value_covariance[0, 0] for f in (one, many)])
    assert sd[0] == pytest.approx(sd[1], rel=1e-9)
    assert 0.02 < sd[0] < TUNING.scale_sd


def test_drift_goes_on_steadily_and_never_beyond_its_stationary_spread() -> None:
    def sd(seconds: float) -> float:
        return float(np.sqrt(PROCESS.value_covariance(seconds)[0, 0]))

    assert sd(2.0) / sd(1.0) == pytest.approx(2.0, rel=0.02)  # steady: proportional to time
    assert sd(1.0) == pytest.approx(TUNING.scale_sd / TUNING.drift_s, rel=0.02)
    assert sd(1e5) == pytest.approx(TUNING.scale_sd, rel=1e-9)
    assert all(sd(s) <= TUNING.scale_sd * (1 + 1e-12) for s in (10.0, 100.0, 1e3, 1e7))


def test_simulated_drift_has_the_stated_covariance() -> None:
    """Euler steps of the equation of motion, against Phi and Q of the whole time."""
    time_s, dt, steps, n = 10.0, 0.02, 400, 20_000
    rng = np.random.default_rng(0)
    x, r = np.zeros(n), np.zeros(n)
    push = np.sqrt(4 / time_s**3 * dt)  # keeps x at a standard deviation of 1
    for _ in range(steps):
        x, r = x + r * dt, r - (2 * r / time_s + x / time_s**2) * dt + push * rng.standard_normal(n)
    q = DriftProcess(np.ones(1), np.array([time_s])).noise(dt * steps)[0]
    assert np.cov(x, r) == pytest.approx(q, rel=0.06)


def test_the_filter_finds_a_drift_and_its_rate() -> None:
    """Against least squares on all frames: a scale that falls by 1e-5 a second, 80 dB."""
    rng = np.random.default_rng(2)
    process = DriftProcess.of_skin(16, creep=False)
    drift, columns = DriftFilter(process), np.hstack([np.ones((120, 1)), 0.05 * rng.random((120, 16))])
    for k in range(200):
        drift.predict(0.5)
        d = columns[:, 0] * (-1e-5 * 0.5 * (k + 1)) + 1e-4 * rng.standard_normal(120)
        drift.update(columns, d, 1e-8 * np.eye(120))
    assert drift.value[0] == pytest.approx(-1e-3, abs=4 * np.sqrt(drift.value_covariance[0, 0]))
    assert drift.value[0] == pytest.approx(-1e-3, abs=5e-5)
    assert drift.mean[17] == pytest.approx(-1e-5, abs=3e-6)


def test_a_state_comes_back_and_a_wrong_one_is_refused() -> None:
    drift, again = DriftFilter(PROCESS), DriftFilter(PROCESS)
    drift.predict(3.0)
    again.load(drift.state())
    assert np.array_equal(again.covariance, drift.covariance)
    with pytest.raises(ValueError, match="expected 36"):
        again.load({"mean": np.zeros(4), "covariance": np.zeros((4, 4))})
    with pytest.raises(ValueError, match="0 or more"):
        drift.predict(-1.0)
