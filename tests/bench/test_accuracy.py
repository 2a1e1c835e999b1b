"""Scores of frames made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from bench.accuracy import compare, scores
from bench.accuracy import frames as _frames
from bench.accuracy.frames import Frames
from models import metrics, patterns
from models.forward import shared
from models.shapes import Shape, drop_image, to_rows


def frames_of(groups):
    """Frames without physics: (group, scene) pairs, impedances all one."""
    names, rows = np.array([g for g, _ in groups]), np.array([to_rows(scene, 4) for _, scene in groups])
    pairs, adjacent = np.ones((len(groups), 120)), np.ones((len(groups), 208))
    return Frames(names, rows, pairs, pairs, adjacent, adjacent)


def test_symmetry_moves_touches_as_solving_them_does_and_covers_the_papers_grid():
    model, pair = shared("square16", "inverse"), patterns.pattern("pairs", 16)
    shape, z0 = Shape("circle", 0.6, 0.2, 0.2, 0.3), model.solve(1.0).impedances(pair)
    solution = model.solve(model.touched([shape]))
    for turn, to in _frames.symmetries()[:3]:
        x, y = turn @ (shape.x, shape.y)
        back = np.argsort(to)[pair]
        moved = solution.impedances(back) / model.solve(1.0).impedances(back) - 1
        solved = model.solve(model.touched([replace(shape, x=x, y=y)])).impedances(pair) / z0 - 1
        assert np.linalg.norm(moved - solved) < 5e-3 * np.linalg.norm(solved)  # the mesh is not symmetric
    octant = [scene[0] for name, scene in _frames.scenes(1, 2) if name == "ldci-0.2-0.15"]
    spread = {(round(x, 6), round(y, 6)) for s in octant for t, _ in _frames.symmetries() for x, y in [t @ (s.x, s.y)]}
    assert spread == {(round(x, 6), round(y, 6)) for x, y in metrics.ldci_positions(0.2)}


def test_noise_is_what_it_says():
    frames = frames_of([("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])] * 50)
    noisy, untouched = _frames.noisy(frames, "60", seed=1)
    assert noisy.pairs.std() == pytest.approx(1e-3, rel=0.05) == untouched.std()
    assert (noisy.pairs0[0] - 1).std() == pytest.approx(1e-3 / 8, rel=0.2)  # the mean of 64
    assert np.median(compare.tares(noisy, untouched)[""].sigma) == pytest.approx(1e-3, rel=0.1)
    weak = replace(frames, adjacent=frames.adjacent * 0.01, adjacent0=frames.adjacent0 * 0.01)
    assert (_frames.noisy(weak, "60f", 1)[0].adjacent / 0.01).std() == pytest.approx(0.1, rel=0.05)


def test_perfect_images_score_perfectly_and_poor_ones_do_not():
    groups = [("shapes", [Shape(k, 0.2, 0.1, 0.35, 0.3, 0.3)]) for k in ("circle", "triangle", "L")]
    groups += [("force", [Shape("circle", -0.3, 0.2, 0.2, 0.25)])]
    groups += [("two", [Shape("circle", -0.5, 0, 0.25, 0.3), Shape("square", 0.5, 0, 0.25, 0.2)])]
    frames, index = frames_of(groups), np.arange(5)
    truth = np.array([drop_image(frames.scene(k), 96) for k in index])
    best = scores.of_images(truth, frames, index)
    assert best["mean_iou"] > 0.98 and best["position_%"] < 0.2 and best["count_%"] == best["single_%"] == 100
    assert best["force_%"] < 0.1 and best["integral_%"] < 0.5 and best["four_%"] is None
    shifted = scores.of_images(np.roll(truth, 6, axis=2) * 1.2, frames, index)
    assert shifted["position_%"] == pytest.approx(6 / 96 * 100, rel=0.05)
    assert shifted["force_%"] == pytest.approx(20, rel=0.01)
    assert scores.of_images(truth * 0.5, frames, index, (2.0, 2.0))["force_%"] < 0.1


def test_contacts_are_scored_where_they_are_shown_and_counted_where_they_are_not():
    groups = [("shapes", 0.3)] * 3 + [("force", 0.2)] * 3
    frames = frames_of([(name, [Shape("circle", 0, 0, radius, 0.2)]) for name, radius in groups])
    found = {
        **{"count": np.array([1, 1, 2, 1, 1, 0]), "valid": np.ones(6, bool), "force_sigma": np.ones((6, 1))},
        "position": np.column_stack([0.001 * np.arange(6), np.zeros(6)])[:, None],  # 0, 1, 2 ... % of the side
        "force": np.array([[2.0], [2.0], [2.0], [2.2], [1.4], [np.nan]]),
        "shape": np.array([["circle"], ["circle"], ["L"], ["circle"], ["circle"], [""]]),
    }
    row = scores.of_contacts(found, frames)
    assert row["position_%"] == pytest.approx(2) and row["position_%_se"] == pytest.approx(np.sqrt(2.5 / 5))
    assert row["force_%"] == pytest.approx(20) and row["force_%_se"] == pytest.approx(10)
    assert row["shape_%"] == pytest.approx(200 / 3) and row["single_%"] == pytest.approx(400 / 6)
    assert (row["missed"], row["far"], row["not_valid"]) == (1, 0, 0)
