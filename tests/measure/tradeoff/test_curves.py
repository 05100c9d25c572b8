"""Curves whose answers are known by hand."""

import numpy as np
import pytest

from stages.measure.bootstrap import paired_difference
from stages.measure.coverage import Patches
from stages.measure.tradeoff import summary
from stages.measure.tradeoff.curves import Moment, Point, Trade, knee, time_to
from stages.measure.tradeoff.thin import Thin


def moments(*psnr):
    """One every 10 seconds, of two threads."""
    return [Moment(i, 100, 10.0 * i, 20.0 * i, db) for i, db in enumerate(psnr, 1)]


def test_the_time_to_a_quality_lies_between_the_figures_around_it():
    course = moments(18.0, 19.0, 19.8, 20.0)
    assert time_to(course, 0.5) == (20.0, 30.0)
    assert time_to(course, 0.5, cpu=True) == (40.0, 60.0)
    assert time_to(course, 0.1) == (30.0, 40.0)


def test_a_quality_that_was_lost_again_was_not_reached():
    assert time_to(moments(19.9, 18.0, 19.0, 20.0), 0.5) == (30.0, 40.0)


def test_a_quality_that_was_there_at_the_first_look_has_no_beginning():
    assert time_to(moments(19.9, 20.0), 0.5) == (0.0, 10.0)


def test_the_knee_is_where_doubling_stops_to_pay():
    # 2 dB for each doubling up to 8, then 0.1
    assert knee([1, 2, 4, 8, 16, 32, 64], [10, 12, 14, 16, 16.1, 16.2, 16.3]) == 3
    assert knee([64, 8, 1], [16.3, 16, 10]) == 1  # in any order


def test_a_straight_line_has_no_knee():
    assert knee([8, 4, 2, 1], [16, 14, 12, 10]) == 0


def test_a_curve_that_pays_more_and_more_has_no_knee():
    assert knee([8, 4, 2, 1], [16, 12, 10.5, 10]) == 0


def test_a_loss_is_told_as_a_cost_and_its_interval_the_same_way_round():
    change = paired_difference(np.array([-0.2, -0.22, -0.18, -0.2, -0.21, -0.19]))
    told = summary.costs(change)
    assert told.startswith("costs 0.20 dB (95 %: 0.1")
    low, high = (float(x) for x in told.split("%: ")[1].rstrip(")").split(" to "))
    assert low < 0.2 < high


def test_one_photograph_makes_no_interval():
    assert summary.costs(paired_difference(np.array([-0.2]))) == "costs 0.20 dB (one judge)"
    assert summary.costs(paired_difference(np.array([0.2]))) == "gains 0.20 dB (one judge)"


def nowhere() -> Thin:
    """A capture that shows nothing."""
    none = np.zeros(0)
    patches = Patches(np.zeros((0, 3)), 1.0, none, np.zeros((0, 1), bool), none.astype(int), none)
    return Thin((), (), patches, None, (), (), np.zeros((0, 3)), (), (0.0, 0.0))


@pytest.mark.parametrize("logged", [0, 1])
def test_a_run_without_a_log_says_so(logged):
    own = Point("as it is", 100, 20.0, paired_difference(np.zeros(3)))
    trade = Trade(own, tuple(moments(20.0)[:logged]), (), (own,), (), 480, nowhere())
    assert summary.about_time(trade) == [summary.NO_TIMES]
