"""One touch fitted to one frame."""

from __future__ import annotations

import numpy as np
import pytest

from models.forward import shared
from models.response_error import FrameErrors, frame_errors
from models.response_tables import response_tables
from models.shapes import Array, Shape
from models.touch_fit import TouchFit, bent
from models.touch_response import TouchResponse

SIGMA = np.full(120, 10 ** (-70 / 20))


@pytest.fixture(scope="module")
def response() -> TouchResponse:
    model = shared("square16", "inverse")
    return TouchResponse(response_tables(model, coarse=16, fine=32), model.pattern, model.solve().impedances(), 10)


@pytest.fixture(scope="module")
def gram() -> Array:
    model = shared("square16", "inverse")
    slope = model.solve().jacobian() / model.solve().impedances()[:, None]
    return np.asarray((slope / model.areas) @ slope.T)


def frame(response: TouchResponse, touch: Shape, seed: int = 0) -> Array:
    return response.of(touch) + SIGMA * np.random.default_rng(seed).standard_normal(len(SIGMA))


def near(touch: Shape) -> Shape:
    """A start as a network gives it: place and size roughly right."""
    size = 1.15 * float(np.sqrt(touch.area / np.pi))
    return Shape("circle", float(touch.centroid[0]) + 0.04, float(touch.centroid[1]) - 0.03, size, 0.8 * touch.drop)


@pytest.mark.parametrize(
    "touch",
    [
        Shape("circle", 0.1, -0.2, 0.3, 0.3),
        Shape("triangle", 0.4, 0.3, 0.4, 0.3, 0.5),
        Shape("rectangle", -0.3, -0.3, 0.4, 0.3, 1.0, 2.2),
    ],
    ids=lambda touch: touch.kind,
)
def test_it_finds_the_touch_and_its_kind(response: TouchResponse, gram: Array, touch: Shape) -> None:
    d = frame(response, touch)
    found = TouchFit(response)(d, frame_errors(gram, SIGMA, d, 0.3), near(touch))
    assert found.fits_frame and found.classes.argmax() == touch.shape_class
    assert found.position == pytest.approx(touch.centroid, abs=0.02)
    assert abs(found.drop[0] - touch.drop) < 3 * found.drop[1] < 0.6 * touch.drop
    assert found.integral[0] == pytest.approx(touch.integral, rel=0.06)
    assert sum(found.probability.values()) == pytest.approx(1.0)
    image = found.image(48)
    truth = touch.fraction(48) > 0.5
    seen = image > 0.5 * image.max()
    assert (seen & truth).sum() / (seen | truth).sum() > 0.8


def test_a_touch_too_small_to_tell_is_no_square(response: TouchResponse, gram: Array) -> None:
    """Its rotation is as unknown as its kind: the kinds' evidence counts no rotation twice."""
    touch, shares = Shape("circle", 0.1, 0.2, 0.1, 0.25), []
    for seed in range(4):
        d = frame(response, touch, seed)
        found = TouchFit(response)(d, frame_errors(gram, SIGMA, d, 0.25), near(touch))
        shares.append(found.classes)
        assert found.between_kinds[1] > 0.1
    assert np.mean(shares, axis=0) == pytest.approx([2 / 6, 1 / 6, 1 / 6, 1 / 6, 1 / 6], abs=0.15)


def test_a_start_that_looks_unlikely_may_be_the_right_one(response: TouchResponse, gram: Array) -> None:
    """What a rotation explains says little before size and drop fit it."""
    touch = Shape("triangle", -0.128, -0.589, 0.356, 0.466, 0.8)
    d, sigma = response.of(touch), np.full(120, 1e-6)
    seen = Shape("circle", -0.142, -0.584, 0.249, 0.43)
    found = TouchFit(response)(d, frame_errors(gram, sigma, d, seen.drop), seen)
    assert found.fits[0].kind == "triangle" and found.fits_frame


def test_a_known_radius_stays_and_makes_the_drop_sure(response: TouchResponse, gram: Array) -> None:
    touch = Shape("circle", -0.2, 0.3, 0.2, 0.3)
    d = frame(response, touch)
    covariance = frame_errors(gram, SIGMA, d, 0.3)
    free, known = (TouchFit(response)(d, covariance, near(touch), ("circle",), radius=radius) for radius in (None, 0.2))
    assert known.fits[0].shape.radius == pytest.approx(0.2, rel=1e-3)
    assert known.drop[1] < 0.5 * free.drop[1]
    assert known.drop[0] == pytest.approx(0.3, abs=3 * known.drop[1] + 0.01)


def test_the_stated_uncertainty_is_that_of_the_errors(response: TouchResponse, gram: Array) -> None:
    """Of 30 noises the errors are as large as stated: their mean square over the variance is chi-square."""
    touch, ratios = Shape("circle", 0.15, 0.25, 0.25, 0.3), []
    for seed in range(30):
        d = frame(response, touch, seed)
        found = TouchFit(response)(d, FrameErrors(np.diag(SIGMA**2), np.zeros((120, 120))), near(touch), ("circle",))
        ratios.append((found.drop[0] - touch.drop) ** 2 / found.drop[1] ** 2)
    assert 0.5 < np.mean(ratios) < 1.8  # six standard errors about 1 would be -0.5 to 2.5


def test_without_noise_a_place_is_surer_in_the_middle_than_by_the_edge(response: TouchResponse, gram: Array) -> None:
    """As far as the response's error is what is left: that is larger by the edge."""

    def spread(x: float) -> float:
        touch, sigma = Shape("circle", x, 0.1, 0.35, 0.5), np.full(120, 1e-6)
        d = response.of(touch)
        found = TouchFit(response)(d, frame_errors(gram, sigma, d, 0.5), near(touch), ("circle",))
        return float(np.sqrt(np.trace(found.position_covariance)))

    assert spread(0.1) < 0.02 * spread(0.64)


def test_of_a_large_touch_the_responses_error_leaves_drop_and_size_less_sure(
    response: TouchResponse, gram: Array
) -> None:
    """All of a large touch's edge is put off by the same amount: that does not average out."""

    def spread(radius: float, known: bool = False) -> float:
        touch, sigma = Shape("circle", 0.1, 0.1, radius, 0.3), np.full(120, 1e-6)
        d = response.of(touch)
        errors = frame_errors(gram, sigma, d, 0.3)
        found = TouchFit(response)(d, errors, near(touch), ("circle",), radius if known else None)
        return found.drop[1] / found.drop[0]

    assert spread(0.45) > 0.004 > spread(0.45, known=True)


def test_what_no_touch_explains_is_said(response: TouchResponse, gram: Array) -> None:
    d = frame(response, Shape("circle", 0.4, 0.4, 0.2, 0.4)) + frame(response, Shape("circle", -0.5, -0.4, 0.2, 0.4))
    found = TouchFit(response)(d, frame_errors(gram, SIGMA, d, 0.3), Shape("circle", 0.4, 0.4, 0.25, 0.4), ("circle",))
    assert not found.fits_frame


def test_a_covariance_that_is_none(response: TouchResponse) -> None:
    with pytest.raises(ValueError, match="a covariance that is none"):
        TouchFit(response)(
            np.zeros(120), FrameErrors(-np.eye(120), np.zeros((120, 120))), Shape("circle", 0, 0, 0.2, 0.3)
        )


def test_a_fit_knows_the_response_to_second_order_in_place(response: TouchResponse, gram: Array) -> None:
    touch = Shape("circle", 0.2, -0.1, 0.25, 0.3)
    d = frame(response, touch)
    found = TouchFit(response)(d, frame_errors(gram, SIGMA, d, touch.drop), near(touch), ("circle",))
    fit = bent(response, found).fits[0]
    moved = Shape("circle", fit.shape.x + 0.04, fit.shape.y - 0.03, fit.shape.radius, fit.shape.drop)
    change, step = response.of(moved) - response.of(fit.shape), np.array([0.04, -0.03, 0.0, 0.0])
    first, second = (
        np.linalg.norm(change - said) / np.linalg.norm(change) for said in (fit.slope @ step, fit.change(step))
    )
    assert second < 0.7 * first and second < 0.06, "what is left is of the ten cells across a touch"
