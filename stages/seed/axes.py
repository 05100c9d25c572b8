"""The shape and rotation of first splats: those of the surface around them, as far as neighbours
tell it.

Round splats with the world's axes flatten and split along these axes first, so that training gave
other results in a turned world. Surfaces are flat close by: the axis in which a point's neighbours
spread least is the normal, and a splat is thinner along it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.base.blocks import blocks
from stages.scene.rotations import quaternions_of

NEIGHBOURS = 16
FLATTENING = 0.5  # of the scale along the normal


def surface_axes(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(unit quaternions [N, 4], factors [N, 3] of the scales along the axes of these rotations) of
    splats at `points` [N, 3], which are finite. The first axis is the normal."""
    count = min(NEIGHBOURS + 1, len(points))
    tree, turns = cKDTree(points), np.empty((len(points), 4))
    for rows in blocks(len(points)):
        near = points[np.reshape(tree.query(points[rows], count)[1], (-1, count))]
        spread = near - near.mean(axis=1, keepdims=True)
        axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1]  # smallest first
        axes[np.linalg.det(axes) < 0, :, 2] *= -1
        turns[rows] = quaternions_of(axes)
    factors = np.ones((len(points), 3))
    factors[:, 0] = FLATTENING
    return turns, factors
