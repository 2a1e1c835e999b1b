"""Metrics against answers worked out by hand, or known in closed form."""

import numpy as np
import pytest

from models import metrics
from models.scenes import TARGETS, random_scene
from models.shapes import Shape, drop_image


def test_ldci_of_a_known_row():
    peaks = np.full(49, 2.0)
    assert metrics.ldci(peaks) == 0
    peaks[[0, 48]] = 1.0, 2.8  # one half too low, one 0.4 too high
    assert metrics.ldci(peaks) == pytest.approx((0.5 + 0.4) / 48)


def test_ldci_positions_are_the_papers():
    positions = metrics.ldci_positions(0.2)
    np.testing.assert_allclose(positions[0], [-0.6, 0.6])  # number 1: top left
    np.testing.assert_allclose(positions[6], [0.6, 0.6])
    np.testing.assert_allclose(positions[24], [0, 0], atol=1e-12)
    np.testing.assert_allclose(positions[30], [-0.2, -0.2])  # number 31, the EIDORS scene B30


def test_mean_iou_of_two_boxes():
    a, b = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
    a[:4, :5] = True  # 20 pixels
    b[2:6, :5] = True  # 20 pixels, 10 shared: contact 10/30, background 70/90
    mean, contact = metrics.iou(a, b)
    assert contact == pytest.approx(1 / 3)
    assert mean == pytest.approx((1 / 3 + 7 / 9) / 2)
    assert metrics.iou(a, a) == (1.0, 1.0)


def test_touches_are_told_apart_and_thresholded_each_on_its_own():
    strong, weak = Shape("circle", -0.5, 0, 0.25, 0.5), Shape("square", 0.5, 0.2, 0.3, 0.12)
    image = drop_image([strong, weak], 48)
    labels = metrics.basins(image)
    assert labels.max() == 2
    np.testing.assert_array_equal(labels > 0, image > 0.5 * np.where(labels == 2, 0.12, 0.5))
    masks = metrics.touch_masks(image, [strong, weak])
    assert metrics.iou(masks[1], weak.fraction(48, covered=True) > 0.5)[1] > 0.95
    blurred = image + 0.03 * np.cos(np.arange(48))[:, None] * (image > 0)  # ripples on top are not touches
    assert metrics.basins(blurred).max() == 2
    assert metrics.basins(np.zeros((48, 48))).max() == 0


def test_counting_true_images_is_right_at_a_gap_of_a_tenth():
    rng = np.random.default_rng(5)
    for n in (1, 2, 3):
        for _ in range(15):
            scene = random_scene(rng, TARGETS, n=n)
            assert metrics.basins(drop_image(scene, 48)).max() == n


def test_a_perfect_image_scores_perfectly():
    for kind in ("circle", "triangle", "L"):
        shape = Shape(kind, 0.2, -0.3, 0.35, 0.3, 0.4)
        found = metrics.score(drop_image([shape], 96), [shape])
        assert found["mean_iou"] > 0.99 and found["contact_iou"] > 0.98
        assert found["correlation"] == pytest.approx(1) and found["ssim"] == pytest.approx(1)
        assert found["position"] < 0.003 and found["force_error"] < 1e-6 and found["integral_error"] < 1e-6
        assert found["count"] == 1
        assert found["greit_AR"] == pytest.approx(1) and found["greit_RNG"] == 0


def test_position_of_a_shifted_image():
    shape = Shape("circle", 0.25, 0.25, 0.25, 0.3)
    moved = drop_image([Shape("circle", 0.25 + 4 / 24, 0.25, 0.25, 0.3)], 48)  # four pixels of 2/48 to the right
    error = metrics.position_error(metrics.touch_masks(moved, [shape])[0], shape)
    assert error == pytest.approx(4 / 24, abs=2e-3)
    assert metrics.of_side(0.02) == pytest.approx(1.0)
    assert metrics.millimetres(0.02) == pytest.approx(1.0)


def test_position_of_an_l_is_its_area_centroid():
    shape = Shape("L", 0.1, 0.1, 0.4, 0.3, 1.0)
    found = metrics.position_error(drop_image([shape], 96) > 0.15, shape)
    assert found < 0.003 and np.hypot(*(shape.centroid - (0.1, 0.1))) > 0.05


def test_greit_figures_of_a_disc_with_a_ring_of_ringing():
    shape = Shape("circle", 0.5, 0, 0.3, 1.0)
    image = drop_image([shape], 96)
    resolution = np.sqrt(np.pi * 0.09 / 4)
    found = metrics.greit(image, shape)
    assert resolution == pytest.approx(found.RES, rel=0.03)  # q keeps pixels that are only a quarter covered
    assert found.PE == pytest.approx(0, abs=3e-3) and found.SD < 0.03
    ring = image - 0.1 * drop_image([Shape("square", -0.5, 0, 0.3, 1.0)], 96)  # area 0.18 of -0.1
    assert metrics.greit(ring, shape).RNG == pytest.approx(0.018 / (np.pi * 0.09), rel=0.03)
    assert metrics.greit(ring, shape).AR == pytest.approx(1 - 0.018 / (np.pi * 0.09), rel=0.01)
    inward = drop_image([Shape("circle", 0.4, 0, 0.3, 1.0)], 96)
    assert metrics.greit(inward, shape).PE == pytest.approx(0.1, abs=3e-3)  # target further out than its image


def test_force_and_integral_errors():
    shape = Shape("hertz", 0, 0, 0.4, 0.5)
    assert metrics.relative_error(0.45, 0.5) == pytest.approx(10)
    assert metrics.integrated(drop_image([shape], 48)) == pytest.approx(0.5 * 2 / 3 * np.pi * 0.16, rel=2e-3)


def test_ssim_and_correlation_fall_where_they_should():
    truth = drop_image([Shape("circle", 0, 0, 0.4, 0.3)], 48)
    assert metrics.correlation(-truth, truth) == pytest.approx(-1)
    assert metrics.correlation(3 * truth + 1, truth) == pytest.approx(1)
    assert metrics.ssim(truth * 0.5, truth) < metrics.ssim(truth * 0.9, truth) < 1
    # two flat images: only the luminance term is left, (2ab + c1) / (a^2 + b^2 + c1)
    edge = np.zeros((48, 48))
    edge[0, 0] = 1.0
    flat_a, flat_b = np.full((48, 48), 0.5), np.full((48, 48), 0.25)
    expected = (2 * 0.125 + 1e-4) / (0.25 + 0.0625 + 1e-4)
    middle = metrics.ssim(np.where(edge > 0, 0.5, flat_a), flat_b + 1.0 * edge)
    assert middle == pytest.approx(expected, abs=0.02)


def test_confusion_separation_and_false_touches():
    matrix = metrics.confusion([0, 0, 1, 2, 4], [0, 3, 1, 2, 4])
    assert matrix[0, 3] == 1 and metrics.accuracy(matrix) == pytest.approx(80)
    gaps = np.linspace(0.01, 1.0, 100)
    assert metrics.separation(gaps, gaps > 0.305, share=1.0) == pytest.approx(0.31)
    assert metrics.separation(gaps, gaps > 2) == float("inf")
    touched = np.zeros(7200, bool)
    touched[100:130] = touched[4000] = True  # two touches in 720 s at 10 frames a second
    assert metrics.false_touches_per_hour(touched, 10.0) == pytest.approx(10)
