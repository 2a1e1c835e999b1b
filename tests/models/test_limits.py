"""Floors of a touch's errors: against linear algebra, facts known of this skin, and their own logic."""

import numpy as np
import pytest

from models import limits
from models.fisher import MeasurementNoise, SizePrior, floors, information, sensitivity
from models.patterns import pattern
from models.prereconstruction import Drift
from models.shapes import Shape

TOUCH = Shape("circle", 0.31, 0.27, 0.2, 0.3)


def test_drift_is_marginalised_not_projected():
    """Against the whole information matrix of touch and drift, inverted."""
    seen, noise, rows = sensitivity("square16", TOUCH), MeasurementNoise(70.0), pattern("pairs")
    z0, slope, nuisance = seen.relative(rows)
    j = np.hstack([slope, nuisance]) / (noise.sigma(z0) / np.abs(z0))[:, None]
    prior = np.diag(np.r_[np.zeros(4), 1 / 0.01**2, np.full(16, 1 / 0.05**2)])
    found = np.linalg.inv(information(seen, rows, noise, Drift(0.01, 0.05)))
    np.testing.assert_allclose(found, np.linalg.inv(j.T @ j + prior)[:4, :4], rtol=1e-6)


def test_floors_are_those_that_others_found_and_the_best_pattern_depends_on_the_noise():
    for x in (0, 0.3):
        floor = floors("square16", Shape("circle", x, x, 0.2, 0.3), 70.0)["cramer_rao"]
        assert 0.25 < floor.position_percent < 0.6 and 0.25 < floor.drop < 0.6 and 0.02 < floor.integral < 0.10
    known = floors("square16", Shape("circle", 0.3, 0.3, 0.2, 0.3), 70.0, SizePrior(radius=(0.2, 0.2)))["cramer_rao"]
    assert 0.003 < known.drop < 0.015
    for noise, best in ((MeasurementNoise(np.inf, 1e-4), "pairs"), (MeasurementNoise(70.0), "adjacent")):
        assert limits.rank_patterns(limits.Case(noise=noise), per_side=2)[0][0] == best


def test_knowledge_lowers_floors_noise_raises_them_and_a_prior_bounds_them():
    free, loud = floors("square16", TOUCH, 80.0), floors("square16", TOUCH, 60.0)
    drifting = floors("square16", TOUCH, 80.0, drift=Drift(np.inf, np.inf))
    known = floors("square16", TOUCH, 80.0, SizePrior(radius=(0.2, 0.2)))["bayes"]
    for name in ("position", "radius", "drop", "integral"):
        bayes, rao = getattr(free["bayes"], name), getattr(free["cramer_rao"], name)
        assert getattr(known, name) <= bayes <= min(rao, getattr(drifting["bayes"], name))
        assert rao <= getattr(drifting["cramer_rao"], name)
    assert loud["cramer_rao"].position == pytest.approx(10 * free["cramer_rao"].position, rel=1e-9)
    deaf = floors("square16", TOUCH, -40.0)["bayes"]
    assert (deaf.radius, deaf.position) == pytest.approx((np.log(3) / np.sqrt(12), 2 * np.sqrt(2 / 12)), rel=0.01)
    hard = floors("square16", Shape("circle", 0.3, 0.2, 0.1, 0.9), 80.0)["bayes"]
    assert free["bayes"].force == pytest.approx(free["bayes"].integral) and hard.force > 1.5 * hard.integral


def test_the_command_takes_metres(capsys):
    said = [(limits.main(["--grid", "2", *more]), capsys.readouterr().out)[1] for more in ((), ("--radius", "0.01"))]
    assert said[0] == said[1] and "touch of radius 10 mm" in said[0]
