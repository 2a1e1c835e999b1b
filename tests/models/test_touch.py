"""A touch found again by what it does to impedances without a mesh; that itself: test_bundle.py."""

import numpy as np
import pytest

from models.forward import shared
from models.response_error import frame_errors
from models.response_tables import response_tables
from models.shapes import Shape
from models.touch_fit import TouchFit
from models.touch_response import TouchResponse

SIGMA = np.full(120, 10 ** (-70 / 20))


def test_a_fit_finds_a_touch_its_kind_and_says_what_no_touch_explains() -> None:
    model = shared("square16", "inverse")
    tables = response_tables(model, coarse=16, fine=32)
    response = TouchResponse(tables, model.pattern, model.solve().impedances(), 10)
    slope = model.solve().jacobian() / model.solve().impedances()[:, None]
    touch, other = Shape("triangle", 0.4, 0.3, 0.4, 0.3, 0.5), Shape("circle", -0.5, -0.4, 0.2, 0.4)
    d = response.of(touch) + SIGMA * np.random.default_rng(0).standard_normal(120)
    errors = frame_errors(np.asarray((slope / model.areas) @ slope.T), SIGMA, d, 0.3)
    near = Shape("circle", touch.x + 0.04, touch.y - 0.03, 0.25, 0.24)
    found = TouchFit(response)(d, errors, near)
    assert found.fits_frame and found.classes.argmax() == touch.shape_class
    assert found.position == pytest.approx(touch.centroid, abs=0.02)
    assert found.integral[0] == pytest.approx(touch.integral, rel=0.08)
    assert not TouchFit(response)(d + response.of(other), errors, near, ("circle",)).fits_frame
