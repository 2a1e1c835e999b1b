"""The law of the foam against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import integrate

from models.pressure import FOAM, MOST_DROP, Foam, disc
from models.shapes import Shape

DROPS = np.array([0.0, 0.01, 0.2, 0.499, 0.5, 0.501, 0.7, 0.9, 0.98])


def test_a_newton_on_the_published_disc_is_a_tenth() -> None:
    for newton in (0.1, 1.0, 3.0, 5.0):
        assert FOAM.flat_drop(newton, disc(0.01)) == pytest.approx(0.1 * newton)
    assert FOAM.flat_drop(1.0, disc(0.005)) == pytest.approx(0.4)
    assert FOAM.flat_drop(1.0, disc(0.02)) == pytest.approx(0.025)


def test_there_and_back_is_where_one_was() -> None:
    for foam in (FOAM, Foam(1e-5, 0.3)):
        assert foam.drop(foam.pressure(DROPS)) == pytest.approx(DROPS, abs=1e-12)


def test_it_saturates_smoothly_and_never_takes_all() -> None:
    p = np.linspace(0, 6 / FOAM.slope, 60001)
    g = FOAM.drop(p)
    slope = np.diff(g) / np.diff(p) / FOAM.slope
    assert (slope > 0).all() and slope.max() == pytest.approx(1.0)
    assert np.abs(np.diff(slope)).max() < 1e-3  # no corner
    assert g[-1] < 1 and FOAM.drop(-1.0) == 0
    assert float(FOAM.drop((0.5 + 0.5 * math.log(2)) / FOAM.slope)) == pytest.approx(0.75)
    assert FOAM.pressure(1.0) == FOAM.pressure(MOST_DROP)


def test_the_gain_is_the_slope_of_the_logarithms() -> None:
    drops = DROPS[(DROPS > 0) & (DROPS != 0.5)]
    h = 1e-5
    found = np.log(FOAM.pressure(drops * (1 + h)) / FOAM.pressure(drops * (1 - h))) / (2 * h)
    assert FOAM.gain(drops) == pytest.approx(found, rel=1e-3)


@pytest.mark.parametrize("drop", [0.3, 0.55, 0.8, 0.95])
def test_a_balls_force_and_mean_drop_are_those_of_its_profile(drop: float) -> None:
    middle, radius = float(FOAM.pressure(drop)), 0.007

    def profile(r: float) -> float:
        return middle * math.sqrt(max(1 - (r / radius) ** 2, 0.0))

    force = integrate.quad(lambda r: 2 * math.pi * r * profile(r), 0, radius)[0]
    assert FOAM.force("hertz", drop, disc(radius)) == pytest.approx(force)
    assert FOAM.ball_drop(force, disc(radius)) == pytest.approx(drop)
    drops = integrate.quad(lambda r: 2 * math.pi * r * float(FOAM.drop(profile(r))), 0, radius, limit=200)[0]
    assert drop * FOAM.ball_mean(drop) * disc(radius) == pytest.approx(drops, rel=1e-6)


@pytest.mark.parametrize("kind", ["circle", "triangle", "rectangle", "square", "L", "hertz"])
@pytest.mark.parametrize("newton", [0.5, 2.0, 5.0, 9.0])
def test_the_force_of_any_touch_is_pressure_summed_over_its_map(kind: str, newton: float) -> None:
    unit, n = 0.05, 1600
    shape = Shape(kind, 0.1, -0.05, 0.25, 0.1, 0.4, 1.6 if kind == "rectangle" else 1.0)
    area = shape.area * unit**2
    drop = FOAM.peak_drop(kind, newton, area)
    pressed = Shape(kind, 0.1, -0.05, 0.25, drop, 0.4, shape.aspect)
    axis = (np.arange(n) + 0.5) * 2 / n - 1
    points = np.stack(np.meshgrid(axis, axis), axis=-1)
    image = drop * pressed.profile(points)
    assert FOAM.of_map(image, (2 * unit / n) ** 2) == pytest.approx(newton, rel=3e-3)
    assert image.sum() * (2 / n) ** 2 == pytest.approx(pressed.integral, rel=3e-3)
    assert FOAM.force(kind, drop, area) == pytest.approx(newton)


def test_a_foam_that_is_none_is_refused() -> None:
    for slope, knee in ((0.0, 0.5), (float("nan"), 0.5), (1e-5, 0.0), (1e-5, 1.0)):
        with pytest.raises(ValueError, match="slope above 0"):
            Foam(slope, knee)
