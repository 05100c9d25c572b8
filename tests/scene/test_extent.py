"""How large a scene is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.scene import (
    Camera,
    Reconstruction,
    View,
    draw_settings_of,
    scene_extent,
    training_extent,
)


def seen_from(views, points):
    """A reconstruction of these views and points."""
    n = len(points)
    colours, tracks = np.zeros((n, 3), np.uint8), np.full(n, 3, np.int32)
    return Reconstruction(Path(), tuple(views), points, colours, np.zeros(n), tracks)


def held_still(apart, points):
    """Five cameras `apart` from each other along x, looking along z at `points`."""
    views = []
    for k in range(5):
        where = np.eye(4)
        where[0, 3] = -apart * (k - 2)
        views.append(View(f"{k}", f"{k}.jpg", Camera(64, 48, 50.0, 50.0, 32.0, 24.0, where)))
    return seen_from(views, points)


def wall(distance):
    r = np.random.default_rng(0)
    return np.column_stack([r.uniform(-0.3, 0.3, (200, 2)) * distance, np.full(200, distance)])


@pytest.mark.parametrize("apart", [1e-4, 0.01, 0.1])
def test_cameras_close_together_see_as_large_a_scene_as_it_is_far_away(apart):
    assert training_extent(held_still(apart, wall(7.0))) == pytest.approx(7.0)


def test_the_extent_turns_with_the_world():
    """Cameras spread unevenly, so that the median of each axis depends on the axes."""
    r = np.random.default_rng(2)
    centres = r.gamma(0.5, size=(40, 3)) * [4.0, 1.0, 2.0]
    wanted = scene_extent(standing_at(centres))
    for seed in range(5):
        turn = Rotation.random(random_state=seed).as_matrix()
        assert scene_extent(standing_at(centres @ turn.T)) == pytest.approx(wanted, rel=1e-6)


def test_the_near_plane_is_a_fifth_of_the_least_depth_that_a_photograph_shows():
    """By hand: one of 200 points lies misplaced before the cameras, the others at 7."""
    points = wall(7.0)
    points[0] *= 0.01
    assert draw_settings_of(held_still(0.1, points)).near == pytest.approx(7.0 / 5)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), -wall(3.0)])
def test_without_points_before_the_cameras_the_near_plane_is_a_share_of_the_extent(points):
    made = held_still(0.5, points)
    assert draw_settings_of(made).near == pytest.approx(0.01 * scene_extent(made.views[1:]))


def test_what_all_photographs_show_is_behind_the_near_plane_however_near_it_is():
    """A hundredth of the extent is 0.008."""
    assert draw_settings_of(held_still(0.5, wall(0.01))).near == pytest.approx(0.01 / 5)


def test_held_out_cameras_do_not_change_the_unit_of_training():
    made = held_still(0.5, wall(3.0))
    near, elsewhere = made.views[0].camera, np.eye(4)
    elsewhere[0, 3] = 500.0
    far = replace(made.views[0], role="test", camera=replace(near, world_to_camera=elsewhere))
    known = replace(made, views=tuple(replace(view, role="train") for view in made.views))
    with_test = replace(known, views=(*known.views, far))
    assert training_extent(with_test) == training_extent(known)
    assert draw_settings_of(with_test).near == draw_settings_of(known).near


def standing_at(centres):
    views = []
    for k, centre in enumerate(centres):
        pose = np.eye(4)
        pose[:3, 3] = -centre
        views.append(View(f"{k}", f"{k}.jpg", Camera(64, 48, 50.0, 50.0, 32.0, 24.0, pose)))
    return tuple(views)


def test_a_walk_longer_than_what_it_sees_is_its_own_measure():
    walked = held_still(10.0, wall(2.0))
    assert training_extent(walked) == scene_extent(walked.views[1:]) > 10


@pytest.mark.parametrize("points", [np.zeros((0, 3)), -wall(3.0)])
def test_without_points_in_any_picture_the_cameras_tell(points):
    bare = held_still(0.5, points)
    assert training_extent(bare) == scene_extent(bare.views[1:])


def test_cameras_at_one_place_have_the_smallest_extent() -> None:
    assert scene_extent(standing_at(np.ones((4, 3)))) == 1e-6


@pytest.mark.parametrize(("side", "kept"), [(0, 0), (40, 40), (800, 64)])
def test_pictures_in_training_are_no_larger_than_the_photographs(side, kept):
    """Of 64 by 48 pixels. 0 stands for no training."""
    assert (
        draw_settings_of(seen_from(standing_at(np.zeros((2, 3))), np.zeros((0, 3))), side).side
        == kept
    )
