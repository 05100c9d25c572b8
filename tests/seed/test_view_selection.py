"""Views that splats are seeded from: few of many, which see everything from all sides."""

import numpy as np
import pytest

from stages.scene import Camera, View, look_at
from stages.seed.view_selection import (
    ANGLE_SPREAD,
    BEST_ANGLE,
    MOST_VIEWS,
    Observations,
    selected_views,
)

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
AROUND = 120  # photographs of a ring around an object: 3 degrees from one to the next


def ring(centre: float, count: int = AROUND) -> tuple[tuple[View, ...], np.ndarray]:
    """(views from a ring around a ball of points at x = `centre`, the points)."""
    views = []
    for number, angle in enumerate(2 * np.pi * np.arange(count) / count):
        eye = np.array([centre + 4 * np.cos(angle), -0.5, 4 * np.sin(angle)])
        matrix = look_at(eye, np.array([centre, 0.0, 0.0]))
        name = f"{centre}-{number:03}"
        views.append(View(name, name, Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 80.0, 60.0, matrix)))
    ball = np.random.default_rng(1).normal(0, 0.3, (400, 3))
    return tuple(views), ball + np.array([centre, 0.0, 0.0])


def test_of_few_views_all_are_used() -> None:
    views, points = ring(0.0, MOST_VIEWS)
    assert selected_views(views, points) == tuple(sorted(views, key=lambda view: view.name))


@pytest.mark.parametrize("most", [20, 40, MOST_VIEWS])
def test_of_many_views_no_more_are_used_and_they_lie_all_around(most: int) -> None:
    views, points = ring(0.0)
    chosen = selected_views(views, points, most)
    assert len(chosen) == most
    at = np.sort([views.index(view) for view in chosen])
    gaps = np.diff(np.append(at, at[0] + AROUND)) * 360 / AROUND
    assert gaps.max() <= 360 / most * 5  # a view and its four sources count as one


def test_each_place_of_a_walk_gets_its_share() -> None:
    near, points_near = ring(0.0)
    far, points_far = ring(200.0)
    chosen = selected_views(near + far, np.concatenate([points_near, points_far]), 40)
    assert 15 <= sum(view in near for view in chosen) <= 25


def test_each_used_view_has_two_others_within_two_spreads_of_the_best_angle() -> None:
    views, points = ring(0.0)
    chosen = selected_views(views, points, 40)
    observations = Observations([view.camera for view in chosen], points)
    below, above = ANGLE_SPREAD
    for i in range(len(chosen)):
        angles = [np.median(observations.angles(i)[j]) for j in observations.sources(i)]
        good = [BEST_ANGLE - 2 * below < angle < BEST_ANGLE + 2 * above for angle in angles]
        assert sum(good) >= 2


def test_the_order_of_views_does_not_matter() -> None:
    views, points = ring(0.0)
    assert selected_views(views, points, 30) == selected_views(views[::-1], points, 30)
