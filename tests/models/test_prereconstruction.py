"""The dual form against the paper's equation 1 written out, the detection statistic against counted false alarms."""

import numpy as np
import pytest

from models.prereconstruction import Drift, Matrices, PreReconstructor

K, SIDE, E = 20, 6, 4
J = np.random.default_rng(0).standard_normal((K, SIDE**2)) * np.exp(-np.linspace(0, 3, SIDE**2))
CONTACT = np.random.default_rng(1).standard_normal((K, E))
R = np.diag((J**2).sum(axis=0) ** 0.5)
LADDER = np.array([1e-1, 1e-3])


@pytest.fixture
def rng():
    return np.random.default_rng(2)


def matrices(**changes):
    back = np.linalg.solve(R, J.T)
    pattern, inside = [(k % E, (k + 1) % E, k % E, (k + 1) % E) for k in range(K)], np.ones((SIDE, SIDE), bool)
    values = dict(pattern=np.array(pattern), z0=np.linspace(1, 3, K), gram=J @ back, back=back, jacobian=J)
    values |= dict(contact=CONTACT, inside=inside, ladder=LADDER, level=np.ones(2), scale_index=0)
    return Matrices(**(values | dict(normalisation="model", model_error=0.0) | changes))


def images(operator, d):
    """The operator's images in S/m."""
    return operator.images(d[None])[0].reshape(len(LADDER), SIDE, SIDE)


@pytest.mark.parametrize("unequal", [False, True])
def test_dual_form_is_equation_one_and_its_variance_that_of_images_of_noise(rng, unequal):
    sigma = np.full(K, 1e-3) if not unequal else rng.uniform(0.5e-3, 2e-3, K)
    operator = PreReconstructor(matrices()).condition(sigma, tare_frames=10**9)
    d = J @ rng.uniform(0, 0.3, SIDE**2)
    weight = np.diag(1 / sigma**2)
    mean = np.trace(J @ np.linalg.solve(R, J.T)) / K / (sigma**2).mean()
    for k, lam in enumerate(LADDER):
        expected = np.linalg.solve(J.T @ weight @ J + lam * mean * R, J.T @ weight @ d).reshape(SIDE, SIDE)
        assert images(operator, d)[k] == pytest.approx(expected, rel=1e-3, abs=1e-4 * np.abs(expected).max())
    counted = operator.images(sigma * rng.standard_normal((20000, K))).var(axis=0)
    assert counted == pytest.approx(operator.variance, rel=0.08)


def test_a_dead_electrode_has_no_say(rng):
    weights = np.ones(K)
    weights[::4] = 0
    operator = PreReconstructor(matrices()).condition(np.full(K, 1e-3), weights=weights)
    d = J @ rng.uniform(0, 0.3, SIDE**2)
    wild = np.where(weights > 0, d, 1e3)
    assert np.array_equal(operator.stack(wild)[0], operator.stack(d)[0])
    assert operator.score(wild) == operator.score(d)
    with pytest.raises(ValueError, match="0 of 20 measurements are live"):
        PreReconstructor(matrices()).condition(np.full(K, 1e-3), weights=np.zeros(K))


def test_drift_allowance_silences_drift_and_not_touches():
    pre, sigma = PreReconstructor(matrices()), np.full(K, 1e-4)
    drifted = 0.05 * CONTACT @ np.array([1.0, -1.0, 0.5, 0.2])
    without, allowed = pre.condition(sigma), pre.condition(sigma, drift=Drift(contact=0.05))
    assert without.score(drifted) > without.threshold() and allowed.score(drifted) < allowed.threshold()
    assert allowed.score(J @ np.full(SIDE**2, 0.05)) > allowed.threshold()


@pytest.mark.parametrize("estimated", [False, True])
def test_threshold_keeps_its_false_alarm_rate(rng, estimated):
    pre, true, alarms = PreReconstructor(matrices()), np.full(K, 1e-3), []
    for _ in range(60):
        frames = true * rng.standard_normal((64, K))
        sigma = frames.std(axis=0, ddof=1) if estimated else true
        operator = pre.condition(sigma, tare_frames=64 if estimated else 10**9)
        noise = true * rng.standard_normal((2000, K)) - (frames.mean(axis=0) if estimated else 0)
        scores = operator.detection @ (operator.whiten @ noise.T) ** 2
        alarms.append((scores > operator.threshold(0.01, 64 if estimated else 10**6)).mean())
    assert 0.004 < np.mean(alarms) < 0.02


def test_contact_impedance_leaves_the_model_normalised_difference(rng):
    pre = PreReconstructor(matrices())
    z0, change, series = pre.m.z0, 0.02 * rng.standard_normal(K), 0.1 * rng.standard_normal(K)
    series -= np.median((z0 + series) / z0 - 1) * z0
    d = pre.difference(1.7 * (z0 + series + change), 1.7 * (z0 + series))
    assert d == pytest.approx(change / z0, rel=0.02, abs=1e-9)
    measured = PreReconstructor(matrices(normalisation="measured"))
    assert measured.difference(2 * z0, z0) == pytest.approx(np.ones(K))


def test_one_step_is_thresholded_and_scale_makes_the_stack_independent_of_the_drop(rng):
    operator, d = PreReconstructor(matrices()).condition(np.full(K, 1e-3)), J[:, 14] * 0.5
    raw, shown = operator.one_step(d, 12, threshold=None), operator.one_step(d, 12, threshold=0.5)
    assert raw.min() < 0 and np.array_equal(shown, np.where(raw > 0.5 * raw.max(), raw, 0))
    quiet = PreReconstructor(matrices()).condition(np.full(K, 1e-9))  # noise aside
    d = J @ rng.uniform(0, 0.3, SIDE**2)
    one, two = quiet.stack(d), quiet.stack(2 * d)
    assert two[0] == pytest.approx(one[0], abs=1e-4) and two[2] == pytest.approx(2 * one[2], rel=1e-4)


def test_one_noisy_measurement_does_not_blur_the_others() -> None:
    pre, sigma, d = PreReconstructor(matrices()), np.full(K, 3e-4), J[:, 14] * 0.3
    without = pre.condition(sigma, weights=(np.arange(K) != 5).astype(float))
    for noisy in (3e-2, 1e10):
        sigma[5] = noisy
        with_it = pre.condition(sigma)
        assert with_it.noise < 1.6 * without.noise  # the mean of the variances would make it 20 times
        one, other = images(with_it, d), images(without, d)
        assert np.linalg.norm(one - other) < 0.15 * np.linalg.norm(other)
