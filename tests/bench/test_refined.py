"""What `skin bench refined` is scored on: shapes that nobody knows, and which row counts as worse."""

from __future__ import annotations

import numpy as np
import pytest

from bench.accuracy.intervals import class_error, pixels, summary
from bench.accuracy.odd_shapes import FLAT, HOLE, ODD, OddShape, random_odd
from bench.accuracy.refined import better, gains
from models.forward import shared
from models.shapes import Shape


@pytest.mark.parametrize("kind, share", [("ellipse", FLAT), ("ring", 1 - HOLE**2), ("crescent", None)])
def test_an_odd_shape_has_its_area_as_image_and_on_the_mesh(kind: str, share: float | None) -> None:
    shape = OddShape(kind, 0.2, -0.1, 0.4, 0.3, 0.7)
    area = 4 * float(shape.fraction(96).mean())
    assert 0.2 < area / (np.pi * 0.4**2) < 0.9
    assert share is None or area == pytest.approx(np.pi * 0.4**2 * share, rel=0.01)
    model = shared("square16", "inverse")
    dropped = float(((1 - shape.conductivity(model)) * model.areas).sum())
    assert dropped == pytest.approx(0.3 * area, rel=0.02)


def test_an_ellipse_turns_with_its_rotation() -> None:
    shape = OddShape("ellipse", 0.0, 0.0, 0.4, 0.3, np.pi / 2)  # its long axis along y
    assert shape.contains(np.array([[0.0, 0.39], [0.39, 0.0]])).tolist() == [True, False]


def test_odd_shapes_lie_on_the_skin() -> None:
    rng = np.random.default_rng(0)
    assert all(abs(s.x) + s.radius <= 1 and abs(s.y) + s.radius <= 1 for s in (random_odd(rng, k) for k in ODD * 5))


def test_a_row_is_worse_by_standard_errors_of_the_difference() -> None:
    higher = ("outline IoU", "class %", "mean IoU", "contact IoU")
    lower = ("position rms %", "force %", "integral %", "area %")
    network = dict.fromkeys((*higher, *lower), (1.0, 0.08))
    service = dict.fromkeys(higher, (1.1, 0.06)) | dict.fromkeys(lower, (0.9, 0.06))
    assert gains("circle", network, service) == pytest.approx([1.0] * 8)
    assert min(gains("circle", network, service | {"force %": (1.2, 0.06)})) == pytest.approx(-2.0)
    assert min(gains("hertz", network, service | {"mean IoU": (0.5, 0.06)})) > 0
    assert better((1.0, 0.0), (1.0, 0.0)) == 0.0


def test_the_class_is_as_sure_as_it_is_right() -> None:
    fair = [{"class stated %": 75.0, "class %": 100.0 * (k % 4 > 0)} for k in range(40)]
    assert class_error(fair) == pytest.approx(0.0)
    assert class_error([{**row, "class stated %": 95.0} for row in fair]) == pytest.approx(0.2)


def test_touches_without_a_row_do_not_count() -> None:
    rows = [{"force %": 1.0, "force in 68 %": 100.0}, None, {"force %": 3.0, "force in 68 %": 0.0}]
    assert summary(rows, [0, 1, 2])["force in 68 %"][0] == 50.0
    assert summary([None], [0]) == {}


def test_pixels_count_where_the_truth_is_within_what_the_image_states() -> None:
    touch = Shape("circle", 0.0, 0.0, 0.4, 0.3)
    truth, sigma = 0.3 * touch.fraction(96), np.full((96, 96), 0.01)
    assert pixels(truth + 0.005, sigma, touch) == {"pixels in 68 %": 100.0, "pixels in 90 %": 100.0}
    assert pixels(truth + 0.012, sigma, touch) == {"pixels in 68 %": 0.0, "pixels in 90 %": 100.0}
    noisy = truth + 0.01 * np.random.default_rng(0).standard_normal(truth.shape)
    assert pixels(noisy, sigma, touch)["pixels in 68 %"] == pytest.approx(68, abs=6)
