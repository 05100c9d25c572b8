"""Visibility constraints: may there be a surface at a position?

In the picture of another photograph, a position is supported if a point near it has about its
depth. If all points near it are farther away, it would occlude them: it lies in free space, where
splats would be floaters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.scene import View
from stages.seed.projection import visible_points

SIDE = 320  # pixels: size of the pictures in which the nearest points are searched
NEAREST = 6  # points
DEPTH_TOLERANCE = 0.1  # relative
SUPPORT_RATIO = 4  # times as many photographs must support as contradict
CLOSE_POINTS, CLOSE = 3, 0.2  # points within this share of the distance to the nearest camera


class VisibilityConstraints:
    """The views, and the sparse points [P, 3] that each of them sees."""

    def __init__(self, views: tuple[View, ...], points: NDArray[np.float64]) -> None:
        self._cameras = cKDTree(np.array([view.camera.centre for view in views]).reshape(-1, 3))
        self._points = cKDTree(points)
        self._views = []
        for view in views:
            camera = view.camera.fitted(SIDE)
            _, pixels, depths = visible_points(camera, points)
            if len(depths) >= NEAREST:
                self._views.append((view.name, camera, cKDTree(pixels), depths))

    def count(
        self, positions: NDArray[np.float64], of: str
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(supporting [K], occluding [K]): for each position [K, 3], the number of views in which
        one of the nearest points has about its depth, and of views in which all of these are
        farther away; both without the view named `of`."""
        supporting, occluding = np.zeros((2, len(positions)), np.int64)
        for name, camera, tree, depths in self._views:
            rows, pixels, own_depths = visible_points(camera, positions)
            if name == of or not len(rows):
                continue
            _, nearest = tree.query(pixels, NEAREST)
            ratio = own_depths[:, None] / depths[nearest]
            supporting[rows] += (np.abs(ratio - 1) < DEPTH_TOLERANCE).any(1)
            occluding[rows] += (ratio < 1 - DEPTH_TOLERANCE).all(1)
        return supporting, occluding

    def supported(self, positions: NDArray[np.float64], of: str = "") -> NDArray[np.bool_]:
        """[K] whether enough other views support a surface, and hardly any contradict it."""
        supporting, occluding = self.count(positions, of)
        return np.asarray(supporting > SUPPORT_RATIO * occluding)

    def close_to_points(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[K] whether a position is much nearer to sparse points than to any camera."""
        if not len(positions) or self._points.n < CLOSE_POINTS:
            return np.zeros(len(positions), bool)
        to_camera, _ = self._cameras.query(positions)
        to_points, _ = self._points.query(positions, CLOSE_POINTS)
        return np.asarray(to_points[:, -1] < CLOSE * to_camera)
