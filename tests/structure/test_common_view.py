"""A start without points lies where the cameras look together."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.scene import Camera, look_at
from stages.structure.known_points import count_views, random_points

MIDDLE = np.array([5.0, -2.0, 7.0])


def camera(eye: np.ndarray, target: np.ndarray) -> Camera:
    return Camera(800, 600, 1000.0, 1000.0, 400.0, 300.0, look_at(eye, target))


def around(count: int = 12) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = MIDDLE + 4 * np.stack([np.cos(angles), -0.5 + 0 * angles, np.sin(angles)], axis=1)
    return [camera(eye, MIDDLE) for eye in eyes]


def test_points_fill_a_ball_that_the_cameras_see() -> None:
    """By hand: the eyes are 4 sqrt(1.25) away, and half the picture's height is 0.3 of the focal
    length: the radius is 4.472 x 0.3 / sqrt(1.09) = 1.285."""
    points, middle, radius = random_points(around(), seed=0)
    np.testing.assert_allclose(middle, MIDDLE, atol=1e-9)
    assert radius == pytest.approx(1.285, abs=1e-3)
    distance = np.linalg.norm(points - MIDDLE, axis=1)
    assert 0.99 * radius < distance.max() <= radius
    assert (count_views(around(), points) == 12).all()
    assert len(points) == 20_000


def test_the_same_seed_gives_the_same_points() -> None:
    a, b, c = (random_points(around(), seed)[0] for seed in (1, 1, 2))
    assert (a == b).all()
    assert not (a == c).all()


def test_cameras_side_by_side_have_no_middle() -> None:
    row = [camera(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 9.0])) for x in range(8)]
    with pytest.raises(SplatError) as caught:
        random_points(row, seed=0)
    assert caught.value.code == "cameras-no-common-view"


def test_cameras_that_look_outward_have_no_middle_before_them() -> None:
    outward = [camera(c.centre, 2 * c.centre - MIDDLE) for c in around()]
    with pytest.raises(SplatError) as caught:
        random_points(outward, seed=0)
    assert caught.value.code == "cameras-no-common-view"


def test_no_point_lies_where_a_photograph_shows_nothing() -> None:
    cameras = around()
    empty = np.zeros((600, 800), np.bool_)
    empty[:, :400] = True  # the left half of the first
    points, _, _ = random_points(cameras, 0, [empty, *[None] * 11])
    pixels, _ = cameras[0].project(points)
    assert len(points) > 1000
    assert pixels[:, 0].min() >= 400
