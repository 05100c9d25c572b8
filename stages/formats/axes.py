"""Axis permutations: an ellipsoid has 24 equivalent rotations, with its scales permuted to match.

The smallest of them compresses best, because all rotations then lie near the identity.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from stages.base.row_slices import row_slices
from stages.formats.values import unit_quaternions
from stages.scene import Splats
from stages.scene.rotations import matrices_of


def smallest_rotations(splats: Splats) -> Splats:
    """The same ellipsoids, each with the smallest of its 24 equivalent rotations."""
    quaternions = np.empty((len(splats), 4), np.float32)
    log_scales = np.empty_like(splats.log_scales)
    cube = _cube_rotations()
    # each column of a rotation matrix selects the old axis that becomes the new one
    axes = np.abs(matrices_of(cube)).argmax(axis=1)
    for rows in row_slices(len(splats)):
        rotations = unit_quaternions(splats.quaternions[rows]).astype(np.float64)
        least = np.abs(rotations @ (cube * (1, -1, -1, -1)).T).argmax(axis=1)
        smallest = _product(rotations, cube[least])
        quaternions[rows] = np.where(smallest[:, :1] < 0, -smallest, smallest)
        log_scales[rows] = np.take_along_axis(splats.log_scales[rows], axes[least], axis=1)
    return replace(splats, quaternions=quaternions, log_scales=log_scales)


def _cube_rotations() -> NDArray[np.float64]:
    """[24, 4] the rotations of a cube as unit quaternions."""
    rotations = []
    for ends in product((0, 1, -1), repeat=4):
        used = [end for end in ends if end]
        if len(used) in (1, 2, 4) and used[0] > 0:
            rotations.append(np.array(ends) / np.sqrt(len(used)))
    return np.array(rotations)


def _product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 4] quaternions: b first, then a."""
    real = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True)
    rest = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([real, rest], axis=1)
