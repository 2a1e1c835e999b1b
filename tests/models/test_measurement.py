"""Tables, discs, grid and measured maps, held against forward models that share nothing with them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from firmware_stub.world import pressed
from models.bundle import Bundle
from models.locator_arrays import LocatorArrays
from models.measurement.covariance.whitening import Whitening
from models.measurement.numbers import EDGE_WIDTH, MISFIT, TYPICAL_RADIUS
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.measured_map import MeasuredMap
from models.measurement.responses.tables import FIELD_MODES, tables_of
from models.measurement.touch import EDGE, X, Y
from tests.models.solved import action_of, change, log_change, sheet, tables, untouched


def off(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


DISCS = (0, 0, 10, 1), (10, 20, 20, 8), (30, 30, 6, 2), (-18, 5, 4, 0.3), (0, 0, 25, 8)  # mm, N


@pytest.mark.parametrize(("x", "y", "radius", "force"), DISCS)
def test_a_disc_does_what_finite_elements_say(x: float, y: float, radius: float, force: float) -> None:
    touch = pressed("circle", x * 1e-3, y * 1e-3, radius * 1e-3, force)
    there = change(touch)
    said = action_of(touch) * DiscResponse(tables())(x / 50, y / 50, np.log(radius / 50))
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
    axis = (np.arange(len(table)) + 0.5) * tables().pixel - 1
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
    assert tables().layer == pytest.approx(driven * 0.01 / 0.2 / untouched()[:, None], rel=0.02)  # ohm unit over width
    assert (tables().layer <= tables().contact * 1.05).all()


def test_tables_are_relative_to_what_was_measured_up_to_a_common_gain() -> None:
    made, shipped = tables_of(Bundle.load("square16")), Bundle.load("square16")
    assert made.z0 == pytest.approx(shipped.z0) and made.wrong == MISFIT and np.trace(made.misfit) == pytest.approx(1)
    assert made.inside.shape == made.jacobian.shape[:2] and made.pixel * len(made.jacobian) == 2
    other, row = made.z0 * 3.0, np.ones(120)
    other[7], row[7] = other[7] * 1.25, 1 / 1.25
    seen, unlike = made.relative_to(other), made.misfit * np.outer(row, row)
    for name in ("jacobian", "along", "turned"):
        assert_allclose(getattr(seen, name), getattr(made, name) * row, rtol=1e-5)
    for name in ("contact", "layer"):
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
    assert DiscResponse(seen)(*place) == pytest.approx(mixes @ DiscResponse(tables())(*place), abs=1e-6)
    for name in ("along", "turned"):
        assert_allclose(getattr(seen, name), getattr(tables(), name) @ mixes.T, atol=1e-6)
    for name in ("contact", "layer", "field"):
        assert_allclose(getattr(seen, name), mixes @ getattr(tables(), name), atol=1e-12)
    mixed = mixes @ tables().misfit @ mixes.T
    assert_allclose(seen.misfit, mixed / np.trace(mixed), atol=1e-12)
    assert tables().grid.through(mixes).responses[40] == pytest.approx(mixes @ tables().grid.responses[40], abs=1e-6)


def test_slopes_are_differences_of_responses() -> None:
    """A disc's rim runs through pixels, so that both scatter by a tenth of themselves."""
    response, step, found = DiscResponse(tables()), 0.03, np.empty((16, 3))
    for n, (x, y, radius) in enumerate(np.random.default_rng(0).uniform((-0.7, -0.7, 0.12), (0.7, 0.7, 0.4), (16, 3))):
        place = np.array([x, y, np.log(radius)])
        at, *slopes = response.with_slopes(*place)
        assert at == pytest.approx(response(*place))
        for axis, (slope, way) in enumerate(zip(slopes, step * np.eye(3), strict=True)):
            error = slope - (response(*(place + way)) - response(*(place - way))) / (2 * step)
            found[n, axis] = np.linalg.norm(error) / np.linalg.norm(slope if axis < 2 else 2 * at)
    assert (np.median(found, axis=0) < 0.2).all()


def test_a_touchs_own_directions_are_those_of_its_outline_edge_and_tensor() -> None:
    response, (x, y, radius), bent = DiscResponse(tables()), (0.25, -0.3, 0.35), 0.15
    side, pixel = len(tables().jacobian), tables().pixel
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
    response = DiscResponse(tables())(*grid.discs[disc])
    information = grid.information(white)
    assert information[disc] == pytest.approx(response @ np.linalg.solve(covariance, response), rel=1e-3)
    z2, found, action = grid.likeliest(np.linalg.solve(covariance, 0.02 * response), information)
    assert found == disc and action == pytest.approx(0.02, rel=1e-3)
    assert z2 == pytest.approx(0.02**2 * information[disc], rel=1e-3)
    assert grid.likeliest(np.linalg.solve(covariance, -0.02 * response), information)[0] < 0.5 * z2
    own = grid.discs[np.isclose(np.exp(grid.discs[:, 2]), 0.18), :2]
    assert np.abs(own).max() == pytest.approx(0.98 - 0.9 * 0.18)  # all over the sheet, nine tenths of it on that
    right = replace(tables(), inside=tables().inside & (np.arange(len(tables().jacobian)) >= 24))
    assert DiscResponse(right).discs[:, X].min() >= 0 > DiscResponse(right).discs[:, Y].min()


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


def test_touches_on_a_measured_map_are_placed_by_the_locator_and_its_error_adds_to_the_misfit() -> None:
    made, _ = measured_map()
    states = np.array([[0.16, 0.08, 0.0, 2.0, 0.0, 0.0, 0.0], [-0.08, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0]])
    difference = 2.0 * made(0.16, 0.08, 0.0) + 3.0 * made(-0.08, 0.0, 0.0)
    first, second = made.located(difference, np.full(10, 1e-5), states)
    assert (first.x, first.y) == pytest.approx((0.008, 0.004), abs=1e-3)
    assert (second.x, second.y) == pytest.approx((-0.004, 0.0), abs=1e-3)
    assert made.located(difference, np.full(10, np.inf), states) == []
    few = replace(tables(), misfit=np.eye(10) / 10, map=made)
    assert few.misfit_of(0.1) == pytest.approx(few.wrong**2 * 0.1 * np.eye(10) / 10 + made.error)
    assert replace(few, predicted=False).tells
