"""What the errors of an image's figures are: fitted intervals cover, and a known indenter's strength is physics."""

import numpy as np
import pytest

from models import uncertainty
from models.forward import shared
from models.shapes import Shape
from models.uncertainty import ImageFeatures, Map, features, fit, known_drop, maps


def presses(n, seed):
    """N touches whose relative error is exactly known: it grows with noise and falls with area."""
    rng = np.random.default_rng(seed)
    drop, area, noise = rng.uniform(0.1, 0.5, n), np.exp(rng.uniform(-4, -0.5, n)), 10 ** rng.uniform(-5, -3, n)
    spread = 0.05 * (noise / 1e-4) ** 0.4 * (area / 0.1) ** -0.5
    peak = drop * np.exp(spread * rng.standard_normal(n) + 0.1)
    seen = ImageFeatures(peak, 0.2 * peak, drop * area, area, rng.uniform(0.1, 1, n), noise)
    return features("peak", seen), peak, drop, area, noise


def test_fitted_intervals_hold_on_other_presses_in_every_corner():
    x, peak, drop, *_ = presses(4000, 1)
    one = Map.from_dict(fit(x, peak, drop, correct=True).to_dict())
    x, peak, drop, area, noise = presses(4000, 2)
    factor, sigma = one(x)
    assert np.median(peak * factor / drop) == pytest.approx(1, abs=0.01)  # the bias is found
    inside = np.abs(peak * factor - drop) <= sigma * peak * factor
    for some in (area < 0.05, area > 0.2, noise < 1e-4, noise > 3e-4):
        assert 0.62 < inside[some].mean() < 0.74
    assert np.corrcoef(np.log(sigma), np.log(noise))[0, 1] > 0.3


def test_beyond_what_was_fitted_nothing_runs_away():
    x, peak, drop, *_ = presses(1000, 1)
    far = fit(x, peak, drop, correct=True)(np.full((1, x.shape[1]), 1e6))
    assert all(np.isfinite(v).all() for v in far) and uncertainty.LEAST <= far[1][0] <= uncertainty.MOST


def test_discs_of_the_same_strength_look_the_same_to_the_electrodes():
    model = shared("square16", "inverse")
    z0 = np.abs(model.solve(1.0).impedances())

    def seen(radius, drop):
        return np.abs(model.solve(model.touched([Shape("circle", 0.2, -0.1, radius, drop)])).impedances()) / z0 - 1

    small, strong = 0.10, 0.6
    known = np.pi * 0.15**2
    flat = ImageFeatures(*(np.array([v]) for v in (strong, 0.0, strong * np.pi * small**2, np.pi * small**2, 0.5, 0.0)))
    drop = float(known_drop(flat, known)[0])
    reference = seen(small, strong)
    same = np.linalg.norm(seen(0.15, drop) - reference) / np.linalg.norm(reference)
    naive = np.linalg.norm(seen(0.15, strong * small**2 / 0.15**2) - reference) / np.linalg.norm(reference)
    assert same < 0.04 < 0.15 < naive


def test_maps_hold_for_their_own_network_file_only():
    said = fit(*presses(500, 1)[:3], correct=False, network="aa").to_dict()
    manifest = {"network": {"full": {"uncertainty": {"peak": said}}}, "files": {"network.onnx": "aa"}}
    assert set(maps(manifest, "full", "network.onnx")) == {"peak"}
    assert maps(manifest | {"files": {"network.onnx": "bb"}}, "full", "network.onnx") == {}
    assert maps({"network": None, "files": {}}, "full", None) == {}
