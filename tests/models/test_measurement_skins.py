"""Skins of other outlines, patterns and electrodes, by finite elements: what a touch leaves, where a fit finds it."""

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

ELECTRODES = {"width": 5, "count": 12}
DISC12 = {"name": "disc12", "unit": "mm", "contact_impedance": 0.01, "radius": 30, "electrodes": ELECTRODES}
NOISE, SPAN_S, ACTS = 1e-4, 0.03, np.pi * 0.2**2
PLACES = (0.1, 0.05), (0.45, -0.2), (0.62, 0.3)
MOST = {  # % of the change at the places above: a touch of radius 0.2 and drop 0.4
    ("pairs", False): (0.5, 1.0, 2.0),
    ("adjacent", False): (1.2, 1.5, 2.5),
    ("opposite", True): (0.3, 0.5, 1.0),  # half of the impedances are negative
}


@cache
def model(pattern: str) -> ForwardModel:
    return ForwardModel(geometry.from_dict(DISC12).with_pattern(pattern), mesh="stub")


def change(pattern: str, touch: Shape) -> np.ndarray:
    of = model(pattern)
    return np.abs(of.solve(of.touched([touch], 1.0)).impedances() / of.solve(1.0).impedances()) - 1


def tables(folder: Path, pattern: str, fine: bool) -> SkinTables:
    """Of a round skin of 12 electrodes, relative to the untouched skin on the other mesh."""
    skin = geometry.from_dict(DISC12).with_pattern(pattern)
    own = ForwardModel(skin)
    matrices, response = linearise(own, "model"), response_tables(own, coarse=24) if fine else None
    bundle.write(folder / "own", manifest.describe("own", skin, matrices), matrices, response=response)
    made = tables_of(bundle.Bundle.load(folder / "own"))
    return made.relative_to(np.abs(model(pattern).solve(1.0).impedances()))


@pytest.mark.parametrize(("pattern", "fine"), MOST)
def test_a_press_is_explained_by_its_disc_and_found_where_it_is(tmp_path: Path, pattern: str, fine: bool) -> None:
    known, rng = tables(tmp_path, pattern, fine), np.random.default_rng(3)
    response, k = DiscResponse(known), known.measurements
    covariance, times_s = NoiseModel(known).covariance(0), ((np.arange(k) + 0.5) / k - 0.5) * SPAN_S
    grid, white = DiscGrid(response), Whitening.of(covariance)
    assert np.hypot(*grid.discs[:, :2].T).max() < 1.05 and (np.abs(grid.responses).max(axis=1) > 0).all()
    for (x, y), most in zip(PLACES, MOST[pattern, fine], strict=True):
        touch = Shape("circle", x, y, 0.2, 0.4)
        there, said = change(pattern, touch), (ACTS * touch.drop / (1 - touch.drop / 2)) * response(x, y, np.log(0.2))
        scale = said @ there / (said @ said)
        left = np.linalg.norm(there - scale * said) / np.linalg.norm(there)
        assert scale == pytest.approx(1, abs=0.06), (x, y)
        assert 100 * left < most and left < 2 * known.wrong, (x, y, left)
        touch = Shape("circle", x, y, 0.2, 0.2)
        values = np.log1p(change(pattern, touch)) + NOISE * rng.standard_normal(k)
        z2, disc, action = grid.likeliest(white.solve(values), grid.information(white))
        start = anywhere(float(grid.discs[disc, 0]), float(grid.discs[disc, 1]), action, SPAN_S)
        course = TouchCourse(response, times_s, SPAN_S)
        fit = TouchFitter(FittedScan(values, covariance, course, known.misfit, k), [start], known.wrong).fit(10)
        off, sd = fit.states[0, PLACE] - [x, y], np.sqrt(np.diag(fit.covariance))[PLACE]
        assert z2 > 44 and fit.chi2 < 1.45
        assert np.linalg.norm(off) < 0.03 and (np.abs(off) < 4 * sd + 0.005).all(), (x, y, off, sd)
        assert fit.states[0, ACTION] == pytest.approx((ACTS * touch.drop / (1 - touch.drop / 2)), rel=0.08)
