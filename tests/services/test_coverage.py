"""What a frame that lacks measurements still sees of the skin."""

from __future__ import annotations

import numpy as np
import pytest

from models.bundle import Bundle
from models.touch_grid import touches
from services.estimation.coverage import RADIUS, Coverage

K = 120


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load("square16")


@pytest.fixture(scope="module")
def coverage(bundle: Bundle) -> Coverage:
    return Coverage(bundle)


def touch(bundle: Bundle, x: float, y: float) -> np.ndarray:
    """(K,) d of a touch at a place in model units."""
    found = touches(bundle.matrices, 1.0, (RADIUS,))
    return 0.3 * found.response[np.argmin(np.hypot(*(found.position - (x, y)).T))]


def without(lost: np.ndarray) -> np.ndarray:
    live = np.ones(K, bool)
    live[lost] = False
    return live


ALL, LAST_15, LAST_33 = np.ones(K, bool), without(np.arange(105, K)), without(np.arange(87, K))


def test_a_touch_that_the_lost_ones_would_have_seen_is_not_seen_enough(bundle: Bundle, coverage: Coverage) -> None:
    at_their_electrodes, elsewhere = touch(bundle, -0.55, 0.7), touch(bundle, 0.5, -0.6)
    assert not coverage.enough(at_their_electrodes, LAST_15, ALL)
    assert coverage.enough(elsewhere, LAST_15, ALL)


def test_without_a_touch_a_blind_part_of_the_skin_counts(coverage: Coverage) -> None:
    noise = 1e-4 * np.random.default_rng(0).standard_normal(K)
    assert coverage.enough(noise, ALL, ALL) and coverage.enough(noise, LAST_15, ALL)
    assert not coverage.enough(noise, LAST_33, ALL)


def test_a_third_lost_here_and_there_blinds_nobody(bundle: Bundle, coverage: Coverage) -> None:
    d = touch(bundle, 0.2, -0.1)
    rng = np.random.default_rng(1)
    assert all(coverage.enough(d, without(rng.permutation(K)[:36]), ALL) for _ in range(20))


def test_what_an_electrode_at_fault_cannot_see_is_not_the_frames(coverage: Coverage, bundle: Bundle) -> None:
    of_the_others = ~(np.asarray(bundle.pattern) == 3).any(axis=1)
    assert coverage.enough(np.zeros(K), of_the_others, of_the_others)
