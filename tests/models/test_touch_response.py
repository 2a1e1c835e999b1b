"""What touches do to impedances without a mesh, against the finite elements."""

from __future__ import annotations

import numpy as np
import pytest

from models.forward import ForwardModel, shared
from models.response_tables import response_tables
from models.shapes import KINDS, Shape
from models.touch_response import ResponseTables, TouchResponse, _infinite_sheet, effective_drop

TOUCHES = [
    Shape("circle", 0.1, -0.2, 0.3, 0.3),
    Shape("hertz", -0.4, 0.3, 0.25, 0.6),
    Shape("triangle", 0.5, 0.4, 0.3, 0.2, 0.4),
    Shape("rectangle", -0.2, -0.4, 0.35, 0.4, 1.0, 2.0),
    Shape("square", 0.0, 0.45, 0.3, 0.5, 0.3),
    Shape("L", -0.3, 0.1, 0.4, 0.3, 2.0),
]


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return shared("square16", "inverse")


@pytest.fixture(scope="module")
def tables(model: ForwardModel) -> ResponseTables:
    return response_tables(model, coarse=16, fine=32)


@pytest.fixture(scope="module")
def response(model: ForwardModel, tables: ResponseTables) -> TouchResponse:
    return TouchResponse(tables, model.pattern, model.solve().impedances())


@pytest.mark.parametrize("touch", TOUCHES, ids=lambda touch: touch.kind)
def test_a_touch_does_what_the_finite_elements_say(model: ForwardModel, response: TouchResponse, touch: Shape) -> None:
    truth = model.solve(model.touched([touch])).impedances() / model.solve().impedances() - 1
    found = response.of(touch)
    linear = -(model.solve().jacobian() @ (1 - model.touched([touch])[:, 0])) / model.solve().impedances()
    assert np.linalg.norm(found - truth) < 0.02 * np.linalg.norm(truth)
    assert np.linalg.norm(found - truth) < 0.25 * np.linalg.norm(linear - truth)  # what it is for


def test_every_kind_was_tried() -> None:
    assert {touch.kind for touch in TOUCHES} == set(KINDS)


def test_a_square_dipole_is_half_its_own_field() -> None:
    """The depolarisation of a square in the plane is one half along each axis."""
    own = _infinite_sheet(3)[:, :, 4, 4]
    assert own == pytest.approx(0.5 * np.eye(2), abs=1e-12)


def test_far_squares_are_points() -> None:
    n, x, y = 9, 6.0, 3.0
    r2 = x**2 + y**2
    point = np.array([[1 - 2 * x**2 / r2, -2 * x * y / r2], [-2 * x * y / r2, 1 - 2 * y**2 / r2]]) / (2 * np.pi * r2)
    assert _infinite_sheet(n)[:, :, int(y) * n + int(x), 0] == pytest.approx(point, rel=2e-3, abs=1e-6)


def test_the_room_beside_a_touch_is_to_the_outline(response: TouchResponse) -> None:
    assert response.room(Shape("circle", 0.2, -0.1, 0.3, 0.3)) == pytest.approx(0.5, abs=0.07)
    assert response.room(Shape("circle", 0.7, 0.0, 0.3, 0.3)) == pytest.approx(0.0, abs=0.07)


def test_the_derivative_is_that_of_the_response(response: TouchResponse) -> None:
    touch = TOUCHES[0]
    grid = response.grid(touch.x, touch.y, touch.radius)
    drop = effective_drop(grid.coverage(touch), touch.drop, touch.kind)
    at = np.array([np.flatnonzero(drop > 0.1)[5], np.flatnonzero(drop < 1e-9)[3]])  # under the touch, and beside it
    d, slope = response(grid, drop, at)
    for k, cell in enumerate(at):
        more = drop.copy()
        more[cell] += 1e-5
        assert slope[:, k] == pytest.approx((response(grid, more)[0] - d) / 1e-5, rel=1e-2, abs=1e-5 * np.abs(d).max())


def test_the_rest_of_the_field_is_reciprocal(tables: ResponseTables) -> None:
    turned = tables.regular.transpose(1, 0, 3, 2)
    assert tables.regular == pytest.approx(turned, abs=1e-5 * float(np.abs(tables.regular).max()))


def test_a_touch_is_the_less_the_smaller_its_drop(response: TouchResponse) -> None:
    faint, strong = (response.of(Shape("circle", 0.2, 0.1, 0.2, drop)) for drop in (0.01, 0.5))
    assert np.linalg.norm(strong) > 50 * np.linalg.norm(faint)  # more than in proportion
