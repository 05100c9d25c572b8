"""Distances to triangles, against answers by hand and another library."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.mesh.distance import distances_to_mesh
from stages.scene.mesh import Mesh


@pytest.mark.parametrize(
    ("point", "wanted"),
    [
        ((0.2, 0.2, 3.0), 3.0),  # over the inside
        ((0.5, -2.0, 0.0), 2.0),  # beside an edge
        ((-3.0, -4.0, 0.0), 5.0),  # off a corner
        ((1.0, 1.0, 0.0), np.sqrt(0.5)),  # beside the longest edge
        ((0.2, 0.2, 0.0), 0.0),
    ],
)
def test_distance_to_one_triangle(point: tuple[float, ...], wanted: float) -> None:
    triangle = Mesh.of(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]]))
    assert distances_to_mesh(np.array([point]), triangle, 0.1)[0] == pytest.approx(
        wanted, abs=1e-12
    )


def test_distances_are_those_of_another_library() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = rng.normal(0, 1, (60, 3)), rng.integers(0, 60, (80, 3))
    mesh = Mesh.of(vertices, faces)
    points = rng.normal(0, 1.5, (200, 3))
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    _, wanted, _ = trimesh.proximity.closest_point_naive(other, points)
    np.testing.assert_allclose(distances_to_mesh(points, mesh, 0.05), wanted, rtol=1e-9, atol=1e-9)


def test_nothing_is_infinitely_far() -> None:
    assert np.isinf(distances_to_mesh(np.zeros((2, 3)), Mesh.empty(), 0.1)).all()
