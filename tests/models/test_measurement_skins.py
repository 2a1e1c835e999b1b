"""Tables of skins of other outlines, patterns and numbers of electrodes, with and without response tables: what is left
of a touch at its true disc, by finite elements of another mesh.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from models import bundle, geometry, manifest
from models.forward import ForwardModel
from models.linearise import linearise
from models.measurement.course import TouchCourse
from models.measurement.covariance.noise import NoiseModel
from models.measurement.covariance.whitening import Whitening
from models.measurement.fit import FittedScan, TouchFitter
from models.measurement.responses.disc import DiscResponse
from models.measurement.responses.grid import DiscGrid
from models.measurement.responses.tables import SkinTables, tables_of
from models.measurement.touch import ACTION, PLACE, anywhere
from models.response_tables import response_tables
from models.shapes import Shape

DISC12 = {
    "name": "disc12",
    "unit": "mm",
    "contact_impedance": 0.01,
    "radius": 30,
    "electrodes": {"width": 5, "count": 12},
}
KINDS = [(pattern, fine) for pattern in ("pairs", "adjacent", "opposite") for fine in (True, False)]
NOISE, SPAN_S = 1e-4, 0.03


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """tables(pattern, fine) of a round skin of 12 electrodes, relative to the untouched skin on the other mesh."""
    folder: Path = tmp_path_factory.mktemp("skins")

    @cache
    def made(pattern: str, fine: bool) -> SkinTables:
        skin = geometry.from_dict(DISC12).with_pattern(pattern)
        model = ForwardModel(skin)
        matrices = linearise(model, "model")
        name = f"{pattern}-{fine}"
        response = response_tables(model, coarse=24) if fine else None
        bundle.write(folder / name, manifest.describe(name, skin, matrices), matrices, response=response)
        return tables_of(bundle.Bundle.load(folder / name)).relative_to(untouched(pattern))

    return made


@cache
def model(pattern: str) -> ForwardModel:
    return ForwardModel(geometry.from_dict(DISC12).with_pattern(pattern), mesh="stub")


@cache
def untouched(pattern: str) -> np.ndarray:
    return np.abs(model(pattern).solve(1.0).impedances())


def change(pattern: str, *shapes: Shape) -> np.ndarray:
    of = model(pattern)
    return np.abs(of.solve(of.touched(list(shapes), 1.0)).impedances()) / untouched(pattern) - 1


def action_of(shape: Shape) -> float:
    return shape.drop / (1 - shape.drop / 2) * np.pi * shape.radius**2


PLACES = {"middle": (0.1, 0.05), "half": (0.45, -0.2), "edge": (0.62, 0.3)}
MOST = {  # % of the change: a touch of radius 0.2 and drop 0.4
    ("pairs", True): {"middle": 0.15, "half": 0.15, "edge": 0.4},
    ("pairs", False): {"middle": 0.5, "half": 1.0, "edge": 2.0},
    ("adjacent", True): {"middle": 0.3, "half": 0.5, "edge": 1.0},
    ("adjacent", False): {"middle": 1.2, "half": 1.5, "edge": 2.5},
    ("opposite", True): {"middle": 0.3, "half": 0.5, "edge": 1.0},
    ("opposite", False): {"middle": 0.5, "half": 1.2, "edge": 2.5},
}


@pytest.mark.release
@pytest.mark.parametrize(("pattern", "fine"), KINDS)
def test_what_a_disc_leaves_of_a_touch(tables, pattern: str, fine: bool) -> None:
    """Also where half of the impedances are negative, as with opposite drives."""
    known = tables(pattern, fine)
    response = DiscResponse(known)
    for place, (x, y) in PLACES.items():
        touch = Shape("circle", x, y, 0.2, 0.4)
        there, said = change(pattern, touch), action_of(touch) * response(x, y, np.log(0.2))
        scale = said @ there / (said @ said)
        left = np.linalg.norm(there - scale * said) / np.linalg.norm(there)
        assert scale == pytest.approx(1, abs=0.06), place
        assert 100 * left < MOST[pattern, fine][place], (place, left)
        assert left < 2 * known.wrong, place


@pytest.mark.parametrize(("pattern", "fine"), KINDS)
def test_a_press_is_found_where_it_is_with_an_honest_sigma(tables, pattern: str, fine: bool) -> None:
    known, rng = tables(pattern, fine), np.random.default_rng(3)
    response = DiscResponse(known)
    k = known.measurements
    covariance, times_s = NoiseModel(known).covariance(0), ((np.arange(k) + 0.5) / k - 0.5) * SPAN_S
    grid, white = DiscGrid(response), Whitening.of(covariance)
    for x, y in PLACES.values():
        touch = Shape("circle", x, y, 0.2, 0.2)
        values = np.log1p(change(pattern, touch)) + NOISE * rng.standard_normal(k)
        z2, disc, action = grid.likeliest(white.solve(values), grid.information(white))
        start = anywhere(float(grid.discs[disc, 0]), float(grid.discs[disc, 1]), action, SPAN_S)
        course = TouchCourse(response, times_s, SPAN_S)
        fit = TouchFitter(FittedScan(values, covariance, course, known.misfit, k), [start], known.wrong).fit(10)
        off = fit.states[0, PLACE] - [x, y]
        sd = np.sqrt(np.diag(fit.covariance))[PLACE]
        assert z2 > 44 and fit.chi2 < 1.45
        assert np.linalg.norm(off) < 0.03, (x, y, off)  # 0.9 mm
        assert (np.abs(off) < 4 * sd + 0.005).all(), (x, y, off, sd)
        assert fit.states[0, ACTION] == pytest.approx(action_of(touch), rel=0.08)


def test_no_disc_of_the_grid_lies_off_a_round_skin(tables) -> None:
    grid = DiscGrid(DiscResponse(tables("pairs", False)))
    assert np.hypot(*grid.discs[:, :2].T).max() < 1.05
    assert (np.abs(grid.responses).max(axis=1) > 0).all()
