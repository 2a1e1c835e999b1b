"""Whitening and the model of the noise: what they say of frames that are drawn by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from models.measurement.covariance.lines import ELSEWHERE, Lines
from models.measurement.covariance.noise import NoiseModel, in_blocks
from models.measurement.covariance.whitening import Whitening, leave_out
from tests.models.solved import tables

NOISE, SPAN_S = 1e-4, 0.0437
TIMES_S = ((np.arange(120) + 0.5) / 120 - 0.5) * SPAN_S
ORDER = np.arange(120)


def energy(noise: NoiseModel, frames: np.ndarray, part: int) -> float:
    """Mean squared whitened value: 1 where the covariance is that of the frames."""
    return float((Whitening.of(noise.covariance(part))(frames.T) ** 2).mean())


def test_a_whitening_is_one_root_of_the_inverse_covariance() -> None:
    roots = np.random.default_rng(0).standard_normal((6, 6)) + 2 * np.eye(6)
    covariance = roots @ roots.T
    white, inverse, value = Whitening.of(covariance), np.linalg.inv(covariance), np.arange(6.0)
    assert_allclose(white.w @ covariance @ white.w.T, np.eye(6), atol=1e-9)
    assert_allclose(white(value), white.w @ value)
    assert_allclose(white.solve(value), inverse @ value)
    assert_allclose(white.conditional_precisions(), np.diag(inverse))
    assert white.log_density == pytest.approx(-0.5 * np.linalg.slogdet(covariance)[1])
    leave_out(covariance, np.array([True, False, True, True, True, False]))
    assert_allclose(covariance, roots @ roots.T + np.diag([0, 1e4, 0, 0, 0, 1e4]), atol=1e-9)
    with pytest.raises(ValueError, match="not positive"):
        Whitening.of(-np.eye(3))


def test_a_covariance_is_of_white_noise_contacts_and_lines() -> None:
    noise = NoiseModel(tables())
    assert noise.now.white == pytest.approx(NOISE**2) and noise.alike(4) == 0
    flicker, jitter = np.linspace(1e-7, 2e-7, 16), np.linspace(3e-7, 0, 16)
    noise.now = replace(noise.now, flicker=flicker, jitter=jitter)
    noise.lines.now.columns, noise.lines.now.part = 1e-3 * np.random.default_rng(1).standard_normal((120, 2)), 4
    contact = tables().contact
    alone = NOISE**2 + 2e-6**2 + contact**2 @ jitter
    expected = np.diag(alone) + contact * flicker @ contact.T
    assert_allclose(noise.variances(), alone)
    assert_allclose(noise.covariance(5), expected, atol=1e-18)  # of scans that end otherwise nothing is known yet
    assert_allclose(noise.covariance(4), expected + noise.disturbing(4) @ noise.disturbing(4).T, atol=1e-18)
    assert noise.alike(4) == 4 and noise.alike(5) == 0
    made = in_blocks(np.ones((120, 1)), ORDER[::-1], 3.0)  # as strong within 12 that follow, nothing between
    assert made[119, 108] == made[0, 11] == 9 and made[0, 12] == made[119, 107] == 0


def test_contact_noise_is_learnt_and_white_noise_is_not_mistaken_for_it() -> None:
    """Of electrode 3 common to a scan, of electrode 12 anew each time. One that came late ends otherwise."""
    rng, contact = np.random.default_rng(5), tables().contact
    rows = NOISE * rng.standard_normal((256, 120)) + 5e-3 * rng.standard_normal((256, 1)) * contact[:, 3]
    rows += 3e-3 * rng.standard_normal((256, 120)) * contact[:, 12]
    noise = NoiseModel(tables())
    noise.begin(rows, (0,) * 255 + (3,))
    assert np.sqrt(noise.now.white) == pytest.approx(NOISE, rel=0.1)
    assert np.sqrt(noise.now.flicker[3]) == pytest.approx(5e-3, rel=0.2)
    assert np.sqrt(np.delete(noise.now.flicker, [3, 12])).max() < 1e-3
    assert np.sqrt(noise.now.jitter[12]) == pytest.approx(3e-3, rel=0.25)
    assert np.sqrt(np.delete(noise.now.jitter, 12)).max() < 1e-3
    assert noise.lines.now.part == 0 and not noise.disturbing(0).shape[1]


@pytest.mark.parametrize("louder", [0.5, 2.0])
def test_noise_that_changes_is_followed(louder: float) -> None:
    """White noise of another strength, and a contact that begins to flicker; under a touch the contacts' alone."""
    rng, free, touched = np.random.default_rng(6), NoiseModel(tables()), NoiseModel(tables())

    def frame() -> np.ndarray:
        return louder * NOISE * rng.standard_normal(120) + 1e-2 * rng.standard_normal() * tables().contact[:, 9]

    for noise, learn in ((free, free.learn), (touched, touched.learn_contacts)):
        for _ in range(400):
            white = Whitening.of(noise.covariance(0))
            learn(white.solve(frame()), white)
        assert np.sqrt(noise.now.flicker[9]) == pytest.approx(1e-2, rel=0.45)
        assert np.sqrt(np.delete(noise.now.flicker, 9)).max() < 3e-3
    assert touched.now.white == pytest.approx(NOISE**2)
    assert 0.8 < energy(free, np.array([frame() for _ in range(64)]), 0) < 1.3
    assert louder > 1 or np.sqrt(free.now.white) == pytest.approx(0.5 * NOISE, rel=0.15)


def test_a_line_of_any_phase_and_pickup_is_learnt_as_what_scans_have_in_common() -> None:
    rng = np.random.default_rng(6)
    pickup = rng.standard_normal(120)

    def frames(count: int) -> np.ndarray:
        turns = 50.0 * TIMES_S + rng.random((count, 1))
        return NOISE * rng.standard_normal((count, 120)) + 3e-4 * pickup * np.sin(2 * np.pi * turns)

    at_once, one_by_one = NoiseModel(tables()), NoiseModel(tables())
    at_once.begin(frames(128), (0,) * 128)
    for n, left in enumerate(frames(128)):
        one_by_one.hear(np.linalg.solve(one_by_one.covariance(0), left), 0, False, n * SPAN_S, SPAN_S)
    for noise, most in ((at_once, 1.3), (one_by_one, 1.6)):
        assert noise.disturbing(0).shape[1] == 2 and noise.disturbing(3).shape[1] == 0
        assert 0.8 < energy(noise, frames(64), 0) < most
    assert energy(NoiseModel(tables()), frames(64), 0) > 3


def test_what_stays_from_scan_to_scan_is_no_line_and_what_is_learnt_elsewhere_takes_300_scans() -> None:
    rng, pickup = np.random.default_rng(8), np.random.default_rng(9).standard_normal(120)
    stays, slow, ends, both, now = Lines(120), Lines(120), Lines(120), Lines(120), 0.0
    for n in range(400):
        now = 0.95 * now + np.sqrt(1 - 0.95**2) * rng.standard_normal()
        white = NOISE * rng.standard_normal(120)
        for lines, strength, part in (
            (stays, 3e-4, 0),
            (slow, 1e-3 * now, 0),
            (ends, 3e-4 * rng.standard_normal(), 0 if n < 40 else 7),
        ):
            if lines.hear(white + strength * pickup, part, False, n * SPAN_S, SPAN_S):
                lines.now.make(NOISE**2)
        both.hear(white, 7 if n % 10 else 0, False, n * SPAN_S, SPAN_S)
        assert both.now.part == 0 and ends.now.part == (0 if n < 40 + ELSEWHERE - 1 else 7), n
    assert np.linalg.norm(stays.columns(0)) < 0.4 * np.linalg.norm(3e-4 * pickup)
    most = np.sqrt(4 * 0.05) * 1e-3 * np.linalg.norm(pickup)  # four times what alternates from scan to scan
    assert np.linalg.norm(slow.columns(0)) == pytest.approx(most, rel=0.2)
    assert ends.columns(7).shape[1] == 1
    size, along = (np.linalg.norm(ends.columns(7)), ends.columns(7)[:, 0] @ pickup / np.linalg.norm(pickup))
    assert size == pytest.approx(3e-4 * np.linalg.norm(pickup), rel=0.35) and abs(along) > 0.98 * size


@pytest.mark.parametrize("hertz", [50.0, 123.4])
def test_a_line_that_is_learnt_of_scans_that_end_with_one_part_is_known_of_all_others(hertz: float) -> None:
    rng = np.random.default_rng(7)
    pickup, order = rng.standard_normal(120), np.argsort(np.argsort(TIMES_S))

    def disturbed(scans: int, newer: np.ndarray, sweeps: float = 0.0) -> np.ndarray:
        """(scans, K); newer (K,): measured a scan later."""
        at_s = np.arange(scans)[:, None] * SPAN_S + TIMES_S + newer * SPAN_S
        turns = (hertz + sweeps * np.sin(at_s)) * at_s + rng.random()
        return NOISE * rng.standard_normal((scans, 120)) + 3e-4 * pickup * np.sin(2 * np.pi * turns)

    newer = order < 36
    for sweeps, most in ((0.0, 1.3), (20.0, 1.6)):
        noise = NoiseModel(tables())
        noise.begin(disturbed(128, np.zeros(120), sweeps), (10,) * 128)
        noise.lines.ordered(10, order)
        noise.lines.ordered(3, (order - 36) % 120)
        noise.lines.ordered(4, np.roll(order, 1)[::-1])  # parts were lost: its scans are no two of those
        assert 0.8 < energy(noise, disturbed(64, newer, sweeps), 3) < most
        assert noise.disturbing(4).shape[1] == 0
        if not sweeps:
            assert np.linalg.svd(noise.lines.now.turn)[1].min() > 0.9
            alone, together = (noise.disturbing(part) @ noise.disturbing(part).T for part in (10, 3))
            assert_allclose(np.diag(together), np.diag(alone), rtol=1e-6)
