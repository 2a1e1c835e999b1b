"""Tables, discs, grid, measured maps against other forward models; whitening and the noise's model, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from firmware_stub.world import pressed
from models.bundle import Bundle
from models.locator_arrays import LocatorArrays
from models.measurement.noise import Lines, NoiseModel, in_blocks
from models.measurement.numbers import EDGE_WIDTH, ELSEWHERE, MISFIT, TYPICAL_RADIUS
from models.measurement.response import MeasuredMap
from models.measurement.tables import FIELD_MODES, tables_of
from models.measurement.touch import EDGE, X, Y
from models.measurement.whitening import Whitening, leave_out
from tests.models.solved import action_of, change, log_change, sheet, tables, untouched


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


DISCS = (0, 0, 10, 1), (10, 20, 20, 8), (30, 30, 6, 2), (-18, 5, 4, 0.3), (0, 0, 25, 8)  # mm, N


@pytest.mark.parametrize(("x", "y", "radius", "force"), DISCS)
def test_a_disc_does_what_finite_elements_say(x: float, y: float, radius: float, force: float) -> None:
    touch = pressed("circle", x * 1e-3, y * 1e-3, radius * 1e-3, force)
    there = change(touch)
    said = action_of(touch) * tables().response(x / 50, y / 50, np.log(radius / 50))
    scale = said @ there / (said @ said)
    assert scale == pytest.approx(1, abs=0.03) and off(scale * said, there) < 0.004


DROPS = {"jacobian": (1.0, 0.0, 1.0), "along": (1.0, 0.0, -1.0), "turned": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize(("name", "drop"), DROPS.items())
def test_drops_of_any_direction_do_what_finite_elements_say(name: str, drop: tuple[float, float, float]) -> None:
    """A soft spot off both axes, whose conductivity falls by the tensor (xx, xy, yy)."""

    def spot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 2e-3 * np.exp(-((x - 0.4) ** 2 + (y + 0.15) ** 2) / 0.1)

    tensor = np.array([1.0, 0.0, 1.0]) - spot(*sheet().model.centroids.T)[:, None] * drop
    table = getattr(tables(), name)
    axis = (np.arange(len(table)) + 0.5) * 2 / len(table) - 1
    assert off(np.einsum("yxk,yx->k", table, spot(axis[None, :], axis[:, None])), log_change(tensor)) < 0.02


def test_fields_and_contacts_do_what_finite_elements_say() -> None:
    model, solution = sheet().model, sheet().model.solve(1.0)
    x, y = model.centroids.T
    legendre = [lambda a: 1 + 0 * a, lambda a: a, lambda a: (3 * a**2 - 1) / 2, lambda a: (5 * a**3 - 3 * a) / 2]
    slopes = solution.jacobian() / solution.impedances()[:, None]
    for n, (i, j) in enumerate(FIELD_MODES):
        assert off(tables().field[:, n], slopes @ (legendre[i](x) * legendre[j](y))) < 0.15, (i, j)
    assert log_change(1.01) / np.log(1.01) == pytest.approx(tables().field[:, 0], abs=0.002)  # exact by scaling
    for electrode in (3, 14):
        contact = model.contact_impedance.copy()
        contact[electrode] *= 1.01
        assert off(tables().contact[:, electrode], log_change(1.0, contact) / 0.01) < 0.03
    driven = (tables().pattern[:, :2, None] == np.arange(16)).any(axis=1)
    assert tables().series == pytest.approx(driven * 0.01 / 0.2 / untouched()[:, None], rel=0.02)  # ohm unit over width
    assert (tables().series <= tables().contact * 1.05).all()


def test_tables_are_relative_to_what_was_measured_up_to_a_common_gain() -> None:
    made, shipped = tables_of(Bundle.load("square16")), Bundle.load("square16")
    assert made.z0 == pytest.approx(shipped.z0) and made.wrong == MISFIT and np.trace(made.misfit) == pytest.approx(1)
    assert made.inside.shape == made.jacobian.shape[:2]
    other, row = made.z0 * 3.0, np.ones(120)
    other[7], row[7] = other[7] * 1.25, 1 / 1.25
    seen, unlike = made.relative_to(other), made.misfit * np.outer(row, row)
    for name in ("jacobian", "along", "turned"):
        assert_allclose(getattr(seen, name), getattr(made, name) * row, rtol=1e-5)
    for name in ("contact", "series"):
        assert_allclose(getattr(seen, name), getattr(made, name) * row[:, None])
    assert_allclose(seen.field[:, 1:], made.field[:, 1:] * row[:, None], rtol=1e-3, atol=1e-6)
    assert_allclose(seen.field[:, 0], seen.contact.sum(axis=1) - 1)
    assert_allclose(seen.misfit, unlike / np.trace(unlike))
    assert seen.wrong == pytest.approx(np.hypot(MISFIT, np.log(1.25) / np.sqrt(120))) and (seen.z0 == other).all()
    assert_allclose(seen.misfit_of(0.04), seen.wrong**2 * 0.04 * seen.misfit)
    measured = replace(made, predicted=False)
    assert measured.relative_to(other) is measured and not measured.tells and made.tells


def test_tables_and_grid_through_a_fault_are_those_of_the_measurements_it_mixes() -> None:
    mixes, place = np.eye(120), (0.3, -0.4, np.log(0.2))
    mixes[3, 3], mixes[3, 50], mixes[90, 90] = 0.5, 0.2, 0.0
    seen = tables().through(mixes)
    assert seen.response(*place) == pytest.approx(mixes @ tables().response(*place), abs=1e-6)
    for name in ("along", "turned"):
        assert_allclose(getattr(seen, name), getattr(tables(), name) @ mixes.T, atol=1e-6)
    for name in ("contact", "series", "field"):
        assert_allclose(getattr(seen, name), mixes @ getattr(tables(), name), atol=1e-12)
    mixed = mixes @ tables().misfit @ mixes.T
    assert_allclose(seen.misfit, mixed / np.trace(mixed), atol=1e-12)
    assert tables().grid.through(mixes).responses[40] == pytest.approx(mixes @ tables().grid.responses[40], abs=1e-6)


def test_slopes_are_differences_of_responses() -> None:
    """Of discs from 4 mm on, moved or grown by an eighth of a pixel: a fit's steps lead where it says."""
    response, step, least = tables().response, 0.005, (-0.9, -0.9, np.log(0.08))
    for place in np.random.default_rng(0).uniform(least, (0.9, 0.9, np.log(0.4)), (16, 3)):
        at, *slopes = response.with_slopes(*place)
        rounding = 32 * float(np.finfo(np.float32).eps)  # of hundreds of terms: four sums at once add in another order
        assert at == pytest.approx(response(*place), rel=rounding)
        for slope, way, size in zip(slopes, step * np.eye(3), (slopes[0], slopes[1], at), strict=True):
            error = slope - (response(*(place + way)) - response(*(place - way))) / (2 * step)
            assert np.linalg.norm(error) < 0.05 * np.linalg.norm(size), place


def test_a_touchs_own_directions_are_those_of_its_outline_edge_and_tensor() -> None:
    response, (x, y, radius), bent = tables().response, (0.25, -0.3, 0.35), 0.15
    side = len(tables().jacobian)
    pixel = 2 / side
    axis = (np.arange(10 * side) + 0.5) * pixel / 10 - 1
    from_x, from_y = axis[None, :] - x, axis[:, None] - y
    angle, distance = np.arctan2(from_y, from_x), np.hypot(from_x, from_y)

    def does(share: np.ndarray, table: np.ndarray) -> np.ndarray:
        pixels = share.reshape(side, 10, side, 10).mean(axis=(1, 3))
        return np.einsum("yxk,yx->k", table, pixels) / (np.pi * radius**2)

    found, disc = response.directions(x, y, np.log(radius)), (distance < radius).astype(float)
    for m in (2, 3, 4):
        for sine, wave in ((0, np.cos(m * angle)), (1, np.sin(m * angle))):
            more, less = (does(distance < radius * (1 + h * wave), tables().jacobian) for h in (bent, -bent))
            assert off(found[2 * (m - 2) + sine], (more - less) / (2 * bent)) < 0.4, (m, sine)
    soft = gaussian_filter(disc, 2 * EDGE_WIDTH / pixel * 10)  # of twice the width
    assert off(found[EDGE], (does(soft, tables().jacobian) - does(disc, tables().jacobian)) / 4) < 0.3
    assert off(found[7], does(disc, tables().along)) < 0.02 and off(found[8], does(disc, tables().turned)) < 0.02


def test_the_grid_tells_a_disc_its_action_and_how_sure_it_is() -> None:
    grid, rng = tables().grid, np.random.default_rng(2)
    covariance = np.diag(rng.uniform(1e-9, 1e-7, 120)) + 1e-8
    white, disc = Whitening.of(covariance), len(grid.discs) // 3
    response = tables().response(*grid.discs[disc])
    information = grid.information(white)
    assert information[disc] == pytest.approx(response @ np.linalg.solve(covariance, response), rel=1e-3)
    z2, found, action = grid.likeliest(np.linalg.solve(covariance, 0.02 * response), information)
    assert found == disc and action == pytest.approx(0.02, rel=1e-3)
    assert z2 == pytest.approx(0.02**2 * information[disc], rel=1e-3)
    assert grid.likeliest(np.linalg.solve(covariance, -0.02 * response), information)[0] < 0.5 * z2
    own = grid.discs[np.isclose(np.exp(grid.discs[:, 2]), 0.18), :2]
    assert np.abs(own).max() == pytest.approx(0.98 - 0.9 * 0.18)  # all over the sheet, nine tenths of it on that
    right = replace(tables(), inside=tables().inside & (np.arange(len(tables().jacobian)) >= 24))
    assert right.response.discs[:, X].min() >= 0 > right.response.discs[:, Y].min()


def measured_map(mean_press: float = 2.0) -> tuple[MeasuredMap, np.ndarray]:
    """5 x 7 places, 4 mm apart, of 10 even slopes but for one corner; and (3, 10): at the origin, slopes [1/m]."""
    even = np.random.default_rng(3).standard_normal((3, 10)) * [[0.01], [0.5], [0.3]]
    iy, ix = np.divmod(np.arange(35), 7)
    allowed, noise = np.arange(35) > 0, np.where(np.arange(10) == 9, 2e-3, 1e-3)
    values = even[0] + (np.array([-0.012, -0.008]) + 0.004 * np.column_stack([ix, iy])) @ even[1:]
    empty = {f"{name}_{part}": np.zeros((0, 0)) for name in ("place", "press") for part in ("centres", "weights")}
    empty |= {f"{name}_{part}": np.ones(2) for name in ("place", "press") for part in ("offset", "sigma", "spread")}
    numbers = dict(spacing=0.004, misfit=1.0, loudness=1.0, quantity=0, place_length=1.0, press_length=1.0)
    of_map = dict(shape=[5, 7], corner=[-0.012, -0.008], allowed=allowed, map=values[allowed], noise=noise)
    of_map |= dict(error=1e-6 * np.eye(10) + 1e-6, measured=np.ones(10, bool), spread=[1.0, 1e-9, 0.0])
    of_map |= dict(more=np.full(2, 0.3), rotation=np.eye(10), middle=np.zeros(10), reach=np.ones(3))
    arrays = LocatorArrays(**{name: np.array(value) for name, value in (of_map | numbers | empty).items()})
    return MeasuredMap(arrays, 0.05, mean_press), even


def test_a_measured_map_is_read_between_its_places_and_told_in_model_units() -> None:
    made, even = measured_map()
    at, along_x, along_y, with_radius = made.with_slopes(0.1, -0.06, -1.7)
    assert at == pytest.approx((even[0] + [0.005, -0.003] @ even[1:]) / 2)  # of half the action of a mean press
    assert along_x == pytest.approx(even[1] * 0.05 / 2) and along_y == pytest.approx(even[2] * 0.05 / 2)
    assert not with_radius.any() and not made.directions(0.1, 0.0, -1.7).any()
    assert made(9.0, 0.0, 0.0) == pytest.approx(made(0.24, 0.0, 0.0), rel=0.01)  # beyond the presses, as at their edge
    assert made(-0.24, -0.16, 0.0) == pytest.approx(made(-0.24, -0.08, 0.0))  # no press: as the nearest that was
    assert len(made.discs) == 34 and made.discs[0] == pytest.approx([-0.16, -0.16, np.log(TYPICAL_RADIUS)])
    assert_allclose(made.error[:9, :9], 1e-6, rtol=0.5)  # without its noise, of which the last had more
    assert np.linalg.eigvalsh(made.error).min() > -1e-15
    mixes = np.eye(10)
    mixes[2, 2], mixes[2, 5] = 0.5, 0.25
    seen = made.through(mixes)
    assert seen(0.1, 0.0, 0.0) == pytest.approx(mixes @ made(0.1, 0.0, 0.0))
    assert seen.error == pytest.approx(mixes @ made.error @ mixes.T)


def test_the_error_of_a_measured_map_adds_to_the_misfit() -> None:
    made, _ = measured_map()
    few = replace(tables(), misfit=np.eye(10) / 10, map=made)
    assert few.misfit_of(0.1) == pytest.approx(few.wrong**2 * 0.1 * np.eye(10) / 10 + made.error)
    assert replace(few, predicted=False).tells


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
    assert_allclose(noise.covariance(4), expected + noise.lines.columns(4) @ noise.lines.columns(4).T, atol=1e-18)
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
    assert noise.lines.now.part == 0 and not noise.lines.columns(0).shape[1]


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
        one_by_one.update(np.linalg.solve(one_by_one.covariance(0), left), 0, False, n * SPAN_S, SPAN_S)
    for noise, most in ((at_once, 1.3), (one_by_one, 1.6)):
        assert noise.lines.columns(0).shape[1] == 2 and noise.lines.columns(3).shape[1] == 0
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
            if lines.update(white + strength * pickup, part, False, n * SPAN_S, SPAN_S):
                lines.now.make(NOISE**2)
        both.update(white, 7 if n % 10 else 0, False, n * SPAN_S, SPAN_S)
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
        assert noise.lines.columns(4).shape[1] == 0
        if not sweeps:
            assert np.linalg.svd(noise.lines.now.turn)[1].min() > 0.9
            alone, together = (noise.lines.columns(part) @ noise.lines.columns(part).T for part in (10, 3))
            assert_allclose(np.diag(together), np.diag(alone), rtol=1e-6)
