"""A start without points lies where the cameras look together."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.scene import Camera, look_at
from stages.sfm.known.points import count_views, random_points

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
    assert "The optical axes of 8 of 8 photographs are nearly parallel" in caught.value.given


def test_photographs_that_do_not_show_the_middle_are_counted() -> None:
    """Far cameras with narrow lenses, of which most look past the middle of the others' axes."""
    eyes = [camera.centre for camera in around()]
    aims = [MIDDLE + 2 * np.array([0.0, (-1) ** i, 0.0]) for i in range(12)]
    narrow = [
        Camera(800, 600, 9000.0, 9000.0, 400.0, 300.0, look_at(eye, aim))
        for eye, aim in zip(eyes, aims, strict=True)
    ]
    with pytest.raises(SplatError) as caught:
        random_points(narrow, seed=0, names=[f"{number}.jpg" for number in range(12)])
    assert "0 of 12 photographs have the place" in caught.value.given
    assert "12 of 12 photographs (0.jpg, 1.jpg, 2.jpg and 9 more) do not" in caught.value.given


def test_cameras_that_look_outward_have_no_middle_before_them() -> None:
    outward = [camera(c.centre, 2 * c.centre - MIDDLE) for c in around()]
    names = [f"{number}.jpg" for number in range(12)]
    with pytest.raises(SplatError) as caught:
        random_points([*outward[:9], *around()[9:]], seed=0, names=names)
    assert caught.value.code == "cameras-no-common-view"
    given = caught.value.given
    assert "9 of 12 photographs (0.jpg, 1.jpg, 2.jpg and 6 more) look away from" in given
    assert "3 of 12 photographs (9.jpg, 10.jpg, 11.jpg) look towards it" in given
