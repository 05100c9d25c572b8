"""Levelling: up is found from cameras held level, and not if they disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stages.scene import look_at
from stages.sfm.place.levelling import level_and_recentre, up_direction
from stages.sfm.worker.sparse_model import reprojection_errors
from tests.sfm.synthetic import orbit_model, random_rotation

UP = np.array([0.0, -1.0, 0.0])


def orbit(count: int, degrees: float, height: float, roll_deg: float = 0.0) -> NDArray[np.float64]:
    random = np.random.default_rng(1)
    rotations = []
    for angle in np.radians(np.linspace(0, degrees, count)):
        pose = look_at(np.array([3 * np.sin(angle), -height, -3 * np.cos(angle)]), np.zeros(3))
        a = np.radians(random.normal(0, roll_deg))
        roll = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        rotations.append(roll @ pose[:3, :3])
    return np.array(rotations)


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("height", [0.0, 1.0, 4.0, -1.0])
@pytest.mark.parametrize("degrees", [90.0, 180.0, 360.0])
def test_up_is_exact_for_level_cameras_however_far_they_look_down(
    height: float, degrees: float
) -> None:
    world = random_rotation(5)  # the frame that structure from motion happens to choose
    up = up_direction(orbit(20, degrees, height) @ world.T)
    assert up is not None
    assert angle_deg(up, world @ UP) < 1.0


def test_small_roll_averages_out() -> None:
    up = up_direction(orbit(40, 300, 1.5, roll_deg=5.0))
    assert up is not None
    assert angle_deg(up, UP) < 2.0


def test_a_fifth_of_the_photographs_in_portrait_is_outvoted() -> None:
    rotations = orbit(30, 330, 1.0)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations[::5] = quarter @ rotations[::5]
    up = up_direction(rotations)
    assert up is not None
    assert angle_deg(up, UP) < 1.0


def test_cameras_that_all_look_the_same_way_use_the_tops_of_their_pictures() -> None:
    wall = [look_at(np.array([x, 0.0, -5.0]), np.array([x, 0.0, 0.0])) for x in range(8)]
    up = up_direction(np.array(wall)[:, :3, :3])
    assert up is not None
    assert angle_deg(up, UP) < 1.0


def test_if_all_look_straight_down_up_is_towards_the_cameras() -> None:
    headings = np.radians(np.arange(0, 360, 30))
    rotations = np.array(
        [[[np.cos(a), 0, np.sin(a)], [-np.sin(a), 0, np.cos(a)], [0, 1, 0]] for a in headings]
    )
    rotations[:, 1] = np.cross(rotations[:, 2], rotations[:, 0])
    up = up_direction(rotations)
    assert up is not None
    assert angle_deg(up, UP) < 1.0


@pytest.mark.parametrize("back", [4, 8])
def test_strips_of_a_flight_that_looks_straight_down_are_levelled(back: int) -> None:
    """Twelve photographs: the drone turned round for some of them, with half a degree of error."""
    random = np.random.default_rng(2)
    rotations = []
    for number in range(12):
        heading = np.radians(107.0 + 180.0 * (number < back) + random.normal(0, 0.5))
        c, s, off = np.cos(heading), np.sin(heading), np.radians(random.normal(0, 0.1))
        right = np.array([c, off, s])
        down = np.cross([off, 1.0, off], right)
        rotations.append(np.stack([right, down, np.cross(right, down)]))
    world = random_rotation(6)
    up = up_direction(np.array(rotations) @ world.T)
    assert up is not None
    assert angle_deg(up, world @ UP) < 1.0


def test_random_rotations_give_no_up_direction() -> None:
    assert up_direction(np.array([random_rotation(i) for i in range(30)])) is None


def test_the_model_is_moved_rigidly_and_the_subject_comes_to_the_origin() -> None:
    model = orbit_model(views=12, points=300)
    turn, shift = random_rotation(3), np.array([100.0, -50.0, 7.0])
    points = model.points @ turn.T + shift
    poses = model.world_to_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ turn.T
    poses[:, :3, 3] -= poses[:, :3, :3] @ shift
    moved = replace(model, points=points, world_to_camera=poses)

    found, levelled = level_and_recentre(moved)

    assert levelled
    assert np.allclose(reprojection_errors(found), reprojection_errors(model), atol=1e-9)
    assert np.linalg.norm(np.median(found.points, axis=0)) < 0.3
    down = found.world_to_camera[:, 1, :3]
    assert (down[:, 1] > 0.5).all()  # the cameras' own down points along +Y
    right, heading = found.world_to_camera[0, 0, :3], found.world_to_camera[0, 2, :3]
    assert abs(right[1]) < 0.02  # the horizon is level
    assert heading[2] > 0  # the first photograph looks along +Z
    assert abs(heading[0]) < 1e-9
    assert np.allclose(np.linalg.det(found.world_to_camera[:, :3, :3]), 1.0)
