"""The middle of many points, without a copy of them all."""

from __future__ import annotations

import numpy as np

from stages.scene.quantiles import quantiles


def test_they_are_those_of_the_points_that_are_finite():
    points = np.random.default_rng(0).normal(size=(101, 3)).astype(np.float32)
    wanted = np.quantile(points.astype(np.float64), (0.01, 0.5, 1), axis=0)
    damaged = np.insert(points, 7, [np.nan, 1e6, np.inf], axis=0)
    np.testing.assert_array_equal(quantiles(damaged, (0.01, 0.5, 1)), wanted)
    assert np.isnan(damaged[7, 0])


def test_of_no_point_they_are_zero():
    assert not quantiles(np.full((2, 3), np.nan), (0.1, 0.9)).any()
