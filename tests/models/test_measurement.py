"""What touches and noise do to the measurements, held against forward models that share nothing with the tables."""

from functools import cache

import numpy as np
import pytest

from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World, pressed
from firmware_stub.worlds import table
from models.bundle import Bundle
from models.measurement.course import TouchCourse
from models.measurement.covariance.noise import NoiseModel, in_blocks
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import FittedScan, FoundTouches, TouchFitter
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.grid import DiscGrid
from models.measurement.responses.tables import SkinTables, tables_of
from models.measurement.touch import ACTION, LOG_RADIUS, PLACE, RATE, VX, TouchPrior, X, Y, anywhere
from models.mismatch import Mismatch

NOISE = 1e-4
SPAN_S = 0.0437
UNIT_M = 0.05
TIMES_S = ((np.arange(120) + 0.5) / 120 - 0.5) * SPAN_S


@cache
def sheet(edge_m: float = 0.0) -> Sheet:
    """On the worlds' own mesh, which no bundle was built on."""
    return Sheet("square16", Mismatch(blur_m=edge_m), mesh=table.MESH)


@cache
def untouched() -> np.ndarray:
    return np.abs(sheet().model.read(sheet().transfer(World())))


def change(*touches: Touch, edge_m: float = 0.0) -> np.ndarray:
    """(K,) of |Z|, relative, by finite elements."""
    of = sheet(edge_m)
    return np.asarray(np.abs(of.model.read(of.transfer(World(touches)))) / untouched() - 1)


@cache
def tables() -> SkinTables:
    return tables_of(Bundle.load("square16")).relative_to(untouched())


def action_of(touch: Touch) -> float:
    return touch.drop / (1 - touch.drop / 2) * np.pi * (touch.radius / UNIT_M) ** 2


def fitted(y: np.ndarray, *priors: TouchPrior) -> FoundTouches:
    response = DiscResponse(tables())
    covariance = NoiseModel(tables()).covariance(0)
    scene = FittedScan(y, covariance, TouchCourse(response, TIMES_S, SPAN_S), tables().misfit, 120)
    return TouchFitter(scene, priors).fit(12)


@pytest.mark.parametrize(
    ("x", "y", "radius", "force"), [(0, 0, 10, 1), (10, 20, 20, 8), (30, 30, 6, 2), (-18, 5, 4, 0.3), (0, 0, 25, 8)]
)
def test_a_disc_does_what_finite_elements_say(x: float, y: float, radius: float, force: float) -> None:
    touch = pressed("circle", x * 1e-3, y * 1e-3, radius * 1e-3, force)
    there = change(touch)
    said = action_of(touch) * DiscResponse(tables())(x / 50, y / 50, np.log(radius / 50))
    scale = said @ there / (said @ said)
    assert scale == pytest.approx(1, abs=0.03)
    assert np.linalg.norm(there - scale * said) < 0.004 * np.linalg.norm(there)


def test_slopes_are_differences_of_responses() -> None:
    """A disc's rim runs through pixels, so that both scatter by a tenth of themselves."""
    response, step, off = DiscResponse(tables()), 0.03, list[float]()
    for x, y, radius in np.random.default_rng(0).uniform((-0.7, -0.7, 0.12), (0.7, 0.7, 0.4), (16, 3)):
        place = np.array([x, y, np.log(radius)])
        for axis, slope in enumerate(response.with_slopes(*place)[1:]):
            ahead, behind = place.copy(), place.copy()
            ahead[axis] += step
            behind[axis] -= step
            difference = (response(*ahead) - response(*behind)) / (2 * step)
            off.append(float(np.linalg.norm(difference - slope) / np.linalg.norm(difference)))
    assert np.median(off) < 0.2


def test_the_even_field_is_exact_by_scaling() -> None:
    """A sheet that conducts 1 % better has impedances lower by that, but for the contacts' own shares."""
    of = sheet()
    warmer = np.abs(of.model.read(of.transfer(World(background=1.01))))
    there = np.log(warmer / untouched())
    assert np.abs(there / np.log(1.01) - tables().field[:, 0]).max() < 0.002


def test_a_fit_finds_place_action_and_size_within_their_sigmas() -> None:
    rng = np.random.default_rng(1)
    off = []
    for _ in range(12):
        x, y = rng.uniform(-35, 35, 2)
        touch = pressed("circle", x * 1e-3, y * 1e-3, rng.uniform(6e-3, 15e-3), rng.uniform(0.5, 4))
        values = np.log1p(change(touch)) + NOISE * rng.standard_normal(120)
        start = anywhere(x / 50 + 0.1, y / 50 - 0.1, action_of(touch), SPAN_S)
        fit = fitted(values, start)
        sd = np.sqrt(np.diag(fit.covariance))
        assert fit.chi2 < 1.45
        off.append((fit.states[0, PLACE] - [x / 50, y / 50]) / sd[PLACE])
        assert fit.states[0, ACTION] == pytest.approx(action_of(touch), rel=0.08)
        assert abs(fit.states[0, LOG_RADIUS] - np.log(touch.radius / UNIT_M)) < 4 * sd[LOG_RADIUS] + 0.05
    assert np.abs(off).max() < 4
    assert 0.2 < np.std(off) < 1.6


@pytest.mark.parametrize(("kind", "aspect"), [("rectangle", 2.0), ("ellipse", 2.0), ("triangle", 1.0), ("L", 1.0)])
def test_touches_that_are_no_discs_are_explained_by_their_own_directions(kind: str, aspect: float) -> None:
    touch = pressed(kind, 0.009, -0.006, 0.015, 3.0, rotation=0.4, aspect=aspect)
    values = np.log1p(change(touch)) + NOISE * np.random.default_rng(2).standard_normal(120)
    fit = fitted(values, anywhere(0.1, -0.1, 0.05, SPAN_S))
    assert fit.chi2 < 1.45
    centroid = sheet().shape(touch).centroid
    assert np.linalg.norm(fit.states[0, PLACE] - centroid) * UNIT_M < 1e-3


def test_a_ramp_and_a_slide_within_a_scan_are_told_with_their_rates() -> None:
    """Values are measured one after the other: what each saw is solved at its own instant."""
    instants = np.linspace(0, 1, 7)
    at = [pressed("circle", (2 + 6 * u) * 1e-3, 5e-3, 9e-3, 1 + 0.6 * u) for u in instants]
    course = np.array([change(touch) for touch in at])
    tau = (np.arange(120) + 0.5) / 120
    values = np.log1p([np.interp(t, instants, course[:, k]) for k, t in enumerate(tau)])
    values += NOISE * np.random.default_rng(3).standard_normal(120)
    prior = anywhere(0.1, 0.1, 0.03, SPAN_S)
    prior.sd[VX:] = 0.2 / SPAN_S
    fit = fitted(values, prior)
    assert fit.chi2 < 1.45
    assert fit.states[0, X] == pytest.approx(5 / 50, abs=0.02)
    assert fit.states[0, Y] == pytest.approx(5 / 50, abs=0.02)
    assert fit.states[0, VX] * SPAN_S == pytest.approx(6 / 50, rel=0.25)
    assert fit.states[0, RATE] * SPAN_S / fit.states[0, ACTION] == pytest.approx(0.6 / 1.3, rel=0.35)


def test_two_touches_are_found_and_told_apart_by_the_grid_and_the_fit() -> None:
    both = pressed("circle", -15e-3, 5e-3, 8e-3, 2.0), pressed("circle", 15e-3, -5e-3, 8e-3, 0.5)
    values = np.log1p(change(*both)) + NOISE * np.random.default_rng(4).standard_normal(120)
    grid, white = DiscGrid(DiscResponse(tables())), Whitening.of(NoiseModel(tables()).covariance(0))
    z2, disc, _ = grid.likeliest(white.solve(values), grid.information(white))
    assert z2 > 44 and np.linalg.norm(grid.discs[disc, :2] - [-0.3, 0.1]) < 0.3
    one = fitted(values, anywhere(-0.3, 0.1, 0.05, SPAN_S))
    two = fitted(values, anywhere(-0.3, 0.1, 0.05, SPAN_S), anywhere(0.3, -0.1, 0.01, SPAN_S))
    assert two.evidence > one.evidence + 5 and two.chi2 < 1.45
    sd = np.sqrt(np.diag(two.covariance))[7:9]
    assert (np.abs(two.states[1, PLACE] - [0.3, -0.1]) < 3 * sd).all() and (sd < 0.06).all()


def test_contact_noise_is_learnt_and_white_noise_is_not_mistaken_for_it() -> None:
    rng = np.random.default_rng(5)
    flicker = np.zeros(16)
    flicker[3] = 5e-3
    rows = NOISE * rng.standard_normal((256, 120)) + rng.standard_normal((256, 16)) * flicker @ tables().contact.T
    noise = NoiseModel(tables())
    noise.begin(rows, (0,) * len(rows))
    assert np.sqrt(noise.now.white) == pytest.approx(NOISE, rel=0.1)
    assert np.sqrt(noise.now.flicker[3]) == pytest.approx(5e-3, rel=0.2)
    assert np.sqrt(np.delete(noise.now.flicker, 3)).max() < 1e-3


def test_a_line_of_any_phase_and_pickup_is_learnt_as_what_scans_have_in_common() -> None:
    rng = np.random.default_rng(6)
    pickup = rng.standard_normal(120)
    turns = 50.0 * TIMES_S + rng.random((128, 1))
    rows = NOISE * rng.standard_normal((128, 120)) + 3e-4 * pickup * np.sin(2 * np.pi * turns)
    noise = NoiseModel(tables())
    noise.begin(rows, (0,) * len(rows))
    fresh = NOISE * rng.standard_normal((64, 120))
    fresh += 3e-4 * pickup * np.sin(2 * np.pi * (50.0 * TIMES_S + rng.random((64, 1))))
    energy = (Whitening.of(noise.covariance(0))(fresh.T) ** 2).mean()
    assert 0.8 < energy < 1.3
    assert noise.disturbing(0).shape[1] == 2
    assert noise.disturbing(3).shape[1] == 0  # of scans that end otherwise nothing is known yet


@pytest.mark.parametrize("hertz", [50.0, 123.4])
def test_a_line_that_is_learnt_of_scans_that_end_with_one_part_is_known_of_all_others(hertz: float) -> None:
    """The phase goes on from scan to scan: as steadily as the line does, and not where its frequency sweeps."""
    rng = np.random.default_rng(7)
    pickup, order = rng.standard_normal(120), np.argsort(np.argsort(TIMES_S))

    def disturbed(scans: int, newer: np.ndarray, sweeps: float = 0.0) -> np.ndarray:
        """(scans, K); newer (K,): measured a scan later."""
        at_s = np.arange(scans)[:, None] * SPAN_S + TIMES_S + newer * SPAN_S
        turns = (hertz + sweeps * np.sin(at_s)) * at_s + rng.random()
        return NOISE * rng.standard_normal((scans, 120)) + 3e-4 * pickup * np.sin(2 * np.pi * turns)

    noise, newer = NoiseModel(tables()), order < 36
    noise.begin(disturbed(128, np.zeros(120)), (10,) * 128)
    noise.lines.ordered(10, order)
    noise.lines.ordered(3, (order - 36) % 120)
    energy = (Whitening.of(noise.covariance(3))(disturbed(64, newer).T) ** 2).mean()
    assert 0.8 < energy < 1.3
    assert np.linalg.svd(noise.lines.now.turn)[1].min() > 0.9
    alone = noise.disturbing(10) @ noise.disturbing(10).T
    together = noise.disturbing(3) @ noise.disturbing(3).T
    np.testing.assert_allclose(np.diag(together), np.diag(alone), rtol=1e-6)
    swept = NoiseModel(tables())
    swept.begin(disturbed(128, np.zeros(120), sweeps=20.0), (10,) * 128)
    swept.lines.ordered(10, order)
    swept.lines.ordered(3, (order - 36) % 120)
    energy = (Whitening.of(swept.covariance(3))(disturbed(64, newer, sweeps=20.0).T) ** 2).mean()
    assert energy < 1.6


def test_a_disturbance_in_blocks_is_as_strong_within_each_and_nothing_between() -> None:
    columns, order = np.ones((120, 1)), np.arange(120)
    made = in_blocks(columns, order, 3.0)
    assert made[0, 11] == 9 and made[0, 12] == 0


def test_a_covariance_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="not positive"):
        Whitening.of(-np.eye(3))
