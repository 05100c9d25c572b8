"""The rotation of first splats: along the surface around them, as far as neighbours tell it.

First splats are round, and flatten and split along their own axes first. With the world's axes
training gave other results in a turned world.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.base.row_slices import row_slices
from stages.scene import Camera
from stages.scene.rotations import quaternions_of

NEIGHBOURS = 16
STEEP = 0.3  # sine of the angle between up and the normal: of walls, not of floors


def surface_rotations(
    points: NDArray[np.float64], cameras: Sequence[Camera]
) -> NDArray[np.float64]:
    """[N, 4] unit quaternions of splats at `points` [N, 3], which are finite.

    The first axis is the normal, in which the nearest neighbours of a point spread least. The
    second is the direction on the surface that goes up in the pictures of `cameras`, because edges
    do; on a floor, that in which the neighbours spread most.
    """
    up = _up(cameras)
    count = min(NEIGHBOURS + 1, len(points))
    tree, found = cKDTree(points), np.empty((len(points), 4))
    for rows in row_slices(len(points)):
        near = points[np.reshape(tree.query(points[rows], count)[1], (-1, count))]
        spread = near - near.mean(axis=1, keepdims=True)
        principal = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1]  # smallest first
        normal, longest = principal[:, :, 0], principal[:, :, 2]
        upward = up - (normal @ up)[:, None] * normal
        size = np.linalg.norm(upward, axis=1, keepdims=True)
        second = np.where(size > STEEP, upward / np.maximum(size, STEEP), longest)
        axes = np.stack([normal, second, np.cross(normal, second)], axis=2)
        found[rows] = quaternions_of(axes)
    return found


def _up(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[3] the mean of the cameras' up directions, a unit vector; 0 where they cancel out."""
    mean = -np.sum([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    size = float(np.linalg.norm(mean))
    return np.asarray(mean / size if size > 0 else np.zeros(3))
