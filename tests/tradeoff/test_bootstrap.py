"""Paired differences: which are significant."""

import math

import numpy as np
import pytest

from stages.tradeoff.bootstrap import BETTER, INCONCLUSIVE, WORSE, paired_difference


def test_a_result_does_not_differ_from_itself():
    found = paired_difference(np.zeros(8))
    assert (found.mean, found.low, found.high, found.verdict) == (0, 0, 0, INCONCLUSIVE)


def test_a_gain_in_every_photograph_is_better_and_its_negative_worse():
    gains = np.array([0.4, 0.5, 0.6, 0.5, 0.45, 0.55])
    up, down = paired_difference(gains), paired_difference(-gains)
    assert (up.verdict, down.verdict) == (BETTER, WORSE)
    assert up.low < 0.5 < up.high
    assert up.mean == pytest.approx(-down.mean)


def test_one_better_view_is_not_significant():
    assert paired_difference(np.array([3.0, 0, 0, 0, 0])).verdict == INCONCLUSIVE


def test_a_single_view_says_nothing_of_others():
    found = paired_difference(np.full((1, 5), 2.0))
    assert (found.low, found.high, found.verdict) == (-math.inf, math.inf, INCONCLUSIVE)


def test_seeds_that_disagree_widen_the_interval_though_photographs_agree():
    agreeing = paired_difference(np.full((12, 3), 0.3))
    disagreeing = paired_difference(np.tile([0.0, 0.3, 0.6], (12, 1)))
    assert agreeing.verdict == BETTER
    assert disagreeing.mean == pytest.approx(agreeing.mean)
    assert disagreeing.verdict == INCONCLUSIVE


def test_equal_differences_get_equal_intervals():
    values = np.random.default_rng(1).normal(size=(9, 2))
    assert paired_difference(values) == paired_difference(values)


@pytest.mark.parametrize("shape", [(4,), (10,), (10, 4)])
def test_the_interval_holds_the_truth_about_as_often_as_it_says(shape):
    """Photographs and seeds each with an effect of their own, as real ones have."""
    random = np.random.default_rng(7)
    held = 0
    for _ in range(300):
        table = random.normal(size=(shape[0], 1)) + 0.2 * random.normal(size=(*shape[:1], 1))
        if len(shape) == 2:
            table = table + random.normal(size=(1, shape[1])) + 0.2 * random.normal(size=shape)
        found = paired_difference(table + 1.0)
        held += found.low <= 1.0 <= found.high
    assert 0.91 <= held / 300 <= 1.0


def test_no_values_and_values_that_are_not_finite_are_refused():
    for bad in (np.zeros(0), np.array([1.0, np.nan]), np.zeros((2, 2, 2))):
        with pytest.raises(ValueError, match="differences"):
            paired_difference(bad)
