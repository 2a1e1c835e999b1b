"""Drive patterns against the orders recorded by others, and errors that say what is wrong."""

import numpy as np
import pytest

from models import patterns
from models.patterns import PatternError


def test_orders_of_the_recorded_data(reference):
    np.testing.assert_array_equal(patterns.pairs()[:, :2] + 1, reference("eidors_reference")["pairs"])
    np.testing.assert_array_equal(patterns.adjacent() + 1, reference("eidors_reference")["adjacent"])
    np.testing.assert_array_equal(patterns.opposite(), reference("hydrogel_disc16")["pattern"])


def test_counts_and_ranks():
    """n(n-1)/2 numbers describe the electrodes; adjacent without the driving ones loses n of them."""
    for n, counts in ((8, (28, 40, 32)), (16, (120, 208, 192))):
        assert tuple(len(patterns.pattern(name, n)) for name in ("pairs", "adjacent", "opposite")) == counts
    assert patterns.rank(patterns.pairs()) == 120 and patterns.rank(patterns.adjacent()) == 104


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 16, 1, 2)], "measurement 0 .* names electrode 16"),
        ([(3, 3, 1, 2)], "drives an electrode against itself"),
        ([(0, 3, 2, 2)], "senses an electrode against itself"),
        ([(0, 1, 2, 3)], "never uses electrode 4"),
        ([(i, (i + 1) % 16, i, (i + 1) % 16) for i in range(16)], "rank 16, at least 52"),
    ],
)
def test_patterns_that_are_refused(rows, message):
    with pytest.raises(PatternError, match=message):
        patterns.pattern(rows)
    with pytest.raises(PatternError, match="even number of electrodes, found 15"):
        patterns.opposite(15)
