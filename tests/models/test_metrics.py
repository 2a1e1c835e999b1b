"""Metrics against answers by hand; classical methods and shipped networks against the figures others report."""

import numpy as np
import onnxruntime
import pytest

from models import baselines, metrics
from models.forward import ForwardModel
from models.shapes import Shape, drop_image, from_rows


def test_ldci_and_iou_worked_out_by_hand():
    peaks = np.full(49, 2.0)
    assert metrics.ldci(peaks) == 0
    peaks[[0, 48]] = 1.0, 2.8  # one half too low, one 0.4 too high
    assert metrics.ldci(peaks) == pytest.approx((0.5 + 0.4) / 48)
    places = metrics.ldci_positions(0.2)[[0, 6, 24, 30]]  # numbers 1, 7, 25 and 31 of the paper
    np.testing.assert_allclose(places, [[-0.6, 0.6], [0.6, 0.6], [0, 0], [-0.2, -0.2]], atol=1e-12)
    a, b = np.zeros((2, 10, 10), bool)
    a[:4, :5], b[2:6, :5] = True, True  # 20 pixels each, 10 shared: contact 10/30, background 70/90
    assert metrics.iou(a, b) == pytest.approx(((1 / 3 + 7 / 9) / 2, 1 / 3)) and metrics.iou(a, a) == (1.0, 1.0)
    assert metrics.relative_error(0.45, 0.5) == pytest.approx(10) and metrics.of_side(0.02) == pytest.approx(1.0)


def test_touches_are_told_apart_and_thresholded_each_on_its_own():
    strong, weak = Shape("circle", -0.5, 0, 0.25, 0.5), Shape("square", 0.5, 0.2, 0.3, 0.12)
    image = drop_image([strong, weak], 48)
    labels = metrics.basins(image)
    np.testing.assert_array_equal(labels > 0, image > 0.5 * np.where(labels == 2, 0.12, 0.5))
    assert metrics.iou(metrics.touch_masks(image, [strong, weak])[1], weak.fraction(48, covered=True) > 0.5)[1] > 0.95


def test_a_perfect_image_scores_perfectly_and_others_by_what_they_lack():
    shape = Shape("L", 0.2, -0.3, 0.35, 0.3, 0.4)
    found = metrics.score(drop_image([shape], 96), [shape])
    assert found["mean_iou"] > 0.99 and found["contact_iou"] > 0.98 and found["count"] == 1
    assert (found["correlation"], found["ssim"]) == pytest.approx((1, 1))
    assert found["position"] < 0.003 and found["force_error"] < 1e-6 and found["integral_error"] < 1e-6
    shape = Shape("circle", 0.25, 0.25, 0.25, 0.3)
    moved = drop_image([Shape("circle", 0.25 + 4 / 24, 0.25, 0.25, 0.3)], 48)  # four pixels of 2/48 to the right
    assert metrics.position_error(metrics.touch_masks(moved, [shape])[0], shape) == pytest.approx(4 / 24, abs=2e-3)
    truth = drop_image([shape], 48)
    assert metrics.ssim(truth * 0.5, truth) < metrics.ssim(truth * 0.9, truth) < 1


def mean_iou(method, scenes):
    found = []
    for d, shapes in scenes:
        image = method(d)
        mask = metrics.touch_masks(image, shapes)[0]
        found.append(metrics.iou(mask, shapes[0].fraction(len(image), covered=True) > 0.5)[0])
    return np.mean(found)


def test_eidors_scenes_are_seen_as_others_see_them(reference):
    """EIDORS itself, single touches: NOSER 0.77, total variation 0.78, noise-free, on other scenes of this kind."""
    data, physics = reference("eidors_reference"), baselines.PeerPhysics(ForwardModel("square16", mesh="inverse"))
    z, shapes = data["impedance_pairs"], [from_rows(rows) for rows in data["shapes"]]
    scenes = [(z[k] / z[0] - 1, shapes[k]) for k in range(1, len(z)) if len(shapes[k]) == 1]
    assert 0.74 < mean_iou(baselines.noser(physics, 0.003, n=48, units="relative"), scenes) < 0.85
    assert 0.76 < mean_iou(baselines.TotalVariation(physics, 1e-7), scenes[:6]) < 0.90
    assert 0.72 < mean_iou(baselines.GaussNewton(physics, 0.005, n=48), scenes[:6]) < 0.90
    assert 0.60 < mean_iou(baselines.greit(physics, noise_figure=2.0), scenes) < 0.80


@pytest.mark.parametrize(
    "variant, decibel, bound", [("full", None, 0.90), ("full", 70, 0.84), ("fast", None, 0.88), ("fast", 70, 0.80)]
)
def test_the_shipped_network_on_another_solvers_frames(bundle, pre, reference, variant, decibel, bound):
    """EIDORS's single touches. Bounds below the benchmark's figures: they catch a broken bundle, not a bad day."""
    z, rng, scores = reference("eidors_reference"), np.random.default_rng(0), []
    impedance = np.abs(z["impedance_pairs"])
    single = np.flatnonzero(np.isfinite(z["shapes"][:, 0, 0]) & np.isnan(z["shapes"][:, 1, 0]))
    sigma = 10 ** (-(decibel or 130) / 20)
    operator = pre.condition(np.full(120, sigma))
    session = onnxruntime.InferenceSession(str(bundle.network_path(variant)), providers=["CPUExecutionProvider"])
    for scene in np.repeat(single, 4):
        z0 = (impedance[0] * (1 + sigma * rng.standard_normal((64, 120)))).mean(axis=0)
        noisy = impedance[scene] * (1 + sigma * rng.standard_normal(120))
        stack, context, _ = operator.stack(pre.difference(noisy, z0))
        drop = session.run(None, {"stack": stack[None], "context": context[None]})[0][0, 0]
        scores.append(metrics.iou(drop > 0.5 * drop.max(), z["drop"][scene] > 0)[0])
    assert np.mean(scores) > bound
