"""The drift of the untouched skin in time: stationary, and independent of how time is cut."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.estimation.drift import DriftProcess
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
