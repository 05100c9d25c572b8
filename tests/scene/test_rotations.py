"""Rotation matrices and quaternions say the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.scene.rotations import matrices_of, quaternions_of
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
