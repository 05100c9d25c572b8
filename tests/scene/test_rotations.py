"""Rotation matrices and quaternions say the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.scene.rotations import matrices_of, quaternions_of, similarity
from tests.sfm.synthetic import random_rotation


@given(st.integers(0, 1000))
def test_quaternions_are_those_of_the_rotation(seed: int) -> None:
    rotation = random_rotation(seed)
    w, x, y, z = quaternions_of(rotation)
    again = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    assert np.allclose(again, rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_quaternions_too(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    quaternion = quaternions_of(rotation)
    assert abs(quaternion[axis + 1]) == pytest.approx(1.0)


@given(st.integers(0, 1000))
def test_a_rotation_is_that_of_its_quaternion_of_any_length(seed: int) -> None:
    rotations = np.array([random_rotation(seed), random_rotation(seed + 1)])
    quaternions = quaternions_of(rotations) * (seed + 0.5)
    np.testing.assert_allclose(matrices_of(quaternions), rotations, atol=1e-12)


@pytest.mark.parametrize("aside", [0.0, 1e-3, 0.01])
def test_rotations_of_cameras_decide_what_a_row_of_them_leaves_open(aside: float) -> None:
    rng, wanted = np.random.default_rng(1), random_rotation(3)
    points = np.linspace(-1, 1, 8)[:, None] * (1.0, 2.0, -0.5) + aside * rng.normal(size=(8, 3))
    moved = 2.0 * points @ wanted.T + (5.0, 0.0, -1.0) + 1e-3 * rng.normal(size=(8, 3))
    noise = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=(8, 3))).as_matrix()
    scale, found, _ = similarity(points, moved, wanted @ noise)
    assert scale == pytest.approx(2.0, rel=1e-2)
    assert np.degrees(Rotation.from_matrix(found @ wanted.T).magnitude()) < 0.5


def test_points_in_space_decide_before_rotations_that_err() -> None:
    rng, wanted = np.random.default_rng(1), random_rotation(3)
    points = rng.normal(size=(20, 3))
    turned = wanted @ Rotation.from_rotvec((0.0, 0.1, 0.0)).as_matrix()
    _, found, _ = similarity(points, points @ wanted.T, np.repeat(turned[None], 20, axis=0))
    assert np.degrees(Rotation.from_matrix(found @ wanted.T).magnitude()) < 0.2
