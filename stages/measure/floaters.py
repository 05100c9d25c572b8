"""Splats that hang alone in space, told without photographs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.base.blocks import reported_blocks
from stages.scene import Splats

_NEIGHBOURS = 8
_ALONE = 6.0  # times as far from its neighbours as they are from theirs,
_REACH = 3.0  # and farther than so many of its own standard deviations


def isolated_splats(splats: Splats) -> NDArray[np.bool_]:
    """[N] splats that are farther from their neighbours than these from theirs, by far, and do not
    reach them. Sparse surroundings are not alone: there all are far from each other. Means must be
    finite."""
    from scipy.spatial import KDTree

    count = min(_NEIGHBOURS, len(splats) - 1)
    if count < 2:
        return np.zeros(len(splats), bool)
    tree = KDTree(splats.means.astype(np.float64))
    nearest = np.empty((len(splats), count), np.int32)
    far = np.empty(len(splats))
    for rows in reported_blocks(len(splats)):
        distances, found = tree.query(splats.means[rows].astype(np.float64), count + 1)
        nearest[rows], far[rows] = found[:, 1:], distances[:, -1]
    found_alone = np.empty(len(splats), bool)
    for rows in reported_blocks(len(splats)):
        usual = np.median(far[nearest[rows]], axis=1)
        reach = _REACH * np.exp(splats.log_scales[rows].max(axis=1).astype(np.float64))
        found_alone[rows] = far[rows] > np.maximum(_ALONE * usual, reach)
    return found_alone
