"""Paired differences: which are significant, and how often their intervals are right."""

import math

import numpy as np
import pytest

from stages.tradeoff.intervals import BETTER, CONFIDENCE, INCONCLUSIVE, WORSE, paired_difference


def difference(held_out, training, mixed=False):
    """Of held-out views and training views, one after the other by name, or one among the others:
    of each eight, the first is held out."""
    count = len(held_out)
    at = [8 * i for i in range(count)] if mixed else list(range(count))
    free = [i for i in range(len(training) + count) if i not in at]
    named = zip([*at, *free], [*held_out, *training], strict=True)
    return paired_difference({f"{i:03d}": float(x) for i, x in named}, count)


def test_a_result_does_not_differ_from_itself():
    found = difference(np.zeros(8), np.zeros(5))
    assert (found.mean, found.low, found.high, found.verdict) == (0, 0, 0, INCONCLUSIVE)


def test_a_gain_in_every_photograph_is_better_and_its_negative_worse():
    gains, training = np.array([0.4, 0.5, 0.6, 0.5, 0.45, 0.55]), np.array([0.5, 0.7, 0.6, 0.6])
    up, down = difference(gains, training), difference(-gains, -training)
    assert (up.verdict, down.verdict) == (BETTER, WORSE)
    assert up.low < 0.5 < up.high
    assert up.mean == pytest.approx(-down.mean)


def test_one_better_view_is_not_significant():
    assert difference([3.0, 0, 0, 0, 0], [0.0, 2.0, 0.0, 2.0]).verdict == INCONCLUSIVE


def test_a_single_view_says_nothing_of_others_without_training_views():
    found = difference([2.0], [])
    assert (found.low, found.high, found.verdict) == (-math.inf, math.inf, INCONCLUSIVE)
    assert difference([2.0], [-0.1, 0.1, -0.1]).verdict == BETTER


def test_training_views_say_how_far_views_differ_and_not_by_how_much():
    """By hand: the held-out views agree, and the training views' deviation is 0.8 about another
    mean. Each is unlike its neighbours, which so say nothing. The variance of a view is
    (5 x 1.25^2 x 0.8^2) / (2 + 5), that of three and of twelve others 1/3 + 1/12 of it, and
    Student's factor 1.8946."""
    found = difference([0.5] * 3, 7.0 + 0.8 * math.sqrt(5 / 6) * np.array([1, -1] * 3))
    assert found.mean == 0.5
    assert found.high - 0.5 == pytest.approx(1.8946 * math.sqrt(5 / 7 * 5 / 12), abs=1e-4)
    assert found.low == pytest.approx(1.0 - found.high)


def test_what_neighbours_tell_is_subtracted():
    """By hand: differences rise by 1 from photograph to photograph, and held-out views lie 0.5
    above. All three are from the first half; the mean of all is 0.5 above that of the training
    views."""
    held_out, training = [2, 4, 6], [0, 1, 3, 5, *range(7, 24)]
    rising = {f"{i:03d}": i + 0.5 for i in held_out} | {f"{i:03d}": float(i) for i in training}
    found = paired_difference(rising, 3)
    assert found.mean == 4.5
    assert (found.low + found.high) / 2 == pytest.approx(np.mean(training) + 0.5, abs=0.2)
    names = np.random.default_rng(0).permutation(24)
    unordered = paired_difference(
        {f"{n:03d}": x for n, x in zip(names, rising.values(), strict=True)}, 3
    )
    assert found.high - found.low < 0.8 * (unordered.high - unordered.low)


def views(random, count, mean, scale):
    """Differences of `count` photographs along a path. Each is the mean of 400 pixels that depend
    on their neighbours in the picture, plus an effect of the view, which in turn depends on the
    photograph before."""
    pixels = np.cumsum(random.normal(size=(count, 400)), axis=1) / 40
    effects, effect = [], random.normal()
    for _ in range(count):
        effect = 0.8 * effect + 0.6 * random.normal()  # of variance 1
        effects.append(effect)
    return mean + scale * (np.array(effects) + pixels.mean(axis=1))


@pytest.mark.parametrize("count", [1, 3, 12])
def test_the_interval_holds_the_truth_about_as_often_as_it_says(count):
    """Training views have another mean and four fifths of the deviation. The truth is the mean of
    a dozen views at places of the path that are not held out."""
    random, held, widths, alone = np.random.default_rng(3), 0, [], []
    for _ in range(400):
        all_views = views(random, 8 * count, 0.0, 1.0)
        held_out = all_views[::8] + 0.4
        training = np.delete(0.8 * all_views, slice(None, None, 8)) - 0.3
        found = difference(held_out, training, mixed=True)
        others = random.choice(np.delete(all_views, slice(None, None, 8)), 12) + 0.4
        held += found.low <= others.mean() <= found.high
        widths.append(found.high - found.low)
        if count > 1:
            alone.append(held_out.std(ddof=1) / math.sqrt(count))
    assert CONFIDENCE - 0.05 <= held / 400 <= 0.97
    if count == 3:
        assert np.mean(widths) < 0.6 * np.mean(alone) * 2 * 2.92  # Student's, of the three alone


def test_no_values_and_values_that_are_not_finite_are_refused():
    for bad in ({}, {"a": 1.0, "b": np.nan, "c": 0.0}):
        with pytest.raises(ValueError, match="differences"):
            paired_difference(bad, 1)
