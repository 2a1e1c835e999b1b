"""The order of a scan in parts: every measurement once, every electrode in every part, each part sees all the skin."""

import numpy as np
import pytest

from models import rolling, touch_grid


@pytest.mark.parametrize("parts", [10, 5, 4, 2, 1])
def test_every_electrode_is_in_every_part(bundle, parts):
    order = rolling.order(bundle.matrices, bundle.pattern, parts)
    assert sorted(order.tolist()) == list(range(120))
    for part in order.reshape(parts, -1):
        assert len(np.unique(bundle.pattern[part])) == 16


def test_each_part_alone_tells_where_a_touch_is_better_than_the_patterns_own_order(bundle):
    """The mean Bayesian standard deviation of position over the grid of touches, of the part that knows least."""
    grid = touch_grid.touches(bundle.matrices)
    judged = grid.radius == touch_grid.RADIUS
    slopes = touch_grid.slopes(grid, judged, 1e-4)

    def worst(order):
        found = []
        for part in order.reshape(10, -1):
            information = np.diag(touch_grid.PRIOR**-2) + np.einsum("mka,mkb->mab", slopes[:, part], slopes[:, part])
            covariance = np.linalg.inv(information)
            found.append(float(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]).mean()))
        return max(found)

    chosen = worst(rolling.order(bundle.matrices, bundle.pattern, 10))
    assert chosen < 0.3 * worst(np.arange(120))
    assert chosen < worst(np.random.default_rng(1).permutation(120))


def test_a_scan_is_cut_into_as_many_parts_as_see_every_electrode():
    assert rolling.most_parts(120, 16) == 10
    assert rolling.most_parts(192, 16) == 4
    assert rolling.most_parts(120, 16, at_most=5) == 5
    assert rolling.most_parts(7, 4) == 1
