"""The accuracy benchmark's own parts: a benchmark that errs would err for everybody at once."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests import needs

needs.PEERS.here()

from bench.accuracy import __main__ as accuracy  # noqa: E402
from bench.accuracy import frames as _frames  # noqa: E402
from bench.accuracy import peers as _peers  # noqa: E402
from bench.accuracy import report as _report  # noqa: E402
from bench.accuracy import scores as _scores  # noqa: E402
from bench.accuracy import shipped as _shipped  # noqa: E402
from bench.accuracy.frames import Frames  # noqa: E402
from bench.accuracy.methods import Method, Tare  # noqa: E402
from models import metrics, patterns  # noqa: E402
from models.bundle import Bundle  # noqa: E402
from models.forward import shared  # noqa: E402
from models.shapes import Shape, drop_image, to_rows  # noqa: E402


def frames_of(groups):
    """Frames without physics: (group, scene) pairs, impedances all one."""
    n = len(groups)
    rows = np.array([to_rows(scene) for _, scene in groups])
    ones = np.ones((n, 120)), np.ones((n, 208))
    return Frames(np.array([g for g, _ in groups]), rows, ones[0], ones[0], ones[1], ones[1])


def test_symmetry_moves_touches_as_solving_them_does():
    model = shared("square16", "inverse")
    pair = patterns.pattern("pairs", 16)
    z0 = model.solve(1.0).impedances(pair)
    shape = Shape("circle", 0.6, 0.2, 0.2, 0.3)
    solution, places = model.solve(model.touched([shape])), set()
    for turn, to in _frames.symmetries():
        x, y = turn @ (shape.x, shape.y)
        places.add((round(x, 6), round(y, 6)))
        back = np.argsort(to)[pair]
        moved = solution.impedances(back) / model.solve(1.0).impedances(back) - 1
        solved = model.solve(model.touched([replace(shape, x=x, y=y)])).impedances(pair) / z0 - 1
        assert np.linalg.norm(moved - solved) < 5e-3 * np.linalg.norm(solved)  # the mesh is not symmetric
    assert len(places) == 8


def test_ldci_scenes_cover_the_papers_grid():
    octant = [scene[0] for name, scene in _frames.scenes(1, 2) if name == "ldci-0.2-0.15"]
    spread = {(round(x, 6), round(y, 6)) for s in octant for t, _ in _frames.symmetries() for x, y in [t @ (s.x, s.y)]}
    assert spread == {(round(x, 6), round(y, 6)) for x, y in metrics.ldci_positions(0.2)}


def test_noise_is_what_it_says():
    frames = frames_of([("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])] * 50)
    noisy, untouched = _frames.noisy(frames, "60", seed=1)
    assert noisy.pairs.std() == pytest.approx(1e-3, rel=0.05)
    assert untouched.shape == (64, 120) and untouched.std() == pytest.approx(1e-3, rel=0.05)
    assert (noisy.pairs0[0] - 1).std() == pytest.approx(1e-3 / 8, rel=0.2)  # the mean of 64
    tare = accuracy.tares(noisy, untouched)[""]
    assert np.median(tare.sigma) == pytest.approx(1e-3, rel=0.1)
    weak = replace(frames, adjacent=frames.adjacent * 0.01, adjacent0=frames.adjacent0 * 0.01)
    assert (_frames.noisy(weak, "60", 1)[0].adjacent / 0.01).std() == pytest.approx(1e-3, rel=0.05)
    assert (_frames.noisy(weak, "60f", 1)[0].adjacent / 0.01).std() == pytest.approx(0.1, rel=0.05)


def test_perfect_images_score_perfectly_and_poor_ones_do_not():
    groups = [("shapes", [Shape(k, 0.2, 0.1, 0.35, 0.3, 0.3)]) for k in ("circle", "triangle", "L")]
    groups += [("force", [Shape("circle", -0.3, 0.2, 0.2, 0.25)])]
    groups += [("two", [Shape("circle", -0.5, 0, 0.25, 0.3), Shape("square", 0.5, 0, 0.25, 0.2)])]
    frames = frames_of(groups)
    truth = np.array([drop_image(frames.scene(k), 96) for k in range(len(frames))])
    index = np.arange(len(frames))
    best = _scores.summarise(truth, frames, index, None)
    assert best["mean_iou"] > 0.98 and best["position_%"] < 0.2 and best["count_%"] == 100
    assert best["force_%"] < 0.1 and best["integral_%"] < 0.5
    shifted = _scores.summarise(np.roll(truth, 6, axis=2) * 1.2, frames, index, None)
    assert shifted["position_%"] == pytest.approx(6 / 96 * 100, rel=0.05)
    assert shifted["force_%"] == pytest.approx(20, rel=0.01)
    assert _scores.summarise(truth * 0.5, frames, index, (2.0, 2.0))["force_%"] < 0.1


def test_figures_have_their_standard_errors():
    """Half the touches found, half missed by a quarter of the skin: the error of a mean of such values is known."""
    round_one = [Shape("circle", -0.3, 0.1, 0.35, 0.3)]
    frames = frames_of([("shapes", round_one)] * 8 + [("force", round_one), ("two", round_one)])
    images = np.array([drop_image(frames.scene(0), 96)] * 8)
    images[::2] = np.roll(images[::2], 24, axis=2)
    both = np.concatenate([images, images[1:3]])
    row = _scores.summarise(both, frames, np.arange(10), None)
    found = [_scores.score_mask(i, frames, 0) for i in images]
    assert row["mean_iou_se"] == pytest.approx(np.std(found, ddof=1) / np.sqrt(8), rel=1e-6)
    assert 0 < row["mean_iou_se"] < row["mean_iou"]
    assert _report.text(row, "mean_iou", "{:.2f}") == f"{row['mean_iou']:.2f} +-{row['mean_iou_se']:.2f}"
    assert _report.text({"mean_iou": 0.5, "mean_iou_se": float("nan")}, "mean_iou", "{:.2f}") == "0.50"


def test_a_contacts_own_standard_errors_replace_those_of_the_image():
    frames = frames_of(
        [("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])] * 3 + [("force", [Shape("circle", 0, 0, 0.2, 0.2)])] * 2
    )
    five = np.arange(5)
    found = {
        "count": np.ones(5, int),
        "position": np.column_stack([0.001 * five, 0 * five])[:, None],  # m; 0, 1, 2 ... % of the side of 0.1 m
        "force": np.array([[2.0], [2.0], [2.0], [2.2], [1.4]]),
        "force_sigma": np.ones((5, 1)),
        "shape": np.array([["circle"], ["circle"], ["L"], ["circle"], ["circle"]]),
    }
    row = _shipped.contacts(found, frames)
    assert row["position_%"] == pytest.approx(2) and row["position_%_se"] == pytest.approx(np.sqrt(2.5 / 5))
    assert row["force_%"] == pytest.approx(20) and row["force_%_se"] == pytest.approx(10)
    assert row["shape_%"] == pytest.approx(200 / 3) and row["shape_%_se"] == pytest.approx(100 / 3)


def test_the_full_form_has_five_hundred_touches_of_the_five_shapes():
    groups = [name for name, _ in _frames.scenes(1, 20, accuracy.SINGLES)]
    assert groups.count("shapes") >= 500 and groups.count("force") >= 100 and groups.count("two") == 20


def test_the_hyperparameter_that_fits_is_chosen():
    scene = [Shape("circle", 0.1, 0.1, 0.4, 0.3)]
    frames = frames_of([("shapes", scene)] * 2)
    truth = drop_image(scene, 48)

    def build(tare, value):
        return lambda z: truth if value == 2.0 else np.roll(truth, 9, axis=0)

    method = Method("either", build, (1.0, 2.0, 3.0))
    known = {"": Tare(np.ones((64, 120)), np.ones(120), np.ones(208))}
    assert accuracy.tuned(method, frames, known, 1) == 2.0


@pytest.mark.release
def test_pyeit_sees_a_touch_where_it_is():
    model = shared("square16", "inverse")
    rows = patterns.pattern("adjacent", 16)
    z0 = np.abs(model.solve(1.0).impedances(rows))
    d = np.abs(model.solve(model.touched([Shape("circle", -0.4, 0.3, 0.25, 0.3)])).impedances(rows)) / z0 - 1
    image = _peers.PyEIT("jac", 1e-3, 48)(d)
    mask = image > image.max() / 2
    assert np.hypot(*(metrics.centroid(mask) - (-0.4, 0.3))) < 0.06


def test_missed_targets_are_marked():
    rows = [
        {"method": "shipped, full", "level": "none", "mean_iou": 0.96, "position_%": 0.4},
        {"method": "shipped, full", "level": "70", "position_%": 0.5, "position_rms_%": 0.52},
    ]
    frames = frames_of([("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])])
    report = _report.Report(rows, {"70": {"position_rms_%": 0.5}}, frames, "stub", 1, Bundle.load("square16"))
    goals = {goal.figure: goal for goal in report.goals()}
    assert goals["mean IoU, five shapes, noise-free"].met and not goals["position, % of side, noise-free"].met
    beside_floor = goals["position, % of side, 70 dB: rms over its floor"]
    assert beside_floor.value == pytest.approx(1.04) and beside_floor.met
    unknown = goals["shape class, radius >= 0.25, %, 70 dB"]
    assert unknown.measured == "not measured" and unknown.met is False


def test_reports_are_strict_json(tmp_path):
    rows = [{"method": "one", "level": "none", "ms": 1.0, "mean_iou": 0.8, "position_%": 1.0, "separation": np.inf}]
    frames = frames_of([("shapes", [Shape("circle", 0, 0, 0.3, 0.2)])])
    _report.Report(rows, {}, frames, "stub", 1, Bundle.load("square16")).write(tmp_path)
    text = (tmp_path / "accuracy.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["rows"][0]["separation"] is None
    assert (tmp_path / "accuracy.png").stat().st_size > 10_000
