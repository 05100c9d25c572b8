"""The rotation of first splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.scene import Camera
from stages.scene.rotations import matrices_of
from stages.seed.axes import surface_rotations
from tests.scenes import camera

CAMERAS = (camera(),)  # upright: -y is up
WIDTHS = np.array([1.0, 2.0, 3.0])  # of an ellipsoid along the axes


def plane(normal: np.ndarray, n: int = 300) -> np.ndarray:
    """[n, 3] points of a plane, unevenly spread."""
    turn = Rotation.align_vectors([normal], [[0, 0, 1.0]])[0].as_matrix()
    r = np.random.default_rng(0)
    return np.asarray(np.column_stack([r.gamma(1.0, size=(n, 2)), np.zeros(n)]) @ turn.T)


def shapes(points: np.ndarray, cameras: Sequence[Camera] = CAMERAS) -> np.ndarray:
    """[N, 3, 3] covariances of ellipsoids with these rotations: the sign of an axis is free."""
    axes = matrices_of(surface_rotations(points, cameras))
    return np.asarray(np.einsum("nij,j,nkj->nik", axes, WIDTHS**2, axes))


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [1.0, 0, 0], [0.48, -0.6, 0.64]])
def test_the_first_axis_of_splats_of_a_plane_is_its_normal(normal: list[float]) -> None:
    axes = matrices_of(surface_rotations(plane(np.array(normal)), CAMERAS))
    assert np.abs(axes[:, :, 0] @ normal) == pytest.approx(1.0)


def test_rotations_turn_with_the_world() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3))
    pose = np.eye(4)
    pose[:3, :3] = turn = Rotation.random(random_state=3).as_matrix()
    turned = [
        replace(camera, world_to_camera=camera.world_to_camera @ pose.T) for camera in CAMERAS
    ]
    found = shapes(points @ turn.T, turned)
    np.testing.assert_allclose(found, turn @ shapes(points) @ turn.T, atol=1e-9)


def test_the_second_axis_of_a_wall_goes_up_in_the_pictures() -> None:
    wall = plane(np.array([0.6, 0, 0.8]))
    second = matrices_of(surface_rotations(wall, CAMERAS))[:, :, 1]
    np.testing.assert_allclose(second, np.tile([0, -1.0, 0], (len(wall), 1)), atol=1e-6)


def test_a_floor_has_the_axes_in_which_its_points_spread() -> None:
    floor = plane(np.array([0, 1.0, 0]))
    axes = matrices_of(surface_rotations(floor, CAMERAS))
    assert np.abs(axes[:, 1, 0]) == pytest.approx(1.0)
    assert np.isfinite(axes).all()


def test_rotations_do_not_depend_on_the_unit() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3))
    np.testing.assert_allclose(shapes(1e-6 * points), shapes(points), atol=1e-6)
    np.testing.assert_allclose(shapes(1e6 * points), shapes(points), atol=1e-6)


@pytest.mark.parametrize(
    "points",
    [np.zeros((1, 3)), np.zeros((50, 3)), np.outer(np.arange(40.0), [1, 2, 3]), np.eye(3)],
)
def test_points_without_a_surface_have_some_rotation(points: np.ndarray) -> None:
    """One point, one place, a line, and three points."""
    assert np.linalg.norm(surface_rotations(points, CAMERAS), axis=1) == pytest.approx(1.0)
