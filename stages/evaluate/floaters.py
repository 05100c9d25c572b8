"""Floaters: splats in free space, where no surface is.

A floater fits the few training views that it was made for and hides the scene from others. Four
rules find them, because each situation gives other knowledge of free space. Merging any two would
change which splats are removed.

- `stages.train.free_space`, during training: free space is what at least two and fewer than four
  training views look past, by the depths of the seed points. It needs these depths, and removes
  what densification puts there.
- `near_camera_floaters`, in sparsification and pruning: a splat that at most two views see, in
  front of a camera and closer to it than a quarter of the median depth that is drawn for it. It
  needs the views and each splat's contribution to them.
- `splats_in_masks`, there, too: a splat that is shown only where masks ignore what is there. It
  needs the same.
- `isolated_splats`, for a file without its views: a splat far from its neighbours, compared with
  their own distances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stages.base.row_slices import row_slices
from stages.evaluate.contribution import VISIBLE_WEIGHT, Contributions, near_view_frusta
from stages.scene import Camera, Splats

NEAR_CAMERA = 0.25  # of the median depth that is drawn for that camera
MOST_VIEWS = 2  # a splat that more views need is taken to be a surface
_NEIGHBOURS = 8
_ISOLATED = 6.0  # times the median distance of its neighbours from theirs
_REACH = 3.0  # standard deviations: a splat that covers its neighbours is not isolated


def near_camera_floaters(
    splats: Splats, contributions: Contributions, cameras: Sequence[Camera]
) -> NDArray[np.bool_]:
    """Splats that at most two views need, close to a camera and in its picture or just beyond its
    edge.

    What is close to a camera elsewhere is no floater: people stand beside walls, which other views
    show.

    Args:
        splats: N splats.
        contributions: of these splats to the views.
        cameras: of the same views, in the same order.

    Returns:
        [N] whether each is a floater.
    """
    close = np.zeros(len(splats), bool)
    for camera, depth in zip(cameras, contributions.scene_depth, strict=True):
        if np.isfinite(depth):
            distance = np.linalg.norm(splats.means - camera.centre, axis=1)
            close |= (distance < NEAR_CAMERA * depth) & near_view_frusta(splats, [camera])
    return np.asarray(close & (contributions.view_counts <= MOST_VIEWS))


def splats_in_masks(contributions: Contributions) -> NDArray[np.bool_]:
    """[N] splats that views show, but only where their masks ignore what is there."""
    shown = contributions.weight >= VISIBLE_WEIGHT
    return np.asarray(shown & (contributions.kept_weight < VISIBLE_WEIGHT))


def isolated_splats(splats: Splats) -> NDArray[np.bool_]:
    """[N] splats that are much farther from their neighbours than these are from theirs, and do not
    reach them.

    In a sparse background every distance is large, so no splat there is isolated. Means must be
    finite.
    """
    count = min(_NEIGHBOURS, len(splats) - 1)
    if count < 2:
        return np.zeros(len(splats), bool)
    tree = KDTree(splats.means.astype(np.float64))
    nearest = np.empty((len(splats), count), np.int32)
    far = np.empty(len(splats))
    for rows in row_slices(len(splats)):
        distances, found = tree.query(splats.means[rows].astype(np.float64), count + 1)
        nearest[rows], far[rows] = found[:, 1:], distances[:, -1]
    isolated = np.empty(len(splats), bool)
    for rows in row_slices(len(splats)):
        usual = np.median(far[nearest[rows]], axis=1)
        reach = _REACH * np.exp(splats.log_scales[rows].max(axis=1).astype(np.float64))
        isolated[rows] = far[rows] > np.maximum(_ISOLATED * usual, reach)
    return isolated
