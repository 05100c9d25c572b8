"""The shape and rotation of first splats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.scene.rotations import matrices_of
from stages.seed.axes import FLATTENING, surface_axes


def plane(normal: np.ndarray, n: int = 300) -> np.ndarray:
    """[n, 3] points of a plane, unevenly spread."""
    turn = Rotation.align_vectors([normal], [[0, 0, 1.0]])[0].as_matrix()
    r = np.random.default_rng(0)
    return np.column_stack([r.gamma(1.0, size=(n, 2)), np.zeros(n)]) @ turn.T


def covariances(points: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of splats that are one wide."""
    turns, factors = surface_axes(points)
    axes = matrices_of(turns)
    return np.asarray(np.einsum("nij,nj,nkj->nik", axes, factors**2, axes))


@pytest.mark.parametrize("normal", [[0, 0, 1.0], [1.0, 0, 0], [0.48, -0.6, 0.64]])
def test_splats_of_a_plane_are_thinner_along_its_normal(normal: list[float]) -> None:
    turns, factors = surface_axes(plane(np.array(normal)))
    assert (factors == [FLATTENING, 1.0, 1.0]).all()
    assert np.abs(matrices_of(turns)[:, :, 0] @ normal) == pytest.approx(1.0)


def test_shapes_turn_with_the_world() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3))
    turn = Rotation.random(random_state=3).as_matrix()
    turned = covariances(points @ turn.T)
    np.testing.assert_allclose(turned, turn @ covariances(points) @ turn.T, atol=1e-9)


def test_shapes_do_not_depend_on_the_unit() -> None:
    points = np.random.default_rng(1).normal(size=(200, 3))
    np.testing.assert_allclose(covariances(1e-6 * points), covariances(points), atol=1e-6)
    np.testing.assert_allclose(covariances(1e6 * points), covariances(points), atol=1e-6)


@pytest.mark.parametrize(
    "points",
    [np.zeros((1, 3)), np.zeros((50, 3)), np.outer(np.arange(40.0), [1, 2, 3]), np.eye(3)],
)
def test_points_without_a_surface_have_some_rotation(points: np.ndarray) -> None:
    """One point, one place, a line, and three points."""
    turns, factors = surface_axes(points)
    assert np.linalg.norm(turns, axis=1) == pytest.approx(1.0)
    assert np.isfinite(factors).all()
