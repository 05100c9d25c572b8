"""Paired differences: which are significant, and how often their intervals are right."""

import math

import numpy as np
import pytest

from stages.tradeoff.intervals import BETTER, CONFIDENCE, INCONCLUSIVE, WORSE, paired_difference


def test_a_result_does_not_differ_from_itself():
    found = paired_difference(np.zeros(8), np.zeros(5))
    assert (found.mean, found.low, found.high, found.verdict) == (0, 0, 0, INCONCLUSIVE)


def test_a_gain_in_every_photograph_is_better_and_its_negative_worse():
    gains, training = np.array([0.4, 0.5, 0.6, 0.5, 0.45, 0.55]), np.array([0.5, 0.7, 0.6, 0.6])
    up, down = paired_difference(gains, training), paired_difference(-gains, -training)
    assert (up.verdict, down.verdict) == (BETTER, WORSE)
    assert up.low < 0.5 < up.high
    assert up.mean == pytest.approx(-down.mean)


def test_one_better_view_is_not_significant():
    assert paired_difference([3.0, 0, 0, 0, 0], [0.0, 2.0, 0.0, 2.0]).verdict == INCONCLUSIVE


def test_a_single_view_says_nothing_of_others_without_training_views():
    found = paired_difference([2.0], [])
    assert (found.low, found.high, found.verdict) == (-math.inf, math.inf, INCONCLUSIVE)
    assert paired_difference([2.0], [-0.1, 0.1, -0.1]).verdict == BETTER


def test_training_views_say_how_far_views_differ_and_not_by_how_much():
    """By hand: the held-out views agree, and the training views' deviation is 1 / 1.2 about another
    mean. The variance of a view is 5 x 1 / (2 + 5), that of three and of twelve others 1/3 + 1/12
    of it, and Student's factor for seven degrees of freedom 1.8946."""
    training = 7.0 + math.sqrt(5 / 6) / 1.2 * np.array([1, -1] * 3)
    found = paired_difference([0.5] * 3, training)
    assert found.mean == 0.5
    assert found.high - 0.5 == pytest.approx(1.8946 * math.sqrt(5 / 7 * 5 / 12), abs=1e-4)
    assert found.low == pytest.approx(1.0 - found.high)


def views(random, count, scale):
    """Differences of views: each has an effect of its own, and pixels that depend on their
    neighbours, so that blocks of pixels say little of how far views differ."""
    pixels = np.cumsum(random.normal(size=(count, 400)), axis=1) / 40
    return scale * (random.normal(size=count) + pixels.mean(axis=1))


@pytest.mark.parametrize("count", [1, 3, 12])
def test_the_interval_holds_a_dozen_other_views_about_as_often_as_it_says(count):
    """Training views have another mean and five sixths of the deviation."""
    random, right, widths, alone = np.random.default_rng(3), 0, [], []
    for _ in range(400):
        held_out, others = views(random, count, 1.0), views(random, 12, 1.0)
        found = paired_difference(held_out, 0.4 + views(random, 20, 1 / 1.2))
        right += found.low <= others.mean() <= found.high
        widths.append(found.high - found.low)
        alone.append(held_out.std() * 2 * 4.3 / math.sqrt(2))  # 95 %, two degrees of freedom
    assert CONFIDENCE - 0.03 <= right / 400 <= CONFIDENCE + 0.05
    if count == 3:
        assert np.mean(widths) < 0.65 * np.mean(alone)


def test_no_values_and_values_that_are_not_finite_are_refused():
    for bad in ([], [1.0, np.nan]):
        with pytest.raises(ValueError, match="differences"):
            paired_difference(bad, [0.0, 1.0])
