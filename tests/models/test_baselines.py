"""The classical methods and the shipped networks: the figures others report for them."""

import numpy as np
import onnxruntime
import pytest

from models import baselines, metrics
from models.forward import ForwardModel
from models.shapes import from_rows


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
