import math

import numpy as np
import pytest

from jumper_warp.compare.statistics import (
    bands,
    holm,
    interquartile_mean,
    probability_interval,
    probability_larger,
    rank_test,
)


def test_the_interquartile_mean_leaves_out_the_outer_quarters():
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0])) == 3.5


def test_a_band_of_equal_seeds_has_no_width_and_one_of_different_seeds_holds_their_mean():
    low, high = bands(np.stack([np.ones(8), np.arange(8.0)], axis=1))
    assert low[0] == high[0] == 1.0
    assert low[1] < 3.5 < high[1]


def test_the_probability_of_a_larger_value_counts_pairs():
    assert probability_larger(np.array([1.0, 3.0]), np.array([2.0, 2.0])) == 0.5
    assert probability_larger(np.array([1.0, 2.0, 5.0]), np.array([2.0])) == pytest.approx(0.5)
    assert probability_interval(np.array([1.0]), np.array([2.0, 3.0])) is None
    assert probability_interval(np.arange(5.0), np.arange(5.0) + 10.0) == (0.0, 0.0)


def test_the_rank_test_of_separated_arms_counts_their_assignments():
    assert rank_test(np.arange(5.0), np.arange(5.0) + 10.0) == pytest.approx(2.0 / math.comb(10, 5))
    assert rank_test(np.arange(3.0), np.arange(3.0) + 10.0) == pytest.approx(2.0 / math.comb(6, 3))


def test_the_rank_test_with_ties_enumerates_permutations():
    """Of the 6 assignments of 0, 0, 1, 1 to two pairs, one is as extreme on each side."""
    assert rank_test(np.array([0.0, 0.0]), np.array([1.0, 1.0])) == pytest.approx(2.0 / 6.0)


def test_a_single_seed_shows_no_difference():
    assert rank_test(np.array([0.5]), np.array([0.5, 0.5, 0.5])) == 1.0
    assert rank_test(np.array([0.5]), np.array([0.9])) == 1.0


def test_holm_multiplies_the_smallest_p_value_by_the_number_of_tests():
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
