"""Floors of a touch's errors: against simulated estimates, against facts known of this skin, and their own logic."""

import json

import numpy as np
import pytest

from models import force_limits, limits
from models.bundle import Bundle
from models.fisher import STEPS, MeasurementNoise, SizePrior, floors, information, mean_floor, sensitivity
from models.forward import shared
from models.patterns import pattern
from models.prereconstruction import Drift
from models.pressure import FOAM, disc
from models.shapes import Shape
from tests import needs

TOUCH = Shape("circle", 0.31, 0.27, 0.2, 0.3)


def moved(dx=0.0, dy=0.0, grow=0.0, deepen=0.0):
    return Shape("circle", 0.31 + dx, 0.27 + dy, 0.2 * np.exp(grow), 0.3 * np.exp(deepen))


def test_slopes_predict_signals_of_another_mesh():
    """A small change of the touch, solved on the training mesh, is read back through the slopes of the inverse mesh."""
    training = shared("square16", "training")
    _, slope, _ = sensitivity("square16", TOUCH).relative(pattern("adjacent"))

    def d(shape):
        z0 = training.solve().impedances("adjacent")
        return training.solve(training.touched([shape])).impedances("adjacent") / z0 - 1

    change = np.array([0.03, -0.02, 0.05, -0.04])
    found = np.linalg.lstsq(slope, d(moved(*change / 2)) - d(moved(*-change / 2)), rcond=None)[0]
    np.testing.assert_allclose(found, change, atol=0.004)


def test_estimates_from_noisy_frames_reach_the_floor():
    """Gauss-Newton on noisy frames, weighted by the noise, errs by what Cramer-Rao says."""
    noise, rng = MeasurementNoise(60.0), np.random.default_rng(4)
    model = shared("square16", "inverse")
    rows = pattern("adjacent")
    z0, slope, _ = sensitivity("square16", TOUCH).relative(rows)
    truth = model.solve(model.touched([TOUCH])).impedances(rows)
    sigma = noise.sigma(z0)
    weighted = slope * (z0 / sigma)[:, None]
    errors = []
    for _ in range(40):
        measured = truth + sigma * rng.standard_normal(len(rows))
        estimate = rng.normal(0, 0.01, 4)  # the first guess is not the truth
        for _ in range(2):
            now = model.solve(model.touched([moved(*estimate)])).impedances(rows)
            estimate += np.linalg.lstsq(weighted, (measured - now) / sigma, rcond=None)[0]
        errors.append(np.hypot(*estimate[:2]))
    floor = floors("square16", TOUCH, noise, pattern=rows)["cramer_rao"].position
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(floor, rel=0.3)


def test_drift_is_marginalised_not_projected():
    """Against the whole information matrix of touch and drift, inverted."""
    seen, noise, drift = sensitivity("square16", TOUCH), MeasurementNoise(70.0), Drift(0.01, 0.05)
    rows = pattern("pairs")
    z0, slope, nuisance = seen.relative(rows)
    j = np.hstack([slope, nuisance]) / (noise.sigma(z0) / np.abs(z0))[:, None]
    prior = np.diag(np.r_[np.zeros(4), 1 / 0.01**2, np.full(16, 1 / 0.05**2)])
    expected = np.linalg.inv(j.T @ j + prior)[:4, :4]
    np.testing.assert_allclose(np.linalg.inv(information(seen, rows, noise, drift)), expected, rtol=1e-6)


def test_facts_known_of_this_skin():
    """70 dB, no drift, radius 0.2: known from a computation by others."""
    found = [floors("square16", Shape("circle", x, y, 0.2, 0.3), 70.0)["cramer_rao"] for x, y in ((0, 0), (0.3, 0.3))]
    for floor in found:
        assert 0.25 < floor.position_percent < 0.6
        assert 0.25 < floor.drop < 0.6
        assert 0.02 < floor.integral < 0.10
    known = floors("square16", Shape("circle", 0.3, 0.3, 0.2, 0.3), 70.0, SizePrior(radius=(0.2, 0.2)))["cramer_rao"]
    assert 0.003 < known.drop < 0.015


def test_patterns_rank_by_the_noise():
    fixed = dict(limits.rank_patterns(limits.Case(noise=MeasurementNoise(np.inf, 1e-4)), per_side=4))
    assert list(fixed) == ["pairs", "opposite", "adjacent"]
    assert 1.4 < fixed["opposite"].position / fixed["pairs"].position < 3
    assert 4 < fixed["adjacent"].position / fixed["pairs"].position < 12
    relative = [name for name, _ in limits.rank_patterns(limits.Case(noise=MeasurementNoise(70.0)), per_side=4)]
    assert relative == ["adjacent", "opposite", "pairs"]


def test_more_knowledge_lowers_the_floors():
    free = floors("square16", TOUCH, 70.0)
    drifting = floors("square16", TOUCH, 70.0, drift=Drift(np.inf, np.inf))
    known = floors("square16", TOUCH, 70.0, SizePrior(radius=(0.2, 0.2)))
    for name in ("position", "radius", "drop", "integral"):
        assert getattr(free["bayes"], name) <= getattr(free["cramer_rao"], name)
        assert getattr(drifting["bayes"], name) >= getattr(free["bayes"], name)
        assert getattr(drifting["cramer_rao"], name) >= getattr(free["cramer_rao"], name)
        assert getattr(known["bayes"], name) <= getattr(free["bayes"], name)
    assert known["bayes"].radius < 1e-4


def test_cramer_rao_scales_with_the_noise_and_bayes_stops_at_the_prior():
    quiet, loud = floors("square16", TOUCH, 80.0), floors("square16", TOUCH, 60.0)
    assert loud["cramer_rao"].position == pytest.approx(10 * quiet["cramer_rao"].position, rel=1e-9)
    deaf = floors("square16", TOUCH, -40.0)["bayes"]
    assert deaf.radius == pytest.approx(np.log(3) / np.sqrt(12), rel=0.01)
    assert deaf.position == pytest.approx(2 * np.sqrt(2 / 12), rel=0.01)


def test_floors_share_the_squares_symmetry():
    here = floors("square16", Shape("circle", 0.3, 0.5, 0.2, 0.3), 70.0)["bayes"]
    turned = floors("square16", Shape("circle", -0.5, 0.3, 0.2, 0.3), 70.0)["bayes"]
    assert turned.position == pytest.approx(here.position, rel=0.06)
    assert turned.integral == pytest.approx(here.integral, rel=0.1)


def test_another_shape_counts_as_the_circle_of_its_area():
    square = Shape("square", 0.31, 0.27, 0.2 * np.sqrt(np.pi / 2), 0.3, 0.4)
    assert floors("square16", square)["bayes"].drop == pytest.approx(floors("square16", TOUCH)["bayes"].drop)


def test_mean_is_root_mean_square():
    a, b = floors("square16", TOUCH, 70.0)["bayes"], floors("square16", TOUCH, 80.0)["bayes"]
    assert mean_floor([a, b]).drop == pytest.approx(np.sqrt((a.drop**2 + b.drop**2) / 2))


def test_command_line(capsys):
    assert (
        limits.main(["--skin", "disc16", "--rank", "--snr", "inf", "--floor-ohm", "1e-4", "--grid", "2", "--json"]) == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert report["case"]["noise"] == {"snr_db": "Infinity", "floor_ohm": 1e-4, "tare_frames": 64}
    assert report["rows"][0]["pattern"] == "pairs" and len(report["rows"]) == 3
    assert limits.main(["--snr", "inf"]) == 2
    assert "without noise nothing limits a touch" in capsys.readouterr().err
    assert limits.main(["--skin", "hexagon6"]) == 2


def test_its_picture(tmp_path):
    needs.PLOTS.here()
    limits.draw(limits.Case(), 0.4, 0.3, 4, tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_lengths_are_metres(capsys):
    """Of a skin of 100 mm: the touch that the default is has a radius of 10 mm."""

    def said(*more):
        assert limits.main(["--grid", "2", *more]) == 0
        return capsys.readouterr().out

    assert said("--radius", "0.01") == said() and "touch of radius 10 mm" in said()
    report = json.loads(said("--known-radius", "--json"))
    assert report["radius_m"] == pytest.approx(0.01) and report["case"]["prior"]["radius"] == pytest.approx([0.01] * 2)


def test_a_touch_off_the_skin_is_refused():
    with pytest.raises(ValueError, match=r"a touch at \(0.9, 0.9\) is not on skin 'disc16'"):
        floors("disc16", Shape("circle", 0.9, 0.9, 0.1, 0.3))
    assert max(STEPS) < 0.1


def test_a_force_is_known_as_its_integral_is_until_the_foam_saturates():
    linear = floors("square16", Shape("circle", 0.3, 0.2, 0.2, 0.4), 80.0)["bayes"]
    assert linear.force == pytest.approx(linear.integral)
    hard = floors("square16", Shape("circle", 0.3, 0.2, 0.1, 0.9), 80.0)["bayes"]
    assert hard.force > 1.5 * hard.integral


@pytest.mark.release
def test_the_smallest_force_that_is_shown_is_shown():
    """Frames of another mesh and other noise, at other places: nearly all are seen at that force, few at a third."""
    noise, radius_mm = MeasurementNoise(80.0), 10.0
    found = force_limits.smallest("square16", noise, radius_mm, per_side=3)
    model, pre = shared("square16", "stub"), Bundle.load("square16").prereconstructor()
    z0 = np.abs(model.solve(1.0).impedances())
    norm, rng = pre.normaliser(z0), np.random.default_rng(7)
    sigma = noise.sigma(z0) / norm
    operator = pre.condition(sigma, drift=force_limits.SINCE_TARE)
    limit = operator.threshold(force_limits.FALSE_ALARM)
    seen = {}
    for share in (1.0, 1 / 3):
        drop = FOAM.flat_drop(share * found.shown_n, disc(radius_mm * 1e-3))
        scores = []
        for x, y in rng.uniform(-0.75, 0.75, (12, 2)):
            z = np.abs(model.solve(model.touched([Shape("circle", x, y, 0.2, drop)])).impedances())
            scores += [operator.score((z - z0) / norm + sigma * rng.standard_normal(len(z))) for _ in range(50)]
        seen[share] = np.mean(np.array(scores) > limit)
    assert seen[1.0] > 0.985 and seen[1 / 3] < 0.5
    assert found.measured_n < found.shown_n
    louder = force_limits.smallest("square16", MeasurementNoise(70.0), radius_mm, per_side=3)
    assert 2 < louder.shown_n / found.shown_n < 4


@pytest.mark.parametrize(
    "more", (["--known-radius"], ["--radius", "0.01"], ["--rank"], ["--pattern", "adjacent"], ["--map", "map.png"])
)
def test_the_smallest_forces_take_no_option_that_they_would_not_heed(capsys, more):
    with pytest.raises(SystemExit) as ended:
        limits.main(["--forces", *more])
    assert ended.value.code == 2 and f"found --forces and {more[0]}" in capsys.readouterr().err


@pytest.mark.release
def test_command_line_of_the_smallest_forces(capsys):
    assert limits.main(["--forces", "--skin", "hexagon6"]) == 2
    assert limits.main(["--forces", "--snr", "80", "--grid", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["radius_mm"] for row in rows] == [5.0, 10.0, 15.0, 20.0] and all(0 < r["shown_n"] < 0.3 for r in rows)
