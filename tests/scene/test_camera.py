"""Where a camera sees points, and an order that keeps neighbours together."""

from __future__ import annotations

import numpy as np

from stages.scene import Camera, look_at, morton


def test_points_worked_by_hand_land_where_they_should() -> None:
    camera = Camera(100, 60, 80.0, 40.0, 50.0, 30.0, np.eye(4))
    points = np.array([[0, 0, 2], [0.5, -0.25, 2], [1, 1, -1], [-2, 0, 2]], np.float32)
    pixels, z = camera.project(points)
    np.testing.assert_allclose(pixels[:2], [[50, 30], [70, 25]])
    np.testing.assert_allclose(z, [2, 2, -1, 2])
    assert camera.shows(pixels).tolist() == [True, True, False, False]


def test_what_is_looked_at_is_in_the_middle() -> None:
    eye, target = np.array([3.0, -1.0, -4.0]), np.array([0.2, 0.1, 0.3])
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, look_at(eye, target))
    pixels, z = camera.project(target[None])
    np.testing.assert_allclose(pixels, [[32, 24]], atol=1e-9)
    np.testing.assert_allclose(z, np.linalg.norm(target - eye))


def test_the_rim_belongs_to_the_picture_on_the_left_and_above_only() -> None:
    camera = Camera(10, 6, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    found = camera.shows(np.array([[0, 0], [10, 3], [5, 6], [9.999, 5.999], [np.nan, 1]]))
    assert found.tolist() == [True, False, False, True, False]


def test_neighbours_are_together_in_the_order_of_morton_whatever_strays() -> None:
    means = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    means[7], means[8, 1] = 1e9, np.nan
    order = morton.morton_order_of(means)
    assert sorted(order.tolist()) == list(range(2000))
    kept = means[order[~np.isin(order, (7, 8))]]
    steps = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    assert np.median(steps) < 0.25  # 1.3 in no order
