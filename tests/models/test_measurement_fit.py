"""States of touches, their course in a scan, and fits of them: closed forms, finite elements, other outlines."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from models import bundle, geometry, manifest
from models.forward import ForwardModel
from models.linearise import linearise
from models.measurement import touch as touches
from models.measurement.course import TouchCourse
from models.measurement.fit import FittedScan, TouchFitter
from models.measurement.noise import NoiseModel
from models.measurement.tables import SkinTables, tables_of
from models.measurement.touch import ACTION, PLACE, RATE, VX, TouchPrior, X, Y, anywhere, plain
from models.measurement.whitening import Whitening
from models.response_tables import response_tables
from models.shapes import Shape

NOISE, SPAN_S = 1e-4, 0.0437
TIMES_S = ((np.arange(120) + 0.5) / 120 - 0.5) * SPAN_S


def test_states_of_a_touch_have_limits() -> None:
    state = np.array([[1.5, -2.0, np.log(0.01), 0.3, 1e9, 0.1, 0.2], [-0.5, 0.5, 3.0, 99.0, -1e9, 0.0, 0.0]])
    (x, y, small, _, rate, *_), (*_, large, most, falls, _, _) = touches.within_limits(state).tolist()
    assert (x, y) == (0.98, -0.98) and np.exp(large) == pytest.approx(0.6)
    assert small == pytest.approx(0.5 * np.log(0.3 / np.pi / 2)), "nothing conducts there"
    assert most == pytest.approx(2 * np.pi * 0.36) and rate == -falls == pytest.approx(most / 4e-4)
    assert (state[:, X] == [1.5, -0.5]).all()


class Hills:
    """A response in closed form: measurement k sees what is near its own place, larger touches less."""

    def __init__(self) -> None:
        self.places = np.random.default_rng(0).uniform(-1, 1, (120, 2))

    discs = np.zeros((0, 3))

    def __call__(self, x: float, y: float, log_radius: float) -> np.ndarray:
        away = np.array([x, y]) - self.places
        return np.asarray((1 + self.places[:, 0]) * np.exp(-(away**2).sum(axis=1) - 0.5 * log_radius))

    def with_slopes(self, x: float, y: float, log_radius: float) -> np.ndarray:
        at = self(x, y, log_radius)
        return np.stack([at, *(-2 * (np.array([x, y]) - self.places) * at[:, None]).T, -0.5 * at])

    def directions(self, x: float, y: float, log_radius: float) -> np.ndarray:
        return 0.1 * np.cos(np.arange(9)[:, None] * self.places[:, 1] + x)


STATES = np.array([[0.2, -0.1, -1.7, 0.02, 0.3, 0.4, -0.6], [-0.4, 0.3, -1.2, 0.01, -0.1, -8.0, 5.0]])  # one is fast
ONES = [TouchPrior(state, state, np.ones(7)) for state in STATES]


def test_a_course_is_each_touch_where_it_is_and_as_strong_when_a_value_is_measured() -> None:
    course, hills = TouchCourse(Hills(), TIMES_S, SPAN_S), Hills()
    found, expected = course.columns(STATES, ONES, course.directions(STATES)), np.zeros(120)
    for k, t in enumerate(TIMES_S):
        for x, y, log_radius, action, rate, vx, vy in STATES:
            expected[k] += (action + rate * t) * hills(x + vx * t, y + vy * t, log_radius)[k]
    assert np.abs(found.mean - expected).max() < 2e-3 * np.abs(expected).max()
    for n, state in enumerate(STATES):
        own = hills.directions(*state[:3]) * (state[ACTION] + state[RATE] * TIMES_S)
        assert_allclose(found.shapes[:, 9 * n : 9 * n + 9], own.T)
    for column in range(14):
        way = np.zeros(14)
        way[column] = 1e-5
        more, less = (course.columns(STATES + s * way.reshape(2, 7), ONES).mean for s in (1, -1))
        assert_allclose(found.slopes[:, column], (more - less) / 2e-5, rtol=0.02, atol=2e-4, err_msg=str(column))


def test_a_touch_acts_from_when_it_begins_until_it_ends_and_never_less_than_nothing() -> None:
    course = TouchCourse(Hills(), TIMES_S, SPAN_S)
    state = np.array([[0.2, -0.1, -1.7, 0.02, 0.0, 0.0, 0.0]])
    acts = np.asarray(course.columns(state, [replace(ONES[0], since_s=-0.01, until_s=0.012)]).mean != 0)
    assert (acts == ((TIMES_S >= -0.01) & (TIMES_S < 0.012))).all()
    state[0, VX] = 0.5  # slow: as one straight way about the middle of the time in which it acts
    moves = course.columns(state, [replace(ONES[0], since_s=0.01)]).mean
    expected = [0.02 * (t >= 0.01) * Hills()(0.2 + 0.5 * t, -0.1, -1.7)[k] for k, t in enumerate(TIMES_S)]
    assert_allclose(moves, expected, atol=2e-3 * np.abs(moves).max())
    state[0, [VX, RATE]] = 0.0, 0.02 / 0.01
    assert ((course.columns(state, ONES[:1]).mean != 0) == (TIMES_S > -0.01)).all()


def test_what_changes_unevenly_bends_where_it_does_and_not_elsewhere() -> None:
    course, response = TouchCourse(Hills(), TIMES_S, SPAN_S), 0.02 * Hills()(0.2, -0.1, -1.7)
    still = np.array([[0.2, -0.1, -1.7, 0.02, 0.0, 0.0, 0.0]])
    assert course.kinks(still, ONES[:1]) == [] and not course.jitter(still, ONES[:1]).any()
    grows, slides = still.copy(), still.copy()
    grows[0, RATE], slides[0, VX] = 0.02 / SPAN_S, 0.06 / SPAN_S
    assert course.bends(np.vstack([still, grows, slides]), ONES[:1] * 3) == [(False,) * 2, (True, False), (False, True)]
    (steps,) = course.kinks(grows, ONES[:1])
    assert (steps.touch, steps.bends, len(steps)) == (0, 0, 11)
    assert_allclose(steps.profiles.sum(axis=0), 0.3 * 0.02)  # hats add up: COURSE_SD of what it may change by
    along_x, along_y = course.kinks(slides, ONES[:1])
    assert (along_x.bends, along_y.bends) == (X + 1, Y + 1)
    assert_allclose(along_x.profiles[0], 0.02 * 0.8 * 0.03 * ((TIMES_S / (SPAN_S / 2)) ** 2 - 1 / 3))
    ends, near = replace(ONES[0], until_s=0.01), np.abs(TIMES_S - 0.01) < 0.006
    assert_allclose(course.jitter(still, [ends]), np.abs(response) * np.where(near, 0.1, 0.03 * (TIMES_S < 0.01)))
    (hats,) = course.kinks(still, [ends])
    assert np.abs(hats.profiles[:5]).max() <= 0.5 * 0.02 and not hats.profiles[:5, ~near].any()
    for grew, other in ((False, TIMES_S >= 0), (True, TIMES_S < 0)):  # it turned: where it was what it is not
        (hats,) = course.kinks(still, [replace(ONES[0], turns_s=0.0, grows=grew)])
        assert any((profile == 0.5 * 0.02 * other).all() for profile in hats.profiles)
    bent = 0.5 * np.ones(len(steps))
    plain_ones, kinked = (course.columns(grows, ONES[:1], (), [steps], by) for by in (None, bent))
    assert_allclose(kinked.kinks, steps.profiles.T * Hills()(0.2, -0.1, -1.7)[:, None])
    more = (bent @ steps.profiles)[:, None] * Hills().with_slopes(0.2, -0.1, -1.7)[1:3].T
    assert_allclose(kinked.slopes[:, :2] - plain_ones.slopes[:, :2], more)
    mixed = np.random.default_rng(1).permutation(120)
    ramp = TouchCourse(Hills(), TIMES_S[mixed], SPAN_S).at(np.stack([TIMES_S[mixed], TIMES_S[mixed] ** 0]), 0.0123)
    assert ramp == pytest.approx([0.0123, 1.0]) and course.at(TIMES_S[None], 1.0) == pytest.approx(TIMES_S[-1])


def test_a_fit_that_is_linear_has_the_posterior_and_the_evidence_of_linear_algebra() -> None:
    course, state = TouchCourse(Hills(), TIMES_S, SPAN_S), np.array([0.2, -0.1, -1.7, 0.005, 0.0, 0.0, 0.0])
    sd = np.array([1e-3, 2e-3, 1e-3, 5e-4, 1e-3, 1e-3, 1e-3])
    prior = TouchPrior(state, state, sd, shape=np.full(9, 0.1), shape_sd=np.linspace(0.05, 0.2, 9))
    rng = np.random.default_rng(2)
    mixed = rng.standard_normal((120, 3))
    covariance = 1e-8 * (np.eye(120) + mixed @ mixed.T)
    at = course.columns(state[None], [prior], course.directions(state[None]))
    truth = np.concatenate([[0, 0, 0, 4e-4, 0, 0, 0], [0, 0.1, 0, 0, 0, 0, 0, 0, -0.1]])
    design = np.hstack([at.slopes, at.shapes])
    y = np.log1p(at.mean + design @ truth) + 1e-4 * rng.standard_normal(120)
    found = TouchFitter(FittedScan(y, covariance, course, np.eye(120) / 120, 120), [prior], 0.0).fit(10)
    there = course.columns(found.states, [prior], found.own.directions)  # all of it linearised where it ends
    moved = np.concatenate([found.states[0] - state, found.shapes[0] - prior.shape])
    design = np.hstack([there.slopes, there.shapes])
    at_best = there.mean + there.shapes @ found.shapes[0]
    design /= 1 + at_best[:, None]
    off, variance = y - np.log1p(at_best) + design @ moved, np.concatenate([sd, prior.shape_sd]) ** 2
    inverse = np.linalg.inv(covariance)
    posterior = np.linalg.inv(design.T @ inverse @ design + np.diag(1 / variance))
    best = posterior @ design.T @ inverse @ off
    assert_allclose(moved / np.sqrt(np.diag(posterior)), best / np.sqrt(np.diag(posterior)), atol=0.1)
    assert np.abs(moved[[3, 8, 15]]).min() > 1e-5  # it did move
    assert_allclose(found.covariance, posterior[:7, :7], rtol=0.1, atol=0.02 * np.diag(posterior)[:7].min())
    assert_allclose(found.shape_variance[0], np.diag(posterior)[7:], rtol=0.05)
    whole = covariance + design * variance @ design.T
    evidence = -0.5 * (np.linalg.slogdet(whole)[1] + off @ np.linalg.solve(whole, off))
    assert found.evidence == pytest.approx(evidence, abs=0.1)
    left = off - design @ best
    assert found.chi2 == pytest.approx(left @ inverse @ left / 120, rel=0.01)
    assert_allclose(found.left, left, atol=3e-6)
    assert_allclose(found.weighted_residual, inverse @ left, atol=0.02 * np.abs(inverse @ left).max())
    other = Hills()(-0.3, 0.4, -1.5)
    without = inverse - inverse @ design @ posterior @ design.T @ inverse
    assert found.informations(other[:, None])[0] == pytest.approx(other @ without @ other, rel=0.02)
    assert found.informations(design[:, 3:4])[0] >= 0.02 * design[:, 3] @ inverse @ design[:, 3] * 0.99


def test_a_touchs_misfit_and_values_that_do_not_count_make_it_less_sure() -> None:
    course, prior = TouchCourse(Hills(), TIMES_S, SPAN_S), plain(anywhere(0.2, -0.1, 0.02, SPAN_S))
    y = np.log1p(0.02 * Hills()(0.2, -0.1, np.log(0.18)))
    scan = FittedScan(y, 1e-8 * np.eye(120), course, np.eye(120) / 120, 120)
    sure, unsure = TouchFitter(scan, [prior], 0.0).fit(10), TouchFitter(scan, [prior], 0.5).fit(10)
    added = np.linalg.inv(unsure.white.w.T @ unsure.white.w) - 1e-8 * np.eye(120)
    assert_allclose(np.diag(added), 0.5**2 * unsure.size2 / 120, rtol=1e-3)
    assert (np.diag(unsure.covariance)[PLACE] > 2 * np.diag(sure.covariance)[PLACE]).all()
    white = TouchFitter(scan, [replace(prior, until_s=0.01)], 0.0).fit(10).white.w  # it may end a little later
    added = np.diag(np.linalg.inv(white.T @ white)) - 1e-8
    assert added[np.abs(TIMES_S - 0.01) < 0.006].max() > 1e-8 > 1e-12 > np.abs(added[TIMES_S > 0.016]).max()
    dead = np.where(np.arange(120) < 60, y, 0.0)
    fewer = TouchFitter(replace(scan, y=dead, live=60), [prior], 0.0).fit(10)
    assert not fewer.left[60:].any() and not fewer.design[60:].any() and fewer.chi2 < 0.1
    assert fewer.states[0, PLACE] == pytest.approx([0.2, -0.1], abs=0.01)
    assert fewer.chi2 == pytest.approx(2 * TouchFitter(replace(scan, y=dead), [prior], 0.0).fit(10).chi2)


def test_what_is_said_of_a_touch_that_changed_at_once_is_how_strongly_it_acts_then() -> None:
    course, strength = TouchCourse(Hills(), TIMES_S, SPAN_S), np.where(TIMES_S < 0, 0.02, 0.03)
    y, prior = np.log1p(strength * Hills()(0.2, -0.1, np.log(0.18))), plain(anywhere(0.2, -0.1, 0.02, SPAN_S))
    for sample_s, acts in ((-0.015, 0.02), (0.015, 0.03)):
        scan = FittedScan(y, 1e-10 * np.eye(120), course, np.eye(120) / 120, 120, sample_s=sample_s)
        state = TouchFitter(scan, [replace(prior, turns_s=0.0)], 0.0).fit(20).states[0]
        assert state[ACTION] + state[RATE] * sample_s == pytest.approx(acts, rel=0.05)
        assert state[PLACE] == pytest.approx([0.2, -0.1], abs=0.02)


ELECTRODES = {"width": 5, "count": 12}
DISC12 = {"name": "disc12", "unit": "mm", "contact_impedance": 0.01, "radius": 30, "electrodes": ELECTRODES}
SHORT_S, ACTS, PLACES = 0.03, np.pi * 0.2**2, ((0.1, 0.05), (0.45, -0.2), (0.62, 0.3))
MOST = {  # % of the change at the places above: a touch of radius 0.2 and drop 0.4
    ("pairs", False): (0.5, 1.0, 2.0),
    ("adjacent", False): (1.2, 1.5, 2.5),
    ("opposite", True): (0.3, 0.5, 1.0),  # half of the impedances are negative
}


@cache
def model(pattern: str) -> ForwardModel:
    return ForwardModel(geometry.from_dict(DISC12).with_pattern(pattern), mesh="stub")


def disc_change(pattern: str, touch: Shape) -> np.ndarray:
    of = model(pattern)
    return np.abs(of.solve(of.touched([touch], 1.0)).impedances() / of.solve(1.0).impedances()) - 1


def disc_tables(folder: Path, pattern: str, fine: bool) -> SkinTables:
    """Of a round skin of 12 electrodes, relative to the untouched skin on the other mesh."""
    skin = geometry.from_dict(DISC12).with_pattern(pattern)
    own = ForwardModel(skin)
    matrices, response = linearise(own, "model"), response_tables(own, coarse=24) if fine else None
    bundle.write(folder / "own", manifest.describe("own", skin, matrices), matrices, response=response)
    made = tables_of(bundle.Bundle.load(folder / "own"))
    return made.relative_to(np.abs(model(pattern).solve(1.0).impedances()))


@pytest.mark.parametrize(("pattern", "fine"), MOST)
def test_a_press_is_explained_by_its_disc_and_found_where_it_is(tmp_path: Path, pattern: str, fine: bool) -> None:
    known, rng = disc_tables(tmp_path, pattern, fine), np.random.default_rng(3)
    response, k = known.response, known.measurements
    covariance, times_s = NoiseModel(known).covariance(0), ((np.arange(k) + 0.5) / k - 0.5) * SHORT_S
    grid, white = known.grid, Whitening.of(covariance)
    assert np.hypot(*grid.discs[:, :2].T).max() < 1.05 and (np.abs(grid.responses).max(axis=1) > 0).all()
    for (x, y), most in zip(PLACES, MOST[pattern, fine], strict=True):
        touch = Shape("circle", x, y, 0.2, 0.4)
        acts, there = ACTS * touch.drop / (1 - touch.drop / 2), disc_change(pattern, touch)
        said = acts * response(x, y, np.log(0.2))
        scale = said @ there / (said @ said)
        left = np.linalg.norm(there - scale * said) / np.linalg.norm(there)
        assert scale == pytest.approx(1, abs=0.06), (x, y)
        assert 100 * left < most and left < 2 * known.wrong, (x, y, left)
        touch = replace(touch, drop=0.2)
        values = np.log1p(disc_change(pattern, touch)) + NOISE * rng.standard_normal(k)
        z2, disc, action = grid.likeliest(white.solve(values), grid.information(white))
        start = anywhere(float(grid.discs[disc, 0]), float(grid.discs[disc, 1]), action, SHORT_S)
        course = TouchCourse(response, times_s, SHORT_S)
        fit = TouchFitter(FittedScan(values, covariance, course, known.misfit, k), [start], known.wrong).fit(10)
        off, sd = fit.states[0, PLACE] - [x, y], np.sqrt(np.diag(fit.covariance))[PLACE]
        assert z2 > 44 and fit.chi2 < 1.45
        assert np.linalg.norm(off) < 0.03 and (np.abs(off) < 4 * sd + 0.005).all(), (x, y, off, sd)
        assert fit.states[0, ACTION] == pytest.approx((ACTS * touch.drop / (1 - touch.drop / 2)), rel=0.08)
