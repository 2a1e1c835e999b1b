"""Drive patterns against the orders recorded by others, and errors that say what is wrong."""

import numpy as np
import pytest

from models import patterns
from models.patterns import PatternError


def test_orders_of_the_recorded_data(reference):
    np.testing.assert_array_equal(patterns.pairs()[:, :2] + 1, reference("eidors_reference")["pairs"])
    np.testing.assert_array_equal(patterns.adjacent() + 1, reference("eidors_reference")["adjacent"])
    np.testing.assert_array_equal(patterns.opposite(), reference("hydrogel_disc16")["pattern"])


@pytest.mark.parametrize(("n", "k_pairs", "k_adjacent", "k_opposite"), [(8, 28, 40, 32), (16, 120, 208, 192)])
def test_counts(n, k_pairs, k_adjacent, k_opposite):
    assert len(patterns.pattern("pairs", n)) == k_pairs
    assert len(patterns.pattern("adjacent", n)) == k_adjacent
    assert len(patterns.pattern("opposite", n)) == k_opposite


def test_rank_counts_reciprocity():
    # n(n-1)/2 numbers describe the electrodes; adjacent without the driving ones loses n of them.
    assert patterns.rank(patterns.pairs()) == 120
    assert patterns.rank(patterns.adjacent()) == 104
    swapped = patterns.adjacent()[:, [2, 3, 0, 1]]
    assert patterns.rank(np.vstack([patterns.adjacent(), swapped])) == 104


def test_insufficient_rank_is_named():
    too_few = [(i, (i + 1) % 16, i, (i + 1) % 16) for i in range(16)]
    with pytest.raises(PatternError, match="rank 16, at least 52"):
        patterns.pattern(too_few)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 16, 1, 2)], "measurement 0 .* names electrode 16"),
        ([(3, 3, 1, 2)], "drives an electrode against itself"),
        ([(0, 3, 2, 2)], "senses an electrode against itself"),
        ([(0, 1, 2, 3)], "never uses electrode 4"),
        ([(0, 1, 2)], "rows of four integers"),
        ([(0.5, 1, 2, 3)], "rows of four integers"),
    ],
)
def test_bad_custom_patterns(rows, message):
    with pytest.raises(PatternError, match=message):
        patterns.pattern(rows)


def test_unknown_names_and_odd_opposite():
    with pytest.raises(PatternError, match="unknown pattern 'adjcent'.*pairs, adjacent, opposite"):
        patterns.pattern("adjcent")
    with pytest.raises(PatternError, match="even number of electrodes, found 15"):
        patterns.opposite(15)


def test_a_custom_list_is_taken_as_it_is():
    rows = patterns.pairs()[::-1].tolist()
    np.testing.assert_array_equal(patterns.pattern(rows), rows)
