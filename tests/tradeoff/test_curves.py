"""Curves whose readings are known by hand."""

import numpy as np
import pytest

from stages.evaluate.coverage import Patches
from stages.tradeoff import report_text
from stages.tradeoff.curves import (
    Coverage,
    HistoryPoint,
    OperatingPoint,
    Tradeoff,
    knee,
    time_to,
)
from stages.tradeoff.intervals import paired_difference


def history(*psnr):
    """An evaluation every 10 CPU seconds."""
    return [HistoryPoint(i, 100, 5.0 * i, 10.0 * i, db) for i, db in enumerate(psnr, 1)]


def test_the_time_to_a_psnr_is_between_the_evaluations_around_it():
    course = history(18.0, 19.0, 19.8, 20.0)
    assert time_to(course, 0.5) == (20.0, 30.0)
    assert time_to(course, 0.1) == (30.0, 40.0)


def test_a_psnr_that_was_lost_again_was_not_reached():
    assert time_to(history(19.9, 18.0, 19.0, 20.0), 0.5) == (30.0, 40.0)


def test_a_psnr_of_the_first_evaluation_has_no_beginning():
    assert time_to(history(19.9, 20.0), 0.5) == (0.0, 10.0)


def test_the_knee_is_where_doubling_stops_to_gain():
    # 2 dB for each doubling up to 8, then 0.1
    assert knee([1, 2, 4, 8, 16, 32, 64], [10, 12, 14, 16, 16.1, 16.2, 16.3]) == 3
    assert knee([64, 8, 1], [16.3, 16, 10]) == 1  # in any order


def test_a_straight_line_has_no_knee():
    assert knee([8, 4, 2, 1], [16, 14, 12, 10]) == 0


def test_a_curve_that_gains_more_and_more_has_no_knee():
    assert knee([8, 4, 2, 1], [16, 12, 10.5, 10]) == 0


def test_a_loss_is_a_cost_and_its_interval_has_the_same_sign():
    change = paired_difference([-0.2, -0.22, -0.18, -0.2, -0.21, -0.19], [-0.2, -0.22, -0.18])
    text = report_text.costs(change)
    assert text.startswith("costs 0.20 dB (other views, 90 %: 0.1")
    low, high = (float(x) for x in text.split("%: ")[1].rstrip(")").split(" to "))
    assert low < 0.2 < high


def test_a_single_view_has_no_interval():
    assert report_text.costs(paired_difference([-0.2], [])) == "costs 0.20 dB (of 1 photograph)"
    assert report_text.costs(paired_difference([0.2], [])) == "gains 0.20 dB (of 1 photograph)"


def empty_coverage() -> Coverage:
    """A capture that shows nothing."""
    none = np.zeros(0)
    patches = Patches(np.zeros((0, 3)), 1.0, none, np.zeros((0, 1), bool), none.astype(int), none)
    return Coverage((), (), patches)


@pytest.mark.parametrize("logged", [0, 1])
def test_a_run_without_a_log_says_so(logged):
    own = OperatingPoint("as it is", 100, 20.0, paired_difference([0.0] * 3, []))
    course = tuple(history(20.0)[:logged])
    tradeoff = Tradeoff(own, course, (), (own,), (), 480, empty_coverage())
    assert report_text.about_time(tradeoff) == [report_text.NO_COURSE]
    for cause in ("no steps or few", "in blocks"):
        assert cause in report_text.NO_COURSE
    assert "splat train" not in report_text.NO_COURSE  # which would log no more


def test_a_single_view_has_an_interval_where_training_views_say_how_far_views_differ() -> None:
    one = paired_difference([-0.2], [-0.3, -0.31, -0.29])
    assert report_text.costs(one) == "costs 0.20 dB (other views, 90 %: 0.16 to 0.24)"
